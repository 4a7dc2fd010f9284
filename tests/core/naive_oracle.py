"""The best H of all decision sequences, by trying every one on the plain-Python sender of ``naive``."""

import copy
import functools
import math

import naive
from naive_sender import ACCEPT, REJECT, Rules, Sender


class Link(naive.Link):
    """The same link, which remembers what it was asked."""

    def __init__(self, *described):
        super().__init__(*described)
        self.bytes_by = functools.cache(super().bytes_by)
        self.first_time = functools.cache(super().first_time)


def fork(sender):
    """A copy whose future does not touch this one's."""
    reference = copy.copy(sender)
    for name, held in vars(sender).items():
        if isinstance(held, dict):
            setattr(reference, name, held.copy())
        elif isinstance(held, list):
            setattr(reference, name, [each.copy() if isinstance(each, list) else each for each in held])
    return reference


def best(link, messages, capacity, v, max_bytes=None, decide_at="arrival", first_decision=0, last_decision=math.inf):
    """The highest H that any sequence of decisions reaches, each slot to evict, REJECT and ACCEPT tried at each."""
    x, known = [m["x"] for m in messages], {}

    def options(sender, message):
        fits = sender.fits(message)
        if message["bytes"] > sender.max_bytes:
            return [REJECT]
        asked = first_decision <= message["seq"] <= last_decision
        if not asked or (fits and decide_at == "overflow"):
            return [ACCEPT]
        return [REJECT, *([ACCEPT] if fits else []), *range(len(sender.queues[0]))]

    def added(before, after):
        """What the messages received since then have added to H."""
        return naive.information(v, [x[k] for k in after]) - naive.information(v, [x[k] for k in before])

    def from_here(sender, n):
        """The most that H can still grow once ``n`` messages have been decided on."""
        sending = [sent.message["seq"] for sent in sender.socket]
        state = (n, *(m["seq"] for m in sender.queues[0]), None, *sending, sender.position, *sender.order[-1:])
        if state not in known:
            known[state] = decided(sender, n)
        return known[state]

    def decided(sender, n):
        before = list(sender.order)
        sender = fork(sender)
        if n == len(messages):
            sender.advance(math.inf)
            return added(before, sender.order)
        message = messages[n]
        sender.advance(message["us"])
        sender.now, most = message["us"], -math.inf
        for decision in options(sender, message):
            after = fork(sender)
            settled = after.carry_out(decision, message)
            if settled:
                after.offer()
            most = max(most, from_here(after, n + settled))
        return added(before, sender.order) + most

    return from_here(Sender(link, Rules(None), capacity, max_bytes=max_bytes, decide_at=decide_at), 0)


def best_by_bytes(c, size, limit, x, v, ends):
    """The highest H - 1 under the rules of ``bufgym.oracle.labels``: of all ways to send i last and end at byte e."""
    ways = {}
    for i in range(len(c)):
        here = {c[i] + size[i]: 0.0} if limit[i] >= 0 else {}
        for (j, e), gain in ways.items():
            begin = max(e, c[i])
            if begin - c[i] <= limit[i]:
                here[begin + size[i]] = max(here.get(begin + size[i], 0.0), gain + v(x[i] - x[j]))
        ways |= {(i, e): gain for e, gain in here.items() if e <= ends}
    return max(ways.values(), default=0.0)
