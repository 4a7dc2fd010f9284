"""Robots in one cell: the same camera on each, each with its own motion, and one link that they share."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bufgym.model.checks import whole
from bufgym.model.link import Link
from bufgym.model.qoi import Value
from bufgym.model.topics import Topic
from bufgym.scenario import registry
from bufgym.scenario.arrivals import check_messages, read_only, sealed
from bufgym.scenario.episode import Episode, Streams, check_end, check_link
from bufgym.scenario.texts import links_by_name
from bufgym.scenario.uplink import Uplink
from bufgym.utils.errors import BufgymError

MAX_ROBOTS = 256
"""Most robots of a cell."""


@dataclass(frozen=True, eq=False)
class FleetEpisode:
    """One drawn episode of a cell, checked when it is made like an ``Episode``; nothing in it is random any more."""

    arrivals: tuple[NDArray[Any], ...]
    """MESSAGE[n] of each robot, read-only, in order of arrival."""
    link: Link
    """The cell's link, shared by all."""
    ends_us: int | None = None
    """Time at which each robot was told that its stream ends, as in ``Episode``."""

    def __post_init__(self) -> None:
        whole("robots", len(self.arrivals), 1, MAX_ROBOTS)
        check_end(self.ends_us)
        check_link(self.link)
        robots, last_us, total_bytes = [], 0, 0
        for i, arrivals in enumerate(self.arrivals):
            try:
                robots.append(sealed(arrivals))
                total_bytes += check_messages(robots[i])[0]
            except BufgymError as error:
                raise BufgymError(f"arrivals of robot {i}: {error}") from None
            last_us = max(last_us, int(robots[i]["arrival_us"][-1]))
        self.link.check_reach(last_us, total_bytes)
        object.__setattr__(self, "arrivals", tuple(robots))

    @property
    def robots(self) -> int:
        """N."""
        return len(self.arrivals)

    @property
    def ticks_together(self) -> bool:
        """Whether all messages of all robots arrive at the same times: one frame tick, one message each."""
        first = self.arrivals[0]["arrival_us"]
        return all(np.array_equal(first, arrivals["arrival_us"]) for arrivals in self.arrivals)

    def episode(self, robot: int) -> Episode:
        """The episode of one robot as if it had the cell to itself."""
        return Episode(self.arrivals[robot], self.link, ends_us=self.ends_us)

    def with_uniforms(self, rng: np.random.Generator) -> FleetEpisode:
        """The same episode with a fresh uniform draw beside each arrival, for randomised policies."""
        arrivals = [self.episode(i).with_uniforms(rng).arrivals for i in range(self.robots)]
        return replace(self, arrivals=tuple(arrivals))


@dataclass(frozen=True)
class FleetScenario:
    """``robots`` robots in one cell, each with the stream of ``uplink``.

    The cameras tick together: frame k of every robot arrives at the same time, so one step of an environment is one
    tick. Jitter moves the tick, not one robot's frame. Sizes and motion are each robot's own: a recording chosen at
    random for each, from a random offset on. The cell is one of ``uplink.traces`` times ``uplink.scale`` times
    ``robots``. With a factor of 1 each robot has on average the capacity of ``uplink`` alone, so the load is the same
    for any number of robots. A fleet of one meets exactly the episodes of ``uplink``.
    """

    robots: int = 4
    """N."""
    uplink: Uplink = field(default_factory=lambda: _uplink("lte"))
    """The uplink that each robot would have alone."""

    topics: ClassVar[tuple[Topic, ...]] = ()
    """Empty: one queue for each robot."""

    def __post_init__(self) -> None:
        whole("robots", self.robots, 1, MAX_ROBOTS)
        if not isinstance(self.uplink, Uplink):
            raise BufgymError(f"uplink: {self.uplink!r} is not a bufgym.scenario Uplink")
        if self.uplink.workload is not None:
            raise BufgymError("uplink: a fleet's streams are drawn; it can't play one robot's workload on all of them")

    @staticmethod
    def of(robots: int, scenario: str | Uplink | FleetScenario = "lte", **parameters: Any) -> FleetScenario:
        """Make a fleet of ``robots`` robots with the stream of that scenario and changed ``parameters``."""
        uplink = scenario.uplink if isinstance(scenario, FleetScenario) else scenario
        return FleetScenario(robots, _uplink(uplink, **parameters))

    @property
    def about(self) -> str:
        """The size of the cell, and its links."""
        return f"{self.robots} robots in a cell over {links_by_name(self.uplink.traces, self.uplink.scale[0])}"

    @property
    def value(self) -> Value:
        """V for each robot's QoI."""
        return self.uplink.value

    @property
    def max_messages(self) -> int:
        """Most arrivals of any robot."""
        return self.uplink.max_messages

    def draw(self, streams: Streams) -> FleetEpisode:
        """Draw one episode."""
        first = self._cell.draw(streams)
        ticks_us = first.arrivals["arrival_us"]
        others = [read_only(self.uplink.stream(streams.arrival, robot, ticks_us)) for robot in range(1, self.robots)]
        return FleetEpisode((first.arrivals, *others), first.link, first.ends_us)

    @functools.cached_property
    def _cell(self) -> Uplink:
        """The first robot's stream over the cell's link."""
        return replace(self.uplink, scale=tuple(s * self.robots for s in self.uplink.scale))


def _uplink(spec: str | Uplink, **parameters: Any) -> Uplink:
    scenario = registry.get(spec, **parameters)
    if not isinstance(scenario, Uplink):
        raise BufgymError(f"scenario {spec!r}: a fleet needs an Uplink, whose link goes on; it is {scenario!r}")
    return scenario
