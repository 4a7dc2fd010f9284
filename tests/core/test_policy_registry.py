"""The registry: what holds for every policy and its slow reference model, policies of one's own, what is refused."""

from dataclasses import replace

import naive
import pytest
from cases import ANYTHING, VALUES, cases, log, order, reference_log, same
from hypothesis import given
from naive_policies import references
from policy_cases import interruption, kept
from refusal_cases import refuse

from bufgym import policies
from bufgym.jit import kernel
from bufgym.model import qoi
from bufgym.policies import ACCEPT, REJECT, register, registry
from bufgym.sim.metrics import outcome
from bufgym.utils.errors import BufgymError

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
ALIASES += [name for name in ALL if policies.get(name).for_topics and name in references(qoi.exponential())]
"""Other names for the same on one queue."""
SPECS = sorted({*references(qoi.exponential()), *SETTINGS} - {*ALIASES, *(spec.partition(":")[0] for spec in SETTINGS)})


@pytest.mark.parametrize("spec", [*(pytest.param(spec, marks=pytest.mark.kernels) for spec in SPECS), *ALIASES])
@given(cases(), VALUES)
def test_agrees_with_reference(spec, case, v):
    policy = ANYTHING if spec == "test-anything" else policies.get(spec)
    ours, reference = case.run(policy, v), case.run_reference(naive.policy(spec, v))
    assert log(ours) == reference_log(reference)
    assert order(ours) == reference.order
    sender, result = ours.batch.senders[0], outcome(ours, 0)
    assert (sender["rejected"], sender["evicted"]) == (reference.rejected, reference.evicted)
    assert (sender["dequeued"], sender["transmitted"]) == (len(reference.dequeued), len(reference.transmitted))
    assert sender["backlog_bytes"] == sum(m["bytes"] for m in reference.queue)
    assert result.invalid == reference.invalid
    assert (result.arrived, result.delivered) == (len(case.reference_messages), len(reference.order))
    assert (result.dropped, result.in_transmission) == (len(reference.dropped), len(reference.socket))
    assert result.buffered == len(reference.queue)
    x = [case.reference_messages[k]["x"] for k in reference.order]
    assert result.qoi == naive.information(v, x)
    # What was credited message by message is H; what is kept or sent is H of all of it.
    assert (sender["delivered_gain"] + 1 if x else 0) == pytest.approx(result.qoi, abs=1e-12)
    kept = x + [m["x"] for m in [*(sent.message for sent in reference.socket), *reference.queue]]
    assert (sender["retained_gain"] + 1 if kept else 0) == pytest.approx(naive.information(v, kept), abs=1e-9)


ELSEWHERE = {
    "target-gap": "test_target_gap.py",
    "price-dp": "test_price_dp.py",
    "gap-price": "test_price_dp.py",
    "gap-priority": "test_gap_priority.py",
}
"""Policy -> the file beside this one that has its reference model. That of networks is in test_learned.py."""


def test_each_built_in_policy_has_a_reference_model():
    models = references(qoi.exponential())
    written = [name for name in ALL if not policies.get(name).weights and name not in ELSEWHERE]
    lacking = sorted({*written} - {*models})
    assert not lacking, f"no reference model of {lacking}: add it to reference models() in tests/core/naive_policies.py"
    unknown = sorted({*models} - {*ALL, "test-anything"})
    assert not unknown, (
        f"tests/core/naive_policies.py: reference models() names {unknown}, which bufgym/policies/ has not"
    )
    foreign = [n for n in (*policies.names(), *policies.names(named_only=True)) if not policies.get(n).built_in]
    assert not foreign, f"{foreign} must be under @built_in, not @register, in bufgym/policies/"
    assert policies.get("decimate:every=2").built_in and not policies.get(keep_even).built_in


@pytest.mark.parametrize("name", ALL)
@given(cases(max_messages=15), VALUES)
def test_every_decision_is_possible_compiled_and_as_plain_python(name, case, v):
    policy = policies.get(name)
    assert policy.name == name
    assert policy.summary.endswith("."), f"{name}: the first line of its docstring must say how it decides"
    if policy.unbounded:
        case = replace(case, capacity=len(case.reference_messages), max_bytes=None)
    senders = case.run(policy, v)
    # Outside the arrivals that ask, a full queue rejects without being asked: those are not the policy's.
    if case.episode.first_decision == 0 and case.episode.last_decision > len(case.reference_messages):
        assert outcome(senders, 0).invalid == 0
    assert policy.unbounded or senders.batch.senders[0]["peak_backlog_bytes"] <= (case.max_bytes or 2**62)
    assert same(senders, case.run(replace(policy, compile=False), v))


def keep_even(buffer, arrival, memory):
    """Drops every second arrival that finds the queue full, the oldest otherwise."""
    if len(buffer.slots) < buffer.capacity:
        return -2
    memory[0] += buffer.parameters[0]
    return 0 if memory[0] % 2 else -1


def test_a_policy_of_your_own():
    layout = {"memory": {"count": 0}, "parameters": {"by": 1}}
    assert register("keep-even", **layout)(keep_even) is keep_even
    register("keep-even-compiled", compile=True, **layout)(keep_even)
    register("keep-even-kernel", compile=True, **layout)(kernel(keep_even))  # a kernel already
    assert list(policies.names())[-3:] == ["keep-even", "keep-even-compiled", "keep-even-kernel"]
    assert policies.get("keep-even").summary == keep_even.__doc__
    # L = 2: 3 drops 1, 4 is rejected, 5 drops 2, 6 is rejected. With steps of 2 every newcomer is rejected.
    for name in ("keep-even", "keep-even-compiled", "keep-even-kernel"):
        assert kept(name, 2, 6) == [3, 5]
        assert kept(f"{name}:by=2", 2, 6) == [1, 2]
    assert policies.get("keep-even-compiled").compile and not policies.get("keep-even").compile


def test_own_departures():
    heard = []
    register("listener", on_departure=lambda buffer, memory: heard.append(len(buffer.slots)))(lambda b, a, m: ACCEPT)
    interruption("listener", 3, 3)
    # Message 0 leaves an empty buffer; after the outage 3 are left, then 2, 1; message 4 meets an empty buffer.
    assert heard == [0, 2, 1, 0, 0]


def test_parameters():
    assert kept("decimate:every=2", 8, 6) == [1, 3, 5]
    made = policies.get("decimate:every=2")
    assert (made.name, dict(made.parameters)) == ("decimate:every=2", {"every": 2})
    assert made.parameter_array.tolist() == [2] and not made.parameter_array.flags.writeable
    assert policies.get(made) is made
    assert policies.get("decimate").parameters["every"] == 3  # its own stays


@pytest.mark.parametrize(
    ("spec", "rule"),
    [
        ("decimate:every=0", "policy decimate: every = 0.0: must be a number > 0"),
        *((f"decimate:every={wrong}", f"every = {wrong}: must be a number > 0") for wrong in ("-1.0", "nan", "inf")),
        ("decimate:every", "'every' is not of the form parameter=number"),
        ("decimate:every=often", "'every=often' is not of the form"),
    ],
)
def test_bad_specs(spec, rule):
    refuse(rule, policies.get, spec)


def test_bad_registrations():
    for name in policies.names():
        refuse(f"policy '{name}': a built-in policy has this name", register, name)
    register("test-mine")(keep_even)
    register("test-mine")(keep_even)  # a notebook's cell runs again
    with pytest.raises(BufgymError, match=r"policy 'test-mine': the function .*\.keep_even has this name"):
        register("test-mine")(lambda buffer, arrival, memory: REJECT)
    registry._REGISTRY.pop("test-mine")
    for name in ("", "a b", "a:b", "a,b", "a=b"):
        refuse("a name must be non-empty", register, name)
    for what in ("parameters", "memory"):
        refuse(rf"{what} = \('speed',\): must map names to numbers", register("mine", **{what: ("speed",)}), keep_even)
    refuse("3 is not a function", register("mine"), 3)
