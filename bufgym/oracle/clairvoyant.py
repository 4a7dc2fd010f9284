"""The clairvoyant: the best QoI that any policy could reach on an episode, knowing the whole link and workload.

See docs/methods.md, "The clairvoyant".
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import Floats, Ints, interruptible, kernel
from bufgym.model.buffer import ACCEPT, REJECT, UNLIMITED_BYTES, Buffer, check_limits
from bufgym.model.qoi import Value
from bufgym.oracle import labels, pieces, unequal
from bufgym.oracle.cached import Found, cached
from bufgym.oracle.interruption import evenly_kept
from bufgym.oracle.programme import NEVER, Messages
from bufgym.policies.registry import built_in
from bufgym.scenario import Episode
from bufgym.utils.errors import BufgymError

LONG = 1 << 16  # Messages from which on an episode is worked on in pieces
_SHORT = 2_000  # messages of an episode whose plan takes a fraction of a second on any link
_QUICK = 200  # messages of unequal sizes whose plan takes less


@dataclass(frozen=True)
class Plan:
    """The clairvoyant's decisions for one episode."""

    qoi: float
    """The best H, or an upper bound of it: no policy with this L and B reaches more."""
    kept: NDArray[np.bool_]
    """bool[messages]: True to accept a message, False to reject it at its arrival."""
    certified: bool
    """Whether these decisions, asked at every arrival, reach ``qoi``; if not, ``qoi`` is an upper bound."""


def clairvoyant(episode: Episode, capacity: int, v: Value, *, max_bytes: int | None = None) -> Plan:
    """The best plan for one episode under L = ``capacity`` messages and B = ``max_bytes`` bytes.

    Exact for equal sizes where every arrival asks for a decision, up to ``LONG`` messages; an upper bound otherwise
    (see ``Plan.certified``). Plans that take long are cached on disk (see ``cached``).
    """
    check_limits(capacity, max_bytes)
    episode.check_one_queue()
    arrivals = np.asarray(episode.arrivals)
    n = len(arrivals)
    c = episode.link.carried_by(arrivals["arrival_us"])
    size, x = np.ascontiguousarray(arrivals["size_bytes"]), np.ascontiguousarray(arrivals["x"])
    most_bytes = UNLIMITED_BYTES if max_bytes is None else max_bytes
    stream = c, size, x, episode.link.carries_bytes
    asked = slice(episode.first_decision, episode.last_decision + 1)

    def find() -> Found:
        return _plan(*stream, asked, min(capacity, n), most_bytes, v)

    if n < _QUICK or (n < _SHORT and (size == size[0]).all()):
        return Plan(*find())
    inputs = *stream, asked, min(capacity, n), most_bytes, v.array
    return Plan(*cached(inputs, n, lambda: interruptible(find)))


def _plan(c: Ints, size: Ints, x: Floats, ends: int, asked: slice, capacity: int, most_bytes: int, v: Value) -> Found:
    """Compute the plan for ``clairvoyant``; messages of ``asked`` ask for a decision."""
    n = len(c)
    if (size == size[0]).all():
        room = min(capacity, most_bytes // int(size[0]))
        limit = np.full(n, room * size[0] if room else NEVER)
        messages = Messages(c, size, limit, x, v.array, ends)
        sent, gain = labels.best(messages) if n < LONG else pieces.best(messages, limit, capacity, most_bytes)
    elif _fits(c, size, capacity, most_bytes, ends, np.empty(n, np.int64)):
        sent, gain = np.arange(n), v.information(x) - 1.0  # V is concave, so no plan beats sending all messages
    else:
        limit = np.empty(n, np.int64)
        _relaxed_limits(c, size, capacity, most_bytes, np.empty(n, np.int64), np.empty(capacity, np.int64), limit)
        # While no more bytes wait than in the L smallest messages, fewer than L messages wait.
        certain = np.minimum(np.minimum(limit, np.sort(size)[:capacity].sum()), most_bytes - size)
        find = unequal.best if n < LONG else pieces.best
        sent, gain = find(Messages(c, size, limit, x, v.array, ends), certain, capacity, most_bytes)
    plan = np.zeros(n, np.bool_)
    plan[sent] = True
    qoi = 1.0 + gain if len(sent) else 0.0
    reached = v.information(x[sent]) >= qoi - 1e-9
    fits = bool(_fits(c[sent], size[sent], capacity, most_bytes, ends, np.empty(len(sent), np.int64)))
    # Arrivals without a decision are accepted if there is room.
    undecided = ~plan
    undecided[asked] = False
    return qoi, plan, bool(reached and fits and not undecided.any())


@kernel
def _relaxed_limits(
    c: Ints, size: Ints, capacity: int, max_bytes: int, reach: Ints, largest: Ints, limit: Ints
) -> None:
    """Fill ``limit``: message i finds no room if more than ``limit[i]`` bytes have to pass before it.

    Before i pass the rest of the message in transmission and at most L - 1 queued ones. They have at most the bytes of
    the L largest messages that can still be on their way. Without the one in transmission they have at most B less the
    size of i. ``reach`` and ``largest`` are work space, int64[messages] and int64[L].
    """
    for i in range(len(c)):
        held = 0  # entries of ``largest`` in use, in falling order
        for j in range(i - 1, -1, -1):
            if reach[j] <= c[i]:
                break  # neither j nor any message before it can still be on its way
            if limit[j] < 0 or c[j] + limit[j] + size[j] <= c[i]:
                continue
            k = held
            while k > 0 and largest[k - 1] < size[j]:
                if k < capacity:
                    largest[k] = largest[k - 1]
                k -= 1
            if k < capacity:
                largest[k] = size[j]
                held = min(held + 1, capacity)
        limit[i] = 0
        for k in range(held):
            limit[i] += largest[k]
        if held > 0:
            limit[i] = min(limit[i], largest[0] + max_bytes - size[i])
        if size[i] > max_bytes:
            limit[i] = NEVER
        reach[i] = max(reach[i - 1] if i > 0 else 0, c[i] + limit[i] + size[i])


@kernel
def _fits(c: Ints, size: Ints, capacity: int, max_bytes: int, ends: int, leaves: Ints) -> bool:
    """Whether a sender with no other arrivals has room for each of these messages, and the link carries them all.

    Message k is queued until the link has carried ``leaves[k]`` bytes.
    """
    head, backlog, e = 0, 0, 0
    for k in range(len(c)):
        while head < k and leaves[head] <= c[k]:
            backlog -= size[head]
            head += 1
        if k - head + 1 > capacity or backlog + size[k] > max_bytes:
            return False
        backlog += size[k]
        leaves[k] = e
        e = max(c[k], e) + size[k]
    return bool(e <= ends)


def privileged(episode: Episode, capacity: int, max_bytes: int, v: Value) -> Floats:
    """The plan as a policy's memory: 1 for each message to keep."""
    limit = None if max_bytes >= UNLIMITED_BYTES else max_bytes
    return clairvoyant(episode, capacity, v, max_bytes=limit).kept.astype(np.float64)


@built_in("clairvoyant", privileged=privileged, source="bufgym.oracle.clairvoyant")
def follow(buffer: Buffer, arrival: Any, memory: Floats) -> int:
    """Knows the whole link and workload beforehand: the bound that no other policy exceeds."""
    return ACCEPT if memory[arrival.seq] > 0 else REJECT


def integer_plan(episode: Episode, capacity: int, max_bytes: int, v: Value) -> Floats:
    """Write ``evenly_kept`` as a policy's memory; raise unless the episode is one interruption."""
    arrivals = np.asarray(episode.arrivals)
    T, size = len(arrivals) - 2, int(arrivals["size_bytes"][0])
    stands = T >= 1 and episode.link.carried_by(arrivals["arrival_us"])[T] == 0
    even = (arrivals["x"] == np.arange(T + 2)).all() and (arrivals["size_bytes"] == size).all()
    if not (stands and even and (episode.first_decision, episode.last_decision) == (1, T)):
        raise BufgymError(
            "policy oracle: it plans for one interruption (scenario interruption, suite interruption-v1), not for this"
        )
    kept = np.zeros(T + 2)
    kept[evenly_kept(min(capacity, max_bytes // size), T)] = 1.0
    return kept


built_in(
    "oracle",
    privileged=integer_plan,
    named_only=True,
    source="AFR paper, Sec. III-C, in whole numbers",
    about="Knows T beforehand: the best whole-numbered gaps in one interruption, the only place where it plays.",
)(follow)
