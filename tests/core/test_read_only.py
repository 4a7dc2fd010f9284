"""A policy only reads what it sees: in Python a write is refused, compiled ones are found out after the run."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bufgym import scenario
from bufgym.benchmark import run as bench
from bufgym.benchmark.tasks.queue import QueueTask
from bufgym.envs import SenderEnv
from bufgym.errors import BufgymError
from bufgym.expert import Player
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.model.topics import Topic
from bufgym.policies import ACCEPT, Policy, get
from bufgym.scenario import Episode, FleetEpisode, Streams, Uplink, messages
from bufgym.sim import run
from bufgym.sim.cell import run_fleet
from bufgym.traces import Trace

V = qoi.exponential()
EPISODE = Episode(messages(np.arange(40) * 1_000, 4_000), Link(Trace.constant(1e6, 10)))


def keep(buffer: Any) -> int:
    return ACCEPT if len(buffer.slots) < buffer.capacity else 0


def renumbers(buffer: Any, arrival: Any, memory: Any) -> int:
    if len(buffer.slots) > 0:
        buffer.slots[0].seq = buffer.slots[len(buffer.slots) - 1].seq
    return ACCEPT if len(buffer.slots) < buffer.capacity else 0


def numbers_queued_wildly(buffer: Any, arrival: Any, memory: Any) -> int:
    if len(buffer.slots) > 0:
        buffer.slots[0].seq = 10**9
    return ACCEPT if len(buffer.slots) < buffer.capacity else 0


def numbers_arrivals_wildly(buffer: Any, arrival: Any, memory: Any) -> int:
    arrival.seq = -(10**9)
    return ACCEPT if len(buffer.slots) < buffer.capacity else 0


def moves_queued(buffer: Any, arrival: Any, memory: Any) -> int:
    if len(buffer.slots) > 0:
        buffer.slots[len(buffer.slots) - 1].x -= 0.5
    return ACCEPT if len(buffer.slots) < buffer.capacity else 0


def praises_queued(buffer: Any, arrival: Any, memory: Any) -> int:
    if len(buffer.slots) > 0:
        buffer.slots[len(buffer.slots) - 1].gain = 1.0
    return ACCEPT if len(buffer.slots) < buffer.capacity else 0


def moves(buffer: Any, arrival: Any, memory: Any) -> int:
    arrival.x *= 1000
    return ACCEPT if len(buffer.slots) < buffer.capacity else 0


def shrinks(buffer: Any, arrival: Any, memory: Any) -> int:
    arrival.size_bytes = 1
    return ACCEPT if len(buffer.slots) < buffer.capacity else 0


def shrinks_queued(buffer: Any, arrival: Any, memory: Any) -> int:
    if len(buffer.slots) > 0:
        buffer.slots[0].size_bytes = 1
    return ACCEPT if len(buffer.slots) < buffer.capacity else 0


def lifts_limits(buffer: Any, arrival: Any, memory: Any) -> int:
    buffer.topics[0].limit = 10**6
    return ACCEPT if len(buffer.slots) < buffer.capacity else 0


WRITERS = {
    renumbers: "not every message was sent, dropped or queued exactly once",
    numbers_queued_wildly: "not every message was sent, dropped or queued exactly once",
    numbers_arrivals_wildly: "a message that arrived is not as the episode has it",
    moves_queued: "H is not that of the messages that were received",
    praises_queued: "H is not that of the messages that were received",
    moves: "a message that arrived is not as the episode has it",
    shrinks: "a message that arrived is not as the episode has it",
    shrinks_queued: "the queue's bytes are not those of its messages",
    lifts_limits: "a topic's rules are not as they were",
}


@pytest.mark.parametrize("writer", WRITERS)
def test_a_python_policy_cannot_write(writer: Any) -> None:
    with pytest.raises(ValueError, match="read-only"):
        run(Policy("test-writer", writer), [EPISODE], 3, V)


@pytest.mark.parametrize("writer", WRITERS)
def test_nor_can_a_player(writer: Any) -> None:
    env, player = SenderEnv(Uplink(traces=(EPISODE.link.trace,), size_bytes=200_000), 3), Player(Policy("test", writer))
    env.reset(seed=0)
    with pytest.raises(ValueError, match="read-only"):
        for _ in range(9):
            env.step(player.action(env.rows.senders))


def test_marks_on_topics_are_on_a_copy() -> None:
    """With several topics kernels leave marks in what they are shown: their rows are no one else's."""
    arrivals = messages(np.arange(40) * 1_000, 4_000)
    arrivals["topic"] = np.arange(40) % 2
    episode = Episode(arrivals, EPISODE.link)
    rules = [Topic("a", limit=1), Topic("b", limit=1)]
    honest = run(Policy("test-honest", lambda buffer, arrival, memory: keep(buffer)), [episode], 3, V, topics=rules)
    lifted = run(Policy("test-writer", lifts_limits), [episode], 3, V, topics=rules)
    assert lifted.batch.senders.tobytes() == honest.batch.senders.tobytes()


def test_h_of_several_topics_is_added_up_again() -> None:
    """As honest as it was run, the sum stands; with anything added it does not."""
    arrivals = messages(np.arange(40) * 10_000, 4_000)
    arrivals["topic"] = np.arange(40) % 2
    rules = [Topic("a", weight=2.0), Topic("b", value=qoi.saturating(4))]
    policy = Policy("test-honest", lambda buffer, arrival, memory: keep(buffer))
    senders = run(policy, [Episode(arrivals, EPISODE.link)], 3, V, topics=rules)
    senders.check_untouched(policy)
    senders.batch.senders["delivered_gain"] += 1e-3
    with pytest.raises(BufgymError, match="H is not that of the messages that were received"):
        senders.check_untouched(policy)


@pytest.mark.parametrize("writer", WRITERS)
def test_a_compiled_policy_that_writes_has_no_result(writer: Any) -> None:
    told = f"policy test-writer: wrote to what it may only read: {WRITERS[writer]}"
    with pytest.raises((BufgymError, ValueError), match=f"{told}|read-only"):  # the latter without a compiler
        run(Policy("test-writer", writer, compile=True), [EPISODE], 3, V)
    with pytest.raises((BufgymError, ValueError), match=f"{told}|read-only"):
        cell = FleetEpisode((EPISODE.arrivals,) * 2, EPISODE.link)
        run_fleet(Policy("test-writer", writer, compile=True), [cell], 3, V)


def test_a_row_above_the_clairvoyant_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Were the bound a hundredth lower than what Drop Oldest reaches, a benchmark would say so and stop."""
    best = QueueTask.play

    def lowered(self: Any, policies: Any, *rest: Any) -> Any:
        for results in best(self, policies, *rest):
            yield [[{**row, "clairvoyant": 0.99 * row["qoi"]} for row in rows] for rows in results]

    monkeypatch.setattr(QueueTask, "play", lowered)
    told = r"^policy drop-oldest, L = 4, trace constant, seed 3: H = \S+ is above \S+, which no policy can reach$"
    with pytest.raises(BufgymError, match=told):
        bench.run([get("drop-oldest")], Uplink(traces=(EPISODE.link.trace,), duration_s=3), [4], [3])


def test_honest_policies_are_not_accused() -> None:
    """Among them one that drops at the head, and a link that ends with messages queued and in the socket."""
    lte = scenario.get("lte")
    episodes = [lte.draw(Streams.seeded(seed)) for seed in range(3)]
    ends = Link(Trace("ends", np.array([0, 20_000]), np.array([0, 20_000]), after="stop"))
    episodes.append(Episode(messages(np.arange(40) * 1_000, 4_000), ends))
    for name in ("drop-oldest", "codel", "afr", "random", "drop-newest"):
        run(get(name), episodes, 5, lte.value).check_untouched(get(name))
