"""A good plan for messages of unequal sizes: beam search along the episode, guided by the priced programme.

See docs/methods.md, "The search for a plan of unequal sizes".
"""

from typing import NamedTuple

import numpy as np

from bufgym.jit import Floats, Ints, kernel
from bufgym.model.qoi import value
from bufgym.oracle.programme import Problem, Room, waiting_cost


class States(NamedTuple):
    """The states at each message, best first; arrays over [messages, width]."""

    used: Ints  # [messages]: number of states in use
    end: Ints  # byte at which the message ends
    gain: Floats
    net: Floats  # gain less the prices paid
    promise: Floats  # rank of the state: ``net`` plus an upper bound of the gain to come
    parent: Ints  # [messages, width, 2]: the message sent before, and its state; -1 for none
    latest: Ints  # [messages]: the latest end of any state at this message or one before it


def new_states(messages: int, width: int) -> States:
    """Make room for ``width`` states at each message."""
    used, end, parent, latest = (np.zeros((messages, *rest), np.int64) for rest in ((), (width,), (width, 2), ()))
    gain, net, promise = np.zeros((3, messages, width))
    return States(used, end, gain, net, promise, parent, latest)


@kernel
def ends_too_early(p: Problem, i: int, e: int, j: int) -> bool:
    """Whether another message is worth sending between message i, which ends at byte e, and message j."""
    return bool(p.between[j] > i and e <= p.idle[j])


@kernel
def search(p: Problem, room: Room, states: States, plan: Ints) -> tuple[int, float]:
    """Find a good plan; return (length, gain) and write its messages to ``plan``, the last one first."""
    best_gain, best_message, best_state = 0.0, -1, -1
    for j in range(len(p.c)):
        states.used[j] = 0
        states.latest[j] = states.latest[j - 1] if j > 0 else 0
        if p.limit[j] < 0 or p.c[j] + p.size[j] > p.ends:
            continue
        if p.between[j] < 0:
            offer(p, room, states, j, -1, 0)
        for i in range(j - 1, -1, -1):
            if ends_too_early(p, i, states.latest[i], j):
                break
            for w in range(states.used[i]):
                offer(p, room, states, j, i, w)
        for w in range(states.used[j]):
            states.latest[j] = max(states.latest[j], states.end[j, w])
            if best_message < 0 or states.gain[j, w] > best_gain:
                best_gain, best_message, best_state = states.gain[j, w], j, w
    length = 0
    i, w = best_message, best_state
    while i >= 0:
        plan[length] = i
        length += 1
        i, w = states.parent[i, w, 0], states.parent[i, w, 1]
    return length, best_gain


@kernel
def offer(p: Problem, room: Room, states: States, j: int, i: int, w: int) -> None:
    """Add "message j after state ``w`` of message i" if j finds room and is among the best; i = -1 for none."""
    e = states.end[i, w] if i >= 0 else 0
    s = max(e, p.c[j])
    if s - p.c[j] > p.limit[j] or s + p.size[j] > p.ends or (i >= 0 and ends_too_early(p, i, e, j)):
        return
    added = value(p.v, p.x[j] - p.x[i]) if i >= 0 else 0.0
    net = added + (states.net[i, w] if i >= 0 else 0.0)
    if s > p.c[j]:
        net -= waiting_cost(p, room, j, s // p.grid)
    end = s + p.size[j]
    promise = net + p.future[j, end // p.grid - p.c[j] // p.grid]
    k, width = states.used[j], states.end.shape[1]
    if k == width and promise <= states.promise[j, k - 1]:
        return
    for other in range(k):
        if states.end[j, other] == end and states.net[j, other] == net:
            return  # equal in rank, end and gain
    if i >= 0 and not has_room(p, room, states, i, w, j):
        return
    k = min(k, width - 1)
    states.used[j] = k + 1
    while k > 0 and states.promise[j, k - 1] < promise:
        states.end[j, k], states.gain[j, k] = states.end[j, k - 1], states.gain[j, k - 1]
        states.net[j, k], states.promise[j, k] = states.net[j, k - 1], states.promise[j, k - 1]
        states.parent[j, k, 0], states.parent[j, k, 1] = states.parent[j, k - 1, 0], states.parent[j, k - 1, 1]
        k -= 1
    states.end[j, k], states.net[j, k], states.promise[j, k] = end, net, promise
    states.gain[j, k] = added + (states.gain[i, w] if i >= 0 else 0.0)
    states.parent[j, k, 0], states.parent[j, k, 1] = i, w


@kernel
def has_room(p: Problem, room: Room, states: States, i: int, w: int, j: int) -> bool:
    """Whether message j fits, by messages and by bytes, into the queue left by state ``w`` of message i."""
    queued, backlog = 1, p.size[j]
    # Messages begin in the order of sending: the last ones still wait.
    while i >= 0 and states.end[i, w] - p.size[i] > p.c[j]:
        queued += 1
        backlog += p.size[i]
        if queued > room.capacity or backlog > room.max_bytes:
            return False
        i, w = states.parent[i, w, 0], states.parent[i, w, 1]
    return queued <= room.capacity and backlog <= room.max_bytes
