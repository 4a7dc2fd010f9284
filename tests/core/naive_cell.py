"""The slow, obvious twin of ``bufgym.sim``: robots that share a link byte by byte, with lists and fractions.

``whole=True`` shares whole bytes, as the package does, and must agree with it exactly. ``whole=False`` is processor
sharing itself: every byte is divided, however small the shares.
"""

from __future__ import annotations

import math
from fractions import Fraction

import naive


class Robot(naive.Sender):
    """A sender whose message in transmission has so many bytes left; when they cross is the cell's affair."""

    left = 0

    def first_time(self, position):
        return None

    def take_head(self, now, position=0):
        super().take_head(now, position)
        self.left = Fraction(self.sending["bytes"]) if self.sending is not None else 0

    def left_bytes(self, now):
        return self.left if self.sending is not None else 0


class Cell:
    """``link``: a ``naive.Link``; ``policies``: one a robot."""

    def __init__(self, link, policies, capacity, max_bytes=None, decide_at="arrival", whole=True):
        self.link, self.whole = link, whole
        self.robots = [Robot(None, policy, capacity, max_bytes, decide_at) for policy in policies]
        for robot in self.robots:
            robot.link = robot
        self.position = Fraction(0)  # bytes of the link given out
        self.starts = 0

    def busy(self):
        return [robot for robot in self.robots if robot.sending is not None]

    def run(self, messages):
        """``messages``: a list for each robot."""
        arrivals = sorted((m["us"], i, m["seq"], m) for i, mine in enumerate(messages) for m in mine)
        before = None
        for now, i, _, message in arrivals:
            if now != before:
                self.advance(now)
                self.give_until(now)
            before = now
            robot = self.robots[i]
            robot.settle(message, robot.decide_at == "arrival" or not robot.fits(robot.queue, message))
            if robot.sending is None and robot.queue:
                if not self.busy():
                    self.position = max(self.position, self.reached(now))
                self.start(robot, now)
        self.advance(math.inf)
        return self

    def reached(self, now):
        exact = self.link.bytes_by(now)
        return Fraction(math.floor(exact)) if self.whole else exact

    def start(self, robot, now):
        self.starts += 1
        robot.take_head(now)

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
                seq = robot.sending["seq"]
                robot.transmitted[seq] = now
                robot.order.append(seq)
                robot.sending = None
                if robot.queue:
                    self.start(robot, now)

    def give_until(self, now):
        """Each busy robot gets its share of what the link has carried by now."""
        busy = self.busy()
        if busy:
            each = (self.reached(now) - self.position) / len(busy)
            if self.whole:
                each = Fraction(math.floor(each))
            for robot in busy:
                robot.left -= each
            self.position += each * len(busy)
