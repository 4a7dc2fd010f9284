"""The weights of an environment's reward terms, read from the option ``reward``."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from bufgym.envs.cost import CHARGED
from bufgym.model.checks import is_number
from bufgym.model.observe import OWN_TERMS, OwnTerm, own_term, terms_for
from bufgym.utils.errors import BufgymError, unknown

APART = (*CHARGED, "regret")
"""Terms outside the tables that whole modules compute; theirs are the last columns, in this order."""


def reward_weights(
    reward: str | Mapping[str, float], several_topics: bool = False
) -> tuple[NDArray[np.float64], tuple[OwnTerm, ...]]:
    """float64[reward terms] from one term's name or from weights by name, and the named terms that are in no table."""
    tables = [term.name for term in terms_for(several_topics)]
    known = [*tables, *(name for name in OWN_TERMS if name not in tables)]
    if not isinstance(reward, str | Mapping):
        raise BufgymError(f"reward = {reward!r}: must be the name of a term ({', '.join(known)}) or weights by name")
    weights = {reward: 1.0} if isinstance(reward, str) else dict(reward)
    if not weights:
        raise BufgymError(f"reward = {reward!r}: give at least one term its weight; known: {', '.join(known)}")
    own: dict[str, OwnTerm] = {}
    for name, weight in sorted(weights.items(), key=lambda pair: APART.index(pair[0]) if pair[0] in APART else -1):
        if not (is_number(weight) and np.isfinite(weight)):
            raise BufgymError(f"reward = {reward!r}: the weight of {name!r} must be a finite number")
        if name in tables:
            continue
        term = own_term(name) if isinstance(name, str) else None
        if term is None:
            raise unknown("term", name, known, place=f"reward = {reward!r}")
        if several_topics and term.one_queue:
            raise BufgymError(f"reward = {reward!r}: {name!r} is for one queue; each topic has settings of its own")
        own[name] = term
    numbers = [weights.get(name, 0.0) for name in tables] + [weights[name] for name in own]
    return np.array(numbers, np.float64), tuple(own.values())
