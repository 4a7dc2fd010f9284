"""Topics of a relay's queue, by name or by pattern, in the order of their numbers."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any, Final

from bufgym.model.topics import MAX_TOPICS, Topic
from bufgym.scenario import Client, Stream
from bufgym.utils.errors import BufgymError
from bufgym_robot.ros2.names import resolved

MOST_BY_PATTERN: Final = 64
"""Topics that one pattern stands for at most; fewer where all places together would be more than ``MAX_TOPICS``."""
_NOT_BY_PATTERN: Final = ("/rosout", "/parameter_events", "/clock", "/tf", "/diagnostics")


@dataclass
class Place:
    """A topic's number in the queue, taken by one topic: the one that is named, or one that the pattern fits."""

    topic: Topic
    """Rules of the number."""
    wanted: str
    """Name or pattern that the user gave."""
    stream: Stream | None
    """Publisher in the user's configuration; None for a topic named without one."""
    name: str | None = None
    """Name with its namespace, once it is known."""
    _now_ns: int = 0  # time since the first message by the node's clock, which a simulation may set back
    _began_ns: int | None = None

    @property
    def by_pattern(self) -> bool:
        return any(sign in self.wanted for sign in "*?[")

    def resolve(self, node: Any) -> None:
        """Apply the node's namespace and remappings; ROS 2 remaps no patterns."""
        if not self.by_pattern:
            self.name = resolved(node, self.wanted)
        elif not self.wanted.startswith("/"):
            self.wanted = f"{node.get_namespace().rstrip('/')}/{self.wanted}"

    def find(self, names: Iterable[str], taken: Sequence[str | None]) -> None:
        """Take the first of these topics that the pattern fits and no other number has."""
        if self.name is None:
            self.name = next((name for name in names if name not in taken and self.fits(name)), None)

    def fits(self, name: str) -> bool:
        """Whether the pattern fits this topic and ROS 2 does not keep the topic for itself."""
        return name not in _NOT_BY_PATTERN and fnmatchcase(name, self.wanted)

    def x(self, node: Any, moved: float | None) -> float | None:
        """Coordinate of a message now; None where messages are counted. ``moved`` is the robot's motion, if known."""
        if self.stream is None or self.stream.moves:
            return moved
        now_ns = node.get_clock().now().nanoseconds
        if self._began_ns is None:
            self._began_ns = now_ns
        self._now_ns = max(self._now_ns, now_ns - self._began_ns)
        return self._now_ns / 1e9 * self.stream.unit_hz


def places(client: Client | None, topics: Sequence[str], moves: bool) -> list[Place]:
    """Number a client's topics, then the other ``topics``.

    Raises:
        BufgymError: there is none, or a topic moves and nothing tells how.
    """
    streams = () if client is None else client.streams
    moving = [stream.topic.name for stream in streams if stream.moves]
    if moving and not moves:
        raise BufgymError(f"topic {moving[0]!r}: moves, which needs a topic with odometry")
    ruled = {stream.topic.name for stream in streams}
    wanted = [Place(stream.topic, stream.topic.name, stream) for stream in streams]
    wanted += [Place(Topic(name), name, None) for name in topics if name not in ruled]
    patterns = sum(one.by_pattern for one in wanted)
    most = min(MOST_BY_PATTERN, max(1, (MAX_TOPICS - len(wanted) + patterns) // max(1, patterns)))
    found = [place for one in wanted for place in _numbered(one, most)]
    if not found:
        raise BufgymError(
            "no topics: name them in --config, or after --ros-args as -p topics:=\"['/camera', '/scan*']\""
        )
    return found


def _numbered(one: Place, most: int) -> Iterator[Place]:
    for k in range(1, most + 1 if one.by_pattern else 2):
        yield replace(one, topic=replace(one.topic, name=f"{one.wanted} {k}")) if one.by_pattern else one


def left_out(places: Sequence[Place], names: Iterable[str]) -> dict[str, str]:
    """Why a topic that a pattern fits has no place, for each such topic of these."""
    taken = {place.name for place in places}
    numbers = Counter(place.wanted for place in places if place.by_pattern)
    return {
        name: f"{wanted} stands for {most} topics at most: name it in topics, or split the pattern"
        for wanted, most in numbers.items()
        for name in names
        if name not in taken and next(one for one in places if one.wanted == wanted).fits(name)
    }
