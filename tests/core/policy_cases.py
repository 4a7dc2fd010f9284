"""Short runs of policies that their tests follow step by step."""

import numpy as np
from cases import order

from bufgym import policies
from bufgym.model import qoi
from bufgym.scenario import Interruption
from bufgym.sim import run
from bufgym.sim.metrics import outcome

V = qoi.exponential(0.618)


def interruption(spec, L, T):
    """One run through an interruption of T messages."""
    episode = Interruption(t_max=T).episode(T).with_uniforms(np.random.default_rng(0))
    return run(policies.get(spec), [episode], L, V)


def kept(spec, L, T):
    """What is delivered between message 0 and message T + 1."""
    return order(interruption(spec, L, T))[1:-1]


def worst_ratio(spec, L, lengths):
    """Largest gap over the even gap (T + 1) / (L + 1), the worst of all T."""
    scenario = Interruption(t_max=max(lengths))
    senders = run(policies.get(spec), [scenario.episode(T) for T in lengths], L, V)
    return max(outcome(senders, i).longest_gap / ((T + 1) / (L + 1)) for i, T in enumerate(lengths))
