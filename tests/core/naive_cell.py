"""The slow, obvious reference model of ``bufgym.sim``: robots that share a link byte by byte, with lists and fractions.

``whole=True`` shares whole bytes, as the package does, and must agree with it exactly. ``whole=False`` is processor
sharing itself: every byte is divided, however small the shares.
"""

import math
from fractions import Fraction

import naive


class Robot(naive.Sender):
    """A sender whose message in transmission has so many bytes ``left``; when they cross is the cell's affair."""

    def __init__(self, cell, policy, *limits):
        super().__init__(cell, policy, *limits)
        self.cell, self.left = cell, 0

    def dequeue(self, message, position):
        if position is None and not self.cell.busy():
            self.cell.position = max(self.cell.position, self.cell.reached(self.now))
        self.cell.starts += 1
        self.left = Fraction(message["bytes"])
        super().dequeue(message, 0)

    def left_bytes(self):
        return self.left if self.socket else 0


class Cell:
    """``link``: a ``naive.Link``; ``policies``: one a robot."""

    def __init__(self, link, policies, capacity, max_bytes=None, decide_at="arrival", whole=True):
        self.link, self.whole = link, whole
        self.robots = [Robot(self, policy, capacity, max_bytes, decide_at) for policy in policies]
        self.position = Fraction(0)  # bytes of the link given out
        self.starts = 0

    def first_time(self, position):
        """No robot knows when its message will have crossed."""
        return None

    def busy(self):
        return [robot for robot in self.robots if robot.socket]

    def run(self, messages):
        """``messages``: a list for each robot."""
        before = None
        for now, i, _, message in sorted((m["us"], i, m["seq"], m) for i, mine in enumerate(messages) for m in mine):
            if now != before:
                self.advance(now)
                self.give_until(now)
            before = self.robots[i].now = now
            self.robots[i].arrive(message, True)
        self.advance(math.inf)
        return self

    def reached(self, now):
        exact = self.link.bytes_by(now)
        return Fraction(math.floor(exact)) if self.whole else exact

    def advance(self, until):
        """All that finishes up to and including ``until`` leaves; successors start at the byte where it ended."""
        while busy := self.busy():
            least = min(robot.left for robot in busy)
            position = self.position + least * len(busy)
            now = self.link.first_time(position)
            if now is None or now > until:
                return
            self.position = position
            for robot in busy:
                robot.left -= least
            for robot in [robot for robot in busy if robot.left == 0]:
                robot.now = now
                robot.crossed()

    def give_until(self, now):
        """Each busy robot gets its share of what the link has carried by now."""
        if busy := self.busy():
            each = (self.reached(now) - self.position) / len(busy)
            if self.whole:
                each = Fraction(math.floor(each))
            for robot in busy:
                robot.left -= each
            self.position += each * len(busy)
