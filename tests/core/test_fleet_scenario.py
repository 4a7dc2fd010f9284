"""What meets the robots of a cell, and input that a fleet refuses."""

from __future__ import annotations

import numpy as np
import pytest
from cases import trace

from bufgym import policies, scenario
from bufgym.errors import BufgymError
from bufgym.model import qoi
from bufgym.model.buffer import ACCEPT, MESSAGE
from bufgym.model.link import Link
from bufgym.scenario import FleetEpisode, FleetScenario, Streams, Uplink, messages
from bufgym.sim import Senders
from bufgym.sim.cell import Fleet, run_fleet
from bufgym.traces import shipped
from bufgym.traces.workload import Workload

V = qoi.exponential(0.5)
US = trace([(0, 0), (1_000_000, 1_000_000)], "loop")
"""1 byte a microsecond."""


def accept(buffer, arrival, memory):
    return ACCEPT


ACCEPTS = policies.Policy("test-accept", accept, compile=True)


def test_a_fleet_of_one_meets_the_episodes_of_its_uplink():
    uplink = scenario.get("lte", duration_s=5.0, size_cv=0.4)
    one = FleetScenario(1, uplink).draw(Streams.seeded(5))
    single = uplink.draw(Streams.seeded(5))
    assert (np.asarray(one.arrivals[0]) == np.asarray(single.arrivals)).all()
    assert one.link.trace.cumulative_bytes.tolist() == single.link.trace.cumulative_bytes.tolist()
    assert one.link.offset_us == single.link.offset_us


def test_cameras_tick_together_and_each_robot_moves_for_itself():
    made = FleetScenario.of(4, "lte", duration_s=3.0, size_cv=0.5)
    episode, other = (made.draw(Streams.seeded(k)) for k in range(2))
    assert episode.robots == 4
    assert episode.ticks_together
    first = episode.arrivals[0]
    for name in ("x", "size_bytes"):
        assert len({tuple(arrivals[name].tolist()) for arrivals in episode.arrivals}) == 4
    assert len(first) == made.max_messages == 90
    assert all((np.diff(arrivals["x"]) >= 0).all() and arrivals["x"][0] == 0 for arrivals in episode.arrivals)
    assert first.dtype == MESSAGE
    assert other.arrivals[0]["arrival_us"].tolist() != first["arrival_us"].tolist()
    again = made.draw(Streams.seeded(0))
    assert all((np.asarray(a) == np.asarray(b)).all() for a, b in zip(again.arrivals, episode.arrivals, strict=True))
    late = FleetEpisode((first, messages(first["arrival_us"] + 1, 10)), episode.link)
    assert not late.ticks_together
    episode_with_uniforms = episode.with_uniforms(np.random.default_rng(0))
    assert (
        episode_with_uniforms.arrivals[0]["uniform"].tolist() != episode_with_uniforms.arrivals[1]["uniform"].tolist()
    )
    assert not first["uniform"].any()


def test_the_cell_grows_with_the_robots():
    uplink = scenario.get("lte", scale=(0.5, 2.0))
    mean = {t.name: t.total_bytes for t in uplink.traces}
    for robots in (1, 3, 256):
        drawn = [
            FleetScenario(robots, uplink).draw(Streams.seeded(k)).link.trace for k in range(8 if robots < 9 else 1)
        ]
        for found in drawn:
            assert round(found.total_bytes / mean[found.name] / robots, 3) in (0.5, 2.0)


@pytest.mark.parametrize(
    ("build", "complaint"),
    [
        (lambda: FleetScenario(0), "robots = 0: must be a whole number from 1 to 256"),
        (lambda: FleetScenario(257), "robots = 257"),
        (lambda: FleetScenario(True), "robots = True"),
        (lambda: FleetScenario(2, "lte"), "'lte' is not a bufgym.scenario Uplink"),
        (lambda: FleetScenario.of(2, "interruption"), "needs an Uplink"),
        (lambda: FleetScenario.of(2, "lte", wheels=4), "no parameter 'wheels'"),
        (lambda: FleetScenario.of(2, "nowhere"), "unknown scenario 'nowhere'"),
        (lambda: FleetEpisode((), Link(US)), "robots = 0"),
        (lambda: FleetEpisode((messages(np.array([0]), 1)[:0],), Link(US)), "robot 0: an episode needs at least one"),
        (lambda: run_fleet(ACCEPTS, [], 2, V), "no episode"),
        (lambda: Fleet(Senders(3, 2, V, max_messages=1), 2), "multiple of that many senders"),
        (lambda: Fleet(Senders(2, 2, V, max_messages=9), 2).load(0, FleetScenario(3).draw(Streams.seeded(0))), "has 2"),
        (lambda: run_fleet(policies.Policy("p", accept, privileged=lambda *_: 0), [_short()], 2, V), "link of its own"),
    ],
)
def test_bad_input_is_told_apart(build, complaint):
    with pytest.raises(BufgymError) as error:
        build()
    assert complaint in str(error.value)
    assert "\n" not in str(error.value)


def _short():
    return FleetEpisode((messages(np.array([0]), 1),), Link(US))


def test_a_workload_is_no_stream(tmp_path):
    assert isinstance(FleetScenario().uplink, Uplink)
    assert FleetScenario().uplink.traces
    assert shipped()
    played = Workload("played", np.array([0, 10]), np.array([1, 1]))
    with pytest.raises(BufgymError, match="one robot's workload"):
        FleetScenario.of(2, "lte", workload=played, motion=())
