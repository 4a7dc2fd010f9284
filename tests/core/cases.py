"""Random episodes for the tests, each in two forms: for the package and for its slow reference models in ``naive``."""

from dataclasses import dataclass
from typing import Any

import naive
import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from bufgym.jit import records
from bufgym.model import qoi
from bufgym.model.buffer import ACCEPT, MESSAGE, NO_PARAMETERS, NO_PAST, REJECT, TOPIC, UNLIMITED_BYTES, Buffer
from bufgym.model.link import FOREVER, Link
from bufgym.policies import Policy
from bufgym.scenario import Episode, messages
from bufgym.sim import Senders
from bufgym.sim.state import NEVER
from bufgym.traces import Trace


def decide_anything(buffer: Any, arrival: Any, memory: Any) -> int:
    """Decides at random, invalid decisions included."""
    return int(arrival.uniform * (buffer.capacity + 4)) - 2


# The reference draws from [accept, reject, 0, 1, ..., L + 1]: floor(uniform x (L + 4)) - 2; ACCEPT is -2, REJECT -1.
assert (ACCEPT, REJECT) == (-2, -1)
ANYTHING = Policy("test-anything", decide_anything, compile=True)


def watched(what: Any, decide: Any = lambda buffer, arrival, memory: ACCEPT) -> tuple[Policy, list[Any]]:
    """(a policy in Python that decides so, what(buffer, arrival) at each of its decisions)."""
    seen: list[Any] = []

    def on_arrival(buffer: Any, arrival: Any, memory: Any) -> int:
        seen.append(what(buffer, arrival))
        return int(decide(buffer, arrival, memory))

    return Policy("watched", on_arrival), seen


def queue_of(s: int, capacity: int, parameters: NDArray[np.float64] = NO_PARAMETERS) -> Buffer:
    """What a policy sees of s queued messages without bytes to speak of; the rest is 0."""
    fields: dict[str, Any] = dict.fromkeys(Buffer._fields, 0)
    fields.update(slots=records(s, MESSAGE), topics=records(1, TOPIC), v=qoi.exponential(0.5).array)
    fields.update(
        past=NO_PAST, capacity=capacity, max_bytes=UNLIMITED_BYTES, remaining_us=FOREVER, parameters=parameters
    )
    return Buffer(**fields)


def newcomer() -> Any:
    """A MESSAGE of one byte."""
    made = np.zeros(1, MESSAGE).view(np.recarray)
    made["size_bytes"] = 1
    return made[0]


@dataclass
class Case:
    """One episode, its limits, and the same for the reference model."""

    episode: Episode
    reference_messages: list[dict[str, Any]]
    knots: list[tuple[int, int]]
    capacity: int
    max_bytes: int | None
    decide_at: str

    def senders(self, v: qoi.Value, topics: Any = ()) -> Senders:
        limits = {"max_bytes": self.max_bytes, "decide_at": self.decide_at, "topics": topics}
        senders = Senders(1, self.capacity, v, max_messages=len(self.episode.arrivals), **limits)
        senders.load(0, self.episode)
        return senders

    def run(self, policy: Policy, v: qoi.Value) -> Senders:
        senders = self.senders(v)
        senders.run(policy)
        return senders

    def run_reference(self, policy: naive.Policy) -> naive.Sender:
        link = naive.Link(self.knots, self.episode.link.trace.after, self.episode.link.offset_us)
        sender = naive.Sender(link, policy, self.capacity, self.max_bytes, self.decide_at)
        return sender.run(self.reference_messages, self.episode.first_decision, self.episode.last_decision)


@st.composite
def traces(draw: st.DrawFn) -> tuple[list[tuple[int, int]], str]:
    """Knots with outages among them, and what follows the end."""
    steps = st.tuples(st.integers(1_000, 60_000), st.one_of(st.just(0), st.integers(500, 20_000)))
    after = draw(st.sampled_from(["loop", "hold", "stop"]))
    knots = [(0, 0)]
    for us, carried in draw(st.lists(steps, min_size=1, max_size=6)):
        knots.append((knots[-1][0] + us, knots[-1][1] + carried))
    if after == "loop" and knots[-1][1] == 0:
        knots.append((knots[-1][0] + 5_000, 2_000))
    return knots, after


def trace(knots: list[tuple[int, int]], after: str) -> Trace:
    us, size = zip(*knots, strict=True)
    return Trace("random", np.array(us, np.int64), np.array(size, np.int64), after=after)


def drawn_messages(rng: np.random.Generator, n: int, largest: int, arrival_us: Any = None) -> NDArray[Any]:
    """n messages of less than ``largest`` bytes, several at the same time among them; x in eighths: exact sums."""
    step_us = rng.choice([0, 1, 700, 5_000], n) + rng.integers(0, 3_000, n) * rng.integers(0, 2, n)
    arrival_us = np.cumsum(step_us) if arrival_us is None else arrival_us
    arrivals = messages(arrival_us, rng.integers(1, largest, n), np.cumsum(rng.integers(0, 5, n)) / 8)
    arrivals["uniform"] = rng.random(n)
    return arrivals


def reference_messages(arrivals: NDArray[Any]) -> list[dict[str, Any]]:
    """MESSAGE[n] as the reference models have it."""
    fields = {"seq": "seq", "us": "arrival_us", "bytes": "size_bytes", "topic": "topic", "x": "x", "uniform": "uniform"}
    return [{name: a[field].item() for name, field in fields.items()} for a in np.asarray(arrivals)]


@st.composite
def cases(draw: st.DrawFn, max_bytes: bool = True, max_messages: int = 40) -> Case:
    """Arrivals with equal times among them, sizes around 2 kB, coordinates in eighths, so that their sums are exact."""
    n = draw(st.integers(1, max_messages))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    arrivals = drawn_messages(rng, n, draw(st.sampled_from([2, 4_000])))
    arrivals["topic"] = rng.integers(0, 3, n)
    knots, after = draw(traces())
    link = Link(trace(knots, after), draw(st.integers(0, 3 * knots[-1][0])), draw(st.integers(0, 30_000)))
    first = draw(st.sampled_from([0, 0, 3]))
    last = draw(st.sampled_from([2**31, n // 2]))
    return Case(
        Episode(arrivals, link, first, last),
        reference_messages(arrivals),
        knots,
        draw(st.integers(1, 6)),
        draw(st.one_of(st.none(), st.integers(1_000, 15_000))) if max_bytes else None,
        draw(st.sampled_from(["arrival", "overflow"])),
    )


VALUES = st.one_of(
    st.floats(0.05, 0.99).map(qoi.exponential),
    st.floats(0.1, 30).map(qoi.saturating),
    st.lists(st.floats(0.01, 1), min_size=1, max_size=5).map(
        # Slopes that fall, at whole distances: concave; divided by their sum: at most 1.
        lambda s: qoi.tabulated(
            range(len(s) + 1), np.minimum(1, np.concatenate([[0], np.cumsum(sorted(s)[::-1])]) / sum(s))
        )
    ),
)


def log(senders: Senders, i: int = 0) -> dict[str, dict[int, int]]:
    """{"dequeued_us": {sequence number: time}, ...}, of what happened at all."""
    rows = np.asarray(senders.batch.log[i])[: int(senders.batch.senders[i]["arrivals"])]
    names = ("dequeued_us", "transmitted_us", "dropped_us")
    return {name: {k: int(us) for k, us in enumerate(rows[name]) if us != NEVER} for name in names}


def reference_log(reference: Any) -> dict[str, dict[int, int]]:
    """The same of a reference model."""
    return {"dequeued_us": reference.dequeued, "transmitted_us": reference.transmitted, "dropped_us": reference.dropped}


def order(senders: Senders, i: int = 0) -> list[int]:
    """Sequence numbers in the order in which the link carried them."""
    return senders.batch.order[i, : senders.batch.senders[i]["transmitted"]].tolist()


def same(a: Senders, b: Senders) -> bool:
    """Whether both batches ended with the same logs and the same information, bit for bit."""
    rows, others = np.asarray(a.batch.senders), np.asarray(b.batch.senders)
    return bool(
        (np.asarray(a.batch.log) == np.asarray(b.batch.log)).all()
        and (a.batch.order == b.batch.order).all()
        and all((rows[f] == others[f]).all() for f in ("delivered_gain", "retained_gain", "evicted", "rejected"))
    )
