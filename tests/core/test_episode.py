"""Episodes, of one robot and of a cell: checked when they are made, as kernels index by them and count in 64 bits."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from refusal_cases import refuse, refused

from bufgym import policies, scenario
from bufgym.model import qoi
from bufgym.model.buffer import MESSAGE
from bufgym.model.link import MAX_TIME_US, Link
from bufgym.model.topics import Topic
from bufgym.oracle import clairvoyant
from bufgym.scenario import SCENARIOS, Episode, FleetEpisode, FleetScenario, Streams, messages
from bufgym.sim import Senders
from bufgym.sim.cell import Fleet, run_fleet
from bufgym.traces import Trace
from bufgym.traces.workload import Workload
from bufgym.utils.errors import BufgymError

STEADY = Link(Trace.constant(1e6, 10))
THREE = messages(np.array([0, 10, 20]), 5)
V = qoi.exponential()
PRIVILEGED = policies.Policy("p", lambda *_: 0, privileged=lambda *_: 0)
PLAYED = Workload("played", np.array([0, 10]), np.array([1, 1]))


def changed(**fields: Any) -> Any:
    """Three messages whose middle one has other numbers."""
    arrivals = THREE.copy()
    for name, number in fields.items():
        arrivals[name][1] = number
    return arrivals


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"seq": 10**9}, "seq = 1000000000: must be its place in the list of arrivals, 1"),
        ({"arrival_us": -1}, "arrival_us = -1: times must be >= 0, must not decrease"),
        ({"arrival_us": MAX_TIME_US + 1}, "arrival_us = 10000000000001: .* at most 10000000000000 us"),
        ({"size_bytes": 0}, "size_bytes = 0: must be at least 1 byte"),
        ({"size_bytes": 2**60}, ".* all messages together at most 1152921504606846976"),
        ({"topic": -1}, "topic = -1: must be >= 0"),
        ({"x": np.nan}, "x = nan: must be a finite number"),
        ({"x": -1.0}, "x = -1.0: .* not less than that of the message before it on its topic"),
        ({"uniform": 1.0}, r"uniform = 1.0: must lie in \[0, 1\)"),
    ],
)
def test_a_message_that_breaks_a_rule(fields: dict[str, Any], message: str) -> None:
    refuse(f"^message 1: {message}", Episode, changed(**fields), STEADY)
    refuse(f"^arrivals of robot 1: message 1: {message}", FleetEpisode, (THREE, changed(**fields)), STEADY)


ONE = Episode(THREE, STEADY)
test_other_parameters = refused(
    (lambda: replace(ONE, arrivals=THREE[:0]), "an episode needs at least one message"),
    (lambda: replace(ONE, arrivals=np.zeros(3)), "arrivals: must be MESSAGE"),
    (lambda: replace(ONE, arrivals=np.zeros((3, 1), MESSAGE)), "arrivals: must be MESSAGE"),
    (lambda: replace(ONE, link=None), "link: None is not a bufgym.model.link Link"),
    (lambda: replace(ONE, window=0), "window = 0"),
    (lambda: replace(ONE, ends_us=-1), "ends_us = -1: must be a whole number from 0 to"),
    (lambda: replace(ONE, ends_us=0.5), "ends_us = 0.5"),
    (lambda: replace(ONE, consumers=0), "consumers = 0: must be a whole number from 1 to 3333333"),
    (lambda: replace(ONE, first_decision=0.5), "first_decision = 0.5"),
    (lambda: replace(ONE, last_decision=2**63), "last_decision = 9223372036854775808"),
    (lambda: replace(ONE, encodings={"json": np.ones(2, np.int64)}), r"encodings\['json'\]: must be int64\[3\]"),
)


def test_what_the_robot_was_told_survives() -> None:
    rng, full = np.random.default_rng(0), Episode(THREE, STEADY, encodings={"json": np.ones(3, np.int64)}, ends_us=7)
    fleet = FleetEpisode((THREE, THREE), STEADY, 7)
    others = full.with_uniforms(rng), full.encoded("json"), full.copied(2), full.valued(V)
    for episode in (*others, fleet.episode(1), fleet.with_uniforms(rng).episode(0)):
        assert episode.ends_us == 7
    refuse("ends_us = -7", FleetEpisode, (THREE, THREE), STEADY, -7)


def test_another_encoding_keeps_the_rules_too() -> None:
    episode = Episode(THREE, STEADY, encodings={"json": np.array([5, 0, 5])})
    refuse("message 1: size_bytes = 0", episode.encoded, "json")


@pytest.mark.parametrize("name", SCENARIOS)
def test_nobody_writes_to_an_episode(name: str) -> None:
    streams = Streams.seeded(1)
    drawn, cell = scenario.get(name).draw(streams), FleetScenario.of(2).draw(streams)
    others = drawn.with_uniforms(streams.policy), drawn.encoded("json"), drawn.copied(9), cell.episode(1)
    for episode in (drawn, *others):
        with pytest.raises(ValueError, match="read-only"):
            episode.arrivals["x"] = 7


def test_what_its_maker_writes_later_does_not_reach_it() -> None:
    arrivals = THREE.copy()
    episode, part = Episode(arrivals, STEADY), arrivals[:2]
    part.flags.writeable = False
    shorter = Episode(part, STEADY)
    arrivals["seq"] = 10**9
    assert episode.arrivals["seq"].tolist() == [0, 1, 2]
    assert shorter.arrivals["seq"].tolist() == [0, 1]


def test_x_of_topics_falls_only_where_topics_are_used() -> None:
    """Each topic has an x of its own: 0, 1 | 5, 7. One queue would see it fall from 5 to 1."""
    arrivals = messages(np.arange(4), 5)
    arrivals["x"], arrivals["topic"] = [0, 5, 1, 7], [0, 1, 0, 1]
    episode = Episode(arrivals, STEADY)
    Senders(1, 2, V, max_messages=4, topics=[Topic("a"), Topic("b")]).load(0, episode)
    one_queue = Senders(1, 2, V, max_messages=4)
    for load in (lambda: one_queue.load(0, episode), lambda: clairvoyant(episode, 2, V)):
        refuse("x falls from one message to the next", load)


@pytest.mark.parametrize("what", [None, 5, FleetEpisode((THREE,), STEADY)])
def test_senders_load_episodes_only(what: Any) -> None:
    refuse(r"is not a bufgym\.scenario Episode", Senders(1, 2, V, max_messages=4).load, 0, what)


def slow(after: str, carried: int = 1) -> Link:
    """So many bytes in 10^7 s, the longest trace there is."""
    return Link(Trace("slow", np.array([0, MAX_TIME_US]), np.array([0, carried]), after=after))  # type: ignore[arg-type]


def test_a_link_that_would_take_longer_than_64_bits_can_count() -> None:
    """1 byte in 10^13 us: 230,000 bytes take 2.3 x 10^18 us, and 2^61 is 2.306 x 10^18."""
    for after in ("loop", "hold"):
        Episode(messages(np.array([0]), 220_000), slow(after))
        with pytest.raises(BufgymError, match=r"link on slow: may need 2.31e\+18 us, .* must stay below 2\*\*61 us"):
            Episode(messages(np.array([0]), 231_000), slow(after))
    Episode(messages(np.array([0]), 10**10), slow("stop"))  # carries one byte and ends
    # Two robots of a cell share it, and so do their bytes.
    refuse(r"link on slow: may need 3e\+18 us", FleetEpisode, (messages(np.array([0]), 150_000),) * 2, slow("loop"))


def test_a_link_that_would_carry_more_than_64_bits_can_count() -> None:
    """2^61 bytes in a microsecond, and again in the next: two messages 1 us apart are all it may meet."""
    fast = Link(Trace("fast", np.array([0, 1]), np.array([0, 2**61])))
    with pytest.raises(BufgymError, match=r"link on fast: .* must stay below 2\*\*61 us and 2\*\*62 bytes"):
        Episode(messages(np.array([0, 10]), 5), fast)


def test_pauses_for_acks_count_too() -> None:
    """3 messages and an ack delay of 2^60 us: the last ack comes after 3 x 2^60 us."""
    refuse(r"may need 3.46e\+18 us", Episode, THREE, STEADY, ack_delay_us=2**60)


def test_cameras_tick_together_and_each_robot_moves_for_itself() -> None:
    made = FleetScenario.of(4, "lte", duration_s=3.0, size_cv=0.5)
    episode, again, other = (made.draw(Streams.seeded(k)) for k in (0, 0, 1))
    assert episode.robots == 4 and episode.ticks_together
    first = episode.arrivals[0]
    assert len(first) == made.max_messages == 90 and first.dtype == MESSAGE
    for name in ("x", "size_bytes"):
        assert len({tuple(arrivals[name].tolist()) for arrivals in episode.arrivals}) == 4
    assert all((np.diff(arrivals["x"]) >= 0).all() and arrivals["x"][0] == 0 for arrivals in episode.arrivals)
    assert other.arrivals[0]["arrival_us"].tolist() != first["arrival_us"].tolist()
    assert all((np.asarray(a) == np.asarray(b)).all() for a, b in zip(again.arrivals, episode.arrivals, strict=True))
    assert not FleetEpisode((first, messages(first["arrival_us"] + 1, 10)), episode.link).ticks_together
    one, two, *_ = (arrivals["uniform"] for arrivals in episode.with_uniforms(np.random.default_rng(0)).arrivals)
    assert one.tolist() != two.tolist() and not first["uniform"].any()


def test_the_cell_grows_with_the_robots() -> None:
    uplink = scenario.get("lte", scale=(0.5, 2.0))
    mean = {t.name: t.total_bytes for t in uplink.traces}
    for robots in (1, 3, 256):
        for k in range(8 if robots < 9 else 1):
            found = FleetScenario(robots, uplink).draw(Streams.seeded(k)).link.trace
            assert round(found.total_bytes / mean[found.name] / robots, 3) in (0.5, 2.0)


test_bad_input_is_told_apart = refused(
    (lambda: FleetScenario(0), "robots = 0: must be a whole number from 1 to 256"),
    (lambda: FleetScenario(257), "robots = 257"),
    (lambda: FleetScenario(2, "lte"), "'lte' is not a bufgym.scenario Uplink"),
    (lambda: FleetScenario.of(2, "interruption"), "needs an Uplink"),
    (lambda: FleetEpisode((), STEADY), "robots = 0"),
    (lambda: FleetEpisode((messages(np.array([0]), 1)[:0],), STEADY), "robot 0: an episode needs at least one"),
    (lambda: run_fleet(policies.get("afr"), [], 2, V), "no episode"),
    (lambda: Fleet(Senders(3, 2, V, max_messages=1), 2), "multiple of that many senders"),
    (lambda: Fleet(Senders(2, 2, V, max_messages=9), 2).load(0, FleetScenario(3).draw(Streams.seeded(0))), "has 2"),
    (lambda: FleetScenario.of(2, "lte", workload=PLAYED, motion=()), "one robot's workload"),
    (lambda: run_fleet(PRIVILEGED, [FleetEpisode((THREE,), STEADY)], 2, V), "link of its own"),
)
