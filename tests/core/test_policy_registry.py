"""The registry: policies of one's own, parameters by name, and what it refuses."""

from __future__ import annotations

import pytest
from policy_cases import interruption, kept

from bufgym import policies
from bufgym.errors import BufgymError
from bufgym.policies import ACCEPT, register, registry


@pytest.fixture(autouse=True)
def own_registry(monkeypatch):
    """What a test registers is gone after it."""
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))


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
    assert list(policies.names())[-2:] == ["keep-even", "keep-even-compiled"]
    assert policies.get("keep-even").summary == keep_even.__doc__
    # L = 2: 3 drops 1, 4 is rejected, 5 drops 2, 6 is rejected. With steps of 2 every newcomer is rejected.
    for name in ("keep-even", "keep-even-compiled"):
        assert kept(name, 2, 6) == [3, 5]
        assert kept(f"{name}:by=2", 2, 6) == [1, 2]
    assert policies.runs_compiled(policies.get("keep-even-compiled"))
    assert not policies.runs_compiled(policies.get("keep-even"))


def test_own_departures():
    heard = []
    register("listener", on_departure=lambda buffer, memory: heard.append(len(buffer.slots)))(
        lambda buffer, arrival, memory: ACCEPT
    )
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
        ("lifo", "unknown policy 'lifo'; known: .*afr"),
        ("afr:speed=2", "policy afr: no parameter 'speed'; it has: none"),
        ("decimate:every=0", "policy decimate: every = 0.0: must be a number > 0"),
        ("decimate:every=nan", "every = nan"),
        ("decimate:every", "'every' is not of the form parameter=number"),
        ("decimate:every=often", "'every=often' is not of the form"),
    ],
)
def test_bad_specs(spec, rule):
    with pytest.raises(BufgymError, match=rule):
        policies.get(spec)


def test_bad_registrations():
    for name in policies.names():
        with pytest.raises(BufgymError, match=f"policy '{name}': a built-in policy has this name"):
            register(name)(keep_even)
    for name in ("", "a b", "a:b", "a,b", "a=b"):
        with pytest.raises(BufgymError, match="a name must be non-empty"):
            register(name)(keep_even)
    for what in ("parameters", "memory"):
        with pytest.raises(BufgymError, match=rf"{what} = \('speed',\): must map names to numbers"):
            register("mine", **{what: ("speed",)})(keep_even)
    with pytest.raises(BufgymError, match="3 is not a function"):
        register("mine")(3)
