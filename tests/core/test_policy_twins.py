"""Every policy of one queue beside its slow twin, and the whole registry compiled beside itself as plain Python."""

from __future__ import annotations

from dataclasses import replace

import naive
import pytest
from cases import ANYTHING, VALUES, cases, log, order, same, twin_log
from hypothesis import given
from naive_policies import twins

from bufgym import policies
from bufgym.model import qoi
from bufgym.sim.metrics import outcome

ALL = tuple(name for name in policies.names() if policies.get(name).privileged is None)

SETTINGS = [
    "linear-alpha:alpha=2",
    "even-reject:beta=2",
    "paced-motion-gap:pace=1.5,discount=0.5",
    "keyframe:step=0.5",
    "ros-keep-last:depth=2",
    "lifespan:lifespan_s=0.01",
    "time-filter:separation_s=0.004",
    "foxglove-backlog:limit_mb=0.006",
    # Messages of the random episodes have some hundred bytes each and come ms apart.
    "zenoh-drop:batch_size=300,queue_size=2,so_sndbuf=100,wait_before_drop=50,max_wait_before_drop_fragments=1000",
    "zenoh-drop:batch_size=700,queue_size=1,so_sndbuf=1,rate_memory_s=0.01",
    "ros2-best-effort:queue_kb=1,rate_memory_s=0.01",
    "ros2-reliable-udp:queue_kb=1,depth=2",
    "ros2-reliable-udp:queue_kb=2,rate_memory_s=0.01",
    "codel:target_ms=2,interval_ms=5",
    "codel:target_ms=1,interval_ms=1",
    "red:weight=0.5,max_p=0.5",
]
"""Settings under which the short random episodes meet every branch."""
ALIASES = ["dds-keep-all", "zenoh-ring", "foxglove-sdk", "rosbridge", "latest-only"]
ALIASES += [name for name in ALL if policies.get(name).for_topics and name in twins(qoi.exponential())]
"""Other names for the same on one queue."""
SPECS = sorted({*twins(qoi.exponential()), *SETTINGS} - {*ALIASES, *(spec.partition(":")[0] for spec in SETTINGS)})


@pytest.mark.parametrize("spec", [*(pytest.param(spec, marks=pytest.mark.kernels) for spec in SPECS), *ALIASES])
@given(cases(), VALUES)
def test_agrees_with_twin(spec, case, v):
    policy = ANYTHING if spec == "test-anything" else policies.get(spec)
    ours, twin = case.run(policy, v), case.run_twin(naive.policy(spec, v))
    assert log(ours) == twin_log(twin)
    assert order(ours) == twin.order
    sender, told = ours.batch.senders[0], outcome(ours, 0)
    assert (sender["rejected"], sender["evicted"]) == (twin.rejected, twin.evicted)
    assert (sender["dequeued"], sender["transmitted"]) == (len(twin.dequeued), len(twin.transmitted))
    assert sender["backlog_bytes"] == sum(m["bytes"] for m in twin.queue)
    assert told.invalid == twin.invalid
    assert (told.arrived, told.delivered) == (len(case.twin_messages), len(twin.order))
    assert (told.dropped, told.in_transmission) == (len(twin.dropped), len(twin.socket))
    assert told.buffered == len(twin.queue)
    x = [case.twin_messages[k]["x"] for k in twin.order]
    assert told.qoi == naive.information(v, x)
    # What was credited message by message is H; what is kept or sent is H of all of it.
    assert (sender["delivered_gain"] + 1 if x else 0) == pytest.approx(told.qoi, abs=1e-12)
    kept = x + [m["x"] for m in [*(sent.message for sent in twin.socket), *twin.queue]]
    assert (sender["retained_gain"] + 1 if kept else 0) == pytest.approx(naive.information(v, kept), abs=1e-9)


def test_the_built_in_policies_are_there():
    built_in = set(twins(qoi.exponential())) - {"test-anything"}
    assert built_in <= set(ALL) and len(built_in) == 40


@pytest.mark.parametrize("name", ALL)
@given(cases(max_messages=15), VALUES)
def test_every_decision_is_possible_compiled_and_as_plain_python(name, case, v):
    policy = policies.get(name)
    assert policy.name == name and len(policy.summary) > 20
    if policy.unbounded:
        case = replace(case, capacity=len(case.twin_messages), max_bytes=None)
    senders = case.run(policy, v)
    # Outside the arrivals that ask, a full queue rejects without being asked: those are not the policy's.
    if case.episode.first_decision == 0 and case.episode.last_decision > len(case.twin_messages):
        assert outcome(senders, 0).invalid == 0
    assert policy.unbounded or senders.batch.senders[0]["peak_backlog_bytes"] <= (case.max_bytes or 2**62)
    assert same(senders, case.run(replace(policy, compile=False), v))
