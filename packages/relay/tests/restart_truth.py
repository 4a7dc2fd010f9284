"""What is said and done while all parties restart at random moments, and what must not be."""

from collections import Counter
from dataclasses import dataclass, field

from bufgym_robot.wire.ledger import named

DEADLINE_S = 0.5
LATE_S = 0.8
"""An age at which no goal begins: its deadline, and what the test itself takes."""
OPEN = ("nobody knows", "withdrawn", "the client has ended")
"""Errors of a goal that was executed, or not: its sender said a stop or ended meanwhile, or nobody can tell."""


@dataclass
class Goal:
    """A goal, when it was sent, and its answer: empty if it was executed."""

    sent_s: float
    answer: str | None = None


@dataclass
class Said:
    """A stop: when ``stop`` returned, and when somebody began to release it and had done so."""

    returned_s: float
    begun_s: float | None = None
    released_s: float | None = None


@dataclass
class Truth:
    """What was said, what the robot did, and what must not be."""

    goals: dict[str, Goal] = field(default_factory=dict)
    stops: dict[str, Said] = field(default_factory=dict)
    released: list[str] = field(default_factory=list)
    """Stops of which somebody has begun the release."""
    begun: Counter[str] = field(default_factory=Counter)
    done: Counter[str] = field(default_factory=Counter)
    counts: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    late_s: float = LATE_S
    linear: float = 0.0
    """The last velocity ahead, at which the robot moves until it hears another, whatever happens to its client."""

    def covered(self, ids: list[str]) -> list[Said]:
        """The stops that a release of these covers."""
        return [said for id, said in self.stops.items() if covers(ids, id)]

    def began(self, id: str, at_s: float, stands: bool) -> None:
        """Take note of a goal that the robot began at ``at_s``; ``stands`` says whether a stop held there."""
        self.begun[id] += 1
        self.counts["goals executed"] += 1
        if self.begun[id] > 1:
            self.wrong.append(f"twice: goal {id}")
        if stands:
            self.wrong.append(f"goal {id} while a stop holds at the robot")
        if (goal := self.goals.get(id)) is None:
            self.wrong.append(f"late: goal {id}, of a round that was over")
            return
        if at_s - goal.sent_s > self.late_s:
            self.wrong.append(f"late: goal {id} after {at_s - goal.sent_s:.2f} s")
        for stop, said in self.stops.items():
            if said.returned_s <= goal.sent_s and (said.begun_s is None or said.begun_s > at_s):
                self.wrong.append(f"goal {id}, sent after stop {stop} returned, which nobody has released")

    def moved(self, linear: float, stands: bool) -> None:
        """Take note of a velocity ahead."""
        self.linear = linear
        self.counts["velocities" if linear else "zeros"] += 1
        if linear and stands:
            self.wrong.append(f"velocity {linear} while a stop holds at the robot")

    def standing(self) -> list[str]:
        """The stops that returned, and of which nobody has begun the release."""
        return [id for id, said in self.stops.items() if said.begun_s is None]


def covers(ids: list[str], id: str) -> bool:
    """Whether one of these is the stop, or a later one of the same who."""
    who, number = named(id)
    return any(named(one)[0] == who and named(one)[1] >= number for one in ids)
