"""A page for each environment, from its docstring and the tables of fields and rewards."""

from __future__ import annotations

import csv
import inspect
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bufgym
from bufgym import scenario
from bufgym.cli.listing import SYMBOLS
from bufgym.envs.options import Options
from bufgym.model.observe import (
    CANDIDATE_FIELDS,
    FIELDS,
    OWN_TERMS,
    QUEUE_FIELDS,
    REWARD_TERMS,
    TOPIC_FIELDS,
    TOPIC_REWARD_TERMS,
    Field,
    RewardTerm,
)
from bufgym.scenario import FleetScenario
from bufgym.utils.errors import BufgymError
from bufgym_papers.environments import MAPPING
from website.films import FILMS
from website.markdown import code, parameters, table

FLEET = "bufgym_fleet_v0"
RETURNS = Path(__file__).with_name("returns.csv")
"""Rules' returns, written by ``python -m website.returns``."""


@dataclass(frozen=True)
class Version:
    """One version of an environment."""

    name: str
    """Version as at the end of its id."""
    since: str
    """First release of bufgym with it."""
    what: str
    """Description of the environment, or of the change."""


_PAIRED = (
    Version("v1", "0.3.0", "the default reward is `paired`, H above that of always dropping the cheapest"),
    Version("v0", "0.1.0", "first version, with the default reward `retained`"),
)
HISTORY = {
    "bufgym/Interruption-v1": _PAIRED,
    "bufgym/Uplink-v1": _PAIRED,
    "bufgym/Suite-v1": _PAIRED,
    "bufgym/Topics-v0": (Version("v0", "0.1.0", "first version"),),
    FLEET: (Version("v0", "0.1.0", "first version"),),
    "bufgym/Mapping-v0": (Version("v0", "0.3.0", "first version"),),
}
"""Every environment's versions, newest first."""

SCENARIOS = bufgym.ENVIRONMENTS | {"bufgym/Mapping-v0": MAPPING}
"""Id -> (name of the scenario, description, its arguments)."""


TOPICS = """\
Many topics share one uplink: decide at every arrival what to drop, and at every free socket what to send next."""


WHICH_REWARD = "[Which one when](../guide/environments.md#rewards)"

INTERFACES = """\
![A queue of eight messages and a newcomer: three actions with candidates, ten with slots](../figures/candidates.svg)

*Above the default, below `actions="slots"`. Made by `python -m website.interfaces`*"""

RETURN = """\
Mean return, the `ep_rew_mean` that a learner's curve is compared with, and steps of an
episode: 100 episodes with the default arguments, by `python -m website.returns`."""


def made() -> dict[str, str]:
    """Map each page's name on the site to its Markdown."""
    found = {f"environments/{slug(id)}.md": page(id) for id in HISTORY}
    return {"environments/index.md": index(), **found}


def slug(id: str) -> str:
    """Make the last part of a page's address."""
    return "fleet" if id == FLEET else id.split("/")[1].split("-")[0].lower()


def about(id: str) -> str:
    """Describe an environment in a line."""
    return "robots that share one cell (PettingZoo)" if id == FLEET else SCENARIOS[id][1]


def title(id: str) -> str:
    """Make the heading of its page."""
    return "FleetEnv" if id == FLEET else id.removeprefix("bufgym/")


def index() -> str:
    """The list of all environments with their films."""
    rows = [(f"[`{title(id)}`]({slug(id)}.md)", about(id)) for id in HISTORY]
    films = "\n\n".join(
        f"[![{about(id)}](../gallery/{slug(id)}.webp)]({slug(id)}.md)\n\n"
        f"*`{title(id)}`: {about(id)}. {_made_by(slug(id))}*"
        for id in HISTORY
    )
    return "\n\n".join(
        [
            "# Environments",
            "All environments are one simulator of one sender, met in different episodes. Actions, observations and"
            " rewards are the same throughout.",
            table(("environment", "episode"), rows),
            films,
        ]
    )


def page(id: str) -> str:
    """One environment's page."""
    kind: Any = _class(id)
    parts = sections(inspect.getdoc(kind) or "")
    topics, one_queue = id == "bufgym/Topics-v0", id not in ("bufgym/Topics-v0", FLEET)
    more: tuple[RewardTerm, ...] = TOPIC_REWARD_TERMS
    if not topics:
        more = tuple(OWN_TERMS[name] for name in (("cost", "paired", "regret") if one_queue else ("cost",)))
    intro = TOPICS if topics else parts[""]
    lines = [f"# {title(id)}", f"{about(id)[0].upper()}{about(id)[1:]}.", *_films(id), code(intro), _make(id)]
    if id == FLEET:
        lines += ["## Action", code(parts["Action, observation"]), _slot_fields(topics)]
    elif topics:
        asked = re.sub(r"^\([^)]*\): ", "", parts["Several topics"])
        lines += ["## Action and observation", code(asked[:1].upper() + asked[1:])]
        lines += ["### Slots", code(parts["Slots"]), _slot_fields(topics)]
    else:
        lines += ["## Action", INTERFACES, code(parts["Action"])]
        lines += ["## Observation", code(parts["Observation"])]
        lines += [f"{SYMBOLS}.", _fields((*CANDIDATE_FIELDS, *QUEUE_FIELDS))]
    lines += ["## Reward", code(parts["Reward"]), WHICH_REWARD, _rewards(REWARD_TERMS + more)]
    lines += ["### Returns of rules", RETURN, _returns(id)]
    if one_queue:
        lines += ["## Slots", code(parts["Slots"]), _slot_fields(topics)]
    lines += ["## Episode end", code(parts["Episode end"])]
    lines += ["## Arguments", code(parts["Arguments"]), parameters(Options())]
    lines += [
        "## Parameters of the scenario",
        "Each is an argument of the environment, too.",
        parameters(_scenario(id)),
    ]
    lines += ["## Versions", table(("version", "since", "change"), [(v.name, v.since, v.what) for v in HISTORY[id]])]
    lines += ["[When a version changes](../stability.md)"]
    return "\n\n".join(lines)


def sections(docstring: str) -> dict[str, str]:
    """Split a docstring at its bold headings; paragraphs before the first heading are under ""."""
    parts = re.split(r"^\*\*([^*]+)\*\*", docstring, flags=re.MULTILINE)
    bodies = [parts[0], *parts[2::2]]
    found = dict(zip(["", *parts[1::2]], (body.strip(" :\n") for body in bodies), strict=True))
    # The list of arguments ends where plain paragraphs begin again.
    return {name: body[:1].upper() + body[1:] for name, body in found.items()}


def _class(id: str) -> Any:
    from bufgym.envs import FleetEnv, SenderEnv

    return FleetEnv if id == FLEET else SenderEnv


def _scenario(id: str) -> Any:
    if id == FLEET:
        return FleetScenario.of(4, "lte").uplink
    return scenario.get(SCENARIOS[id][0])


def _make(id: str) -> str:
    if id == FLEET:
        return "```python\nfrom bufgym.envs import FleetEnv\n\nenv = FleetEnv(robots=8, capacity=8)\n```"
    return f'```python\nimport bufgym\nimport gymnasium as gym\n\nenv = gym.make("{id}")\n```'


def _made_by(film: str) -> str:
    return f"Made by `python -m website.films {film}`"


def _films(id: str) -> list[str]:
    """List its films, each with the command that makes it."""
    return [
        f"![{film.about}](../gallery/{name}.webp)\n\n*{film.about[0].upper()}{film.about[1:]}. {_made_by(name)}*"
        for name, film in FILMS.items()
        if film.environment == id and name == slug(id)
    ]


def _slot_fields(topics: bool) -> str:
    """What an agent observes of slots."""
    scale = "Every field lies in [0, 1]. r is a reference: the field is 0.5 where the quantity is as large as r."
    return f"{scale}\n\n{_fields(FIELDS + TOPIC_FIELDS if topics else FIELDS)}"


def _fields(fields: Iterable[Field]) -> str:
    rows = [(f"`{f.name}`", f.per, f.group, f.unit, code(f.meaning)) for f in fields]
    return table(("field", "per", "takes", "unit", "meaning"), rows)


def _returns(id: str) -> str:
    with RETURNS.open(newline="", encoding="utf-8") as file:
        rows = [(f"`{row['rule']}`", row["return"], row["steps"]) for row in csv.DictReader(file) if row["id"] == id]
    if not rows:
        raise BufgymError(f"{id}: has no returns in {RETURNS.name}; run python -m website.returns")
    return table(("rule", "return", "steps"), rows)


def _rewards(terms: Iterable[RewardTerm]) -> str:
    return table(("term", "unit", "meaning"), [(f"`{t.name}`", t.unit, t.meaning) for t in terms])
