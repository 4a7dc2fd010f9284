"""The content of a picture of one sender, read from the sender's arrays."""

import string
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from bufgym.envs.output import delivered_qoi
from bufgym.sim import Senders
from bufgym.sim.state import ARRIVAL_WAITS, SOCKET_WAITS

DELIVERED, SENDING, QUEUED, DROPPED, NEWCOMER = range(5)  # States of a message
NO_ACTIONS: NDArray[np.int64] = np.zeros(0, np.int64)
STATES = ("delivered", "in transmission", "queued", "dropped", "newcomer")


class Scene(NamedTuple):
    """The content of a picture of one sender.

    Fields:
        now_us: the sender's clock, us.
        arrivals: MESSAGE[m], the messages that have arrived so far, the newcomer last.
        states: int64[m], the state of each arrival.
        queue: int64[queued], sequence numbers of the queued messages, 0 = oldest.
        dequeued: sequence number of the message that the socket took last; -1 if none.
        capacity: L, messages.
        demand: bytes that arrive per second; 0 for a single message, which has no rate.
        counts: messages in each state but the newcomer's, by the state's name.
        qoi: H of the messages delivered so far.
        topics: names of the topics; empty for one queue.
        question: who asks for a decision; empty for one queue, or if nobody asks.
        actions: slot -> the action that drops it, L for the newcomer and L + 1 for accepting it; of several actions the
            first. Empty where actions are slots, or if no arrival asks.
    """

    now_us: int
    arrivals: NDArray[Any]
    states: NDArray[np.int64]
    queue: NDArray[np.int64]
    dequeued: int
    capacity: int
    demand: float
    counts: dict[str, int]
    qoi: float
    topics: tuple[str, ...]
    question: str
    actions: dict[int, int]

    @property
    def newcomers(self) -> list[int]:
        """The sequence number of the newcomer; empty if no arrival waits."""
        return [len(self.arrivals) - 1] if self.states[-1] == NEWCOMER else []

    def letter(self, seq: int) -> str:
        """The letter of a message's topic."""
        return letter(int(self.arrivals["topic"][seq]))

    def missing(self) -> list[tuple[int, int]]:
        """Sequence number of each queued message and the newcomer, in order, and the number missing before it."""
        seqs = [*self.queue.tolist(), *self.newcomers]
        return [(seq, seq - before - 1) for seq, before in zip(seqs, [self.dequeued, *seqs], strict=False)]


def letter(topic: int) -> str:
    """A letter for a topic, used where its name has no room."""
    return string.ascii_letters[topic % 52]


def scene_of(senders: Senders, i: int, slot_actions: NDArray[np.int64] = NO_ACTIONS) -> Scene:
    """The scene of sender ``i``; ResetNeeded if it has no episode."""
    episode = senders.episodes[i]
    if episode is None:
        raise gym.error.ResetNeeded("call reset() before render()")
    sender, planned = senders.batch.senders[i], episode.arrivals
    arrived, waiting = int(sender["next"]), int(sender["waiting"])
    known = arrived + (waiting == ARRIVAL_WAITS)
    log = senders.batch.log[i, :known]
    states = np.full(known, QUEUED)
    states[log["dequeued_us"] >= 0] = SENDING
    states[log["transmitted_us"] >= 0] = DELIVERED
    states[log["dropped_us"] >= 0] = DROPPED
    states[arrived:] = NEWCOMER
    first, slots = int(sender["first"]), senders.batch.slots["seq"][i]
    span_us = int(planned["arrival_us"][-1] - planned["arrival_us"][0])
    questions = {ARRIVAL_WAITS: "an arrival asks", SOCKET_WAITS: "the socket asks"} if senders.topics else {}
    return Scene(
        now_us=int(sender["now_us"]),
        arrivals=planned[:known],
        states=states,
        queue=slots[first : first + int(sender["occupancy"])].copy(),
        dequeued=int(slots[first - 1]) if sender["dequeued"] > 0 else -1,
        capacity=senders.capacity,
        # n messages span n - 1 periods.
        demand=1e6 * float(planned["size_bytes"][:-1].sum()) / span_us if span_us > 0 else 0.0,
        counts={name: int((states[:arrived] == state).sum()) for state, name in enumerate(STATES[:NEWCOMER])},
        qoi=delivered_qoi(senders.batch, i),
        topics=tuple(topic.name for topic in senders.topics),
        question=questions.get(waiting, ""),
        actions={int(slot_actions[a]): a for a in reversed(range(len(slot_actions))) if waiting == ARRIVAL_WAITS},
    )


def link_rates(senders: Senders, i: int, edges_us: NDArray[np.int64]) -> NDArray[np.float64]:
    """Mean link capacity of sender ``i`` between neighbouring ``edges_us``, bytes per second."""
    episode = senders.episodes[i]
    assert episode is not None
    return 1e6 * np.diff(episode.link.carried_by(edges_us).astype(np.float64)) / np.maximum(1, np.diff(edges_us))
