"""A pool: episodes that are drawn once and come again, the same in every environment that has one."""

from collections import Counter
from typing import Any

import pytest
from refusal_cases import refuse

from bufgym.envs import FleetVecEnv, SenderEnv, SenderVectorEnv
from bufgym.ground.errors import BufgymError
from bufgym.scenario import Streams, Uplink
from bufgym.scenario.numbered import Pool
from bufgym.traces import Trace

UPLINK = Uplink(traces=(Trace.steps([(0.4, 9e6), (0.5, 0), (0.6, 2e6)]),), jitter=0.8, duration_s=0.4)
L = 3


def test_each_is_drawn_once_and_every_one_comes() -> None:
    drawn: list[Any] = []

    def draw(streams: Streams) -> Any:
        drawn.append(UPLINK.draw(streams))
        return drawn[-1]

    pool, streams = Pool(draw, 5), Streams.seeded(1)
    taken = Counter(id(pool(streams)) for _ in range(500))
    assert len(pool) == len(drawn) == len(taken) == 5
    # Each is taken 100 times of 500 on average; the standard deviation is 9.
    assert min(taken.values()) > 50


def test_the_set_is_the_same_for_every_row_and_seed() -> None:
    """A single environment, and the rows of a batch, play no other episodes than those of the pool."""
    arrivals = set()
    for seed in range(4):
        batch, single = SenderVectorEnv(3, UPLINK, L, pool=2), SenderEnv(UPLINK, L, pool=2)
        batch.reset(seed=seed)
        single.reset(seed=seed)
        played = [*batch.rows.senders.episodes, *single.rows.senders.episodes]
        arrivals |= {episode.arrivals["arrival_us"].tobytes() for episode in played if episode is not None}
    assert len(arrivals) == 2


def test_fleets_have_one_too() -> None:
    envs = FleetVecEnv(4, 2, UPLINK, L, pool=1)
    envs.reset(seed=1)
    links = {(episode.link.trace.name, episode.link.offset_us) for episode in envs.rows.senders.episodes if episode}
    assert len(links) == 1


@pytest.mark.parametrize("pool", [0, -1, 1.5, "many", True])
def test_a_pool_is_a_whole_number(pool: Any) -> None:
    refuse(r"pool = .*: must be a whole number from 1 to 1000000", SenderEnv, UPLINK, L, pool=pool)


def test_a_reset_that_is_refused_touches_no_row() -> None:
    """Of three episodes given the last is too long: the rows before it go on with what they have."""
    batch = SenderVectorEnv(3, UPLINK, L)
    batch.reset(seed=1)
    before = batch.rows.senders.batch.arrivals.copy()
    long = Uplink(traces=UPLINK.traces, duration_s=2.0).draw(Streams.seeded(3))
    with pytest.raises(BufgymError, match="these senders have room for"):
        batch.reset(options={"episodes": [UPLINK.draw(Streams.seeded(2)), None, long]})
    assert (batch.rows.senders.batch.arrivals == before).all() and batch.rows.senders.begun.tolist() == [1, 1, 1]
