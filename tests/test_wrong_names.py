"""A wrong name of any kind ends in one sentence that says which was meant."""

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

import bufgym
from bufgym import papers, policies, scenario
from bufgym.ground.errors import BufgymError
from bufgym.scenario import suites

LTE = ("duration_s", "rate_hz", "size_bytes", "propagation_us", "random_offset", "traces", "motion")
TOPIC = ("priority", "deadline_s", "no_drop", "rate_limit_hz", "size_bytes")


def without_one(name: str) -> str:
    """The name without a letter near its end."""
    return name[:-2] + name[-1:] if len(name) < 4 else name[:-4] + name[-3:]


def of_topic(wrong: str) -> Any:
    """Read a client whose only topic has this setting."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "client.toml")
        file.write_text(f'[[topic]]\nname = "a"\n{wrong} = 1\n', encoding="utf-8")
        return scenario.read_client(file)


def mistakes() -> Iterator[tuple[str, Callable[[str], Any]]]:
    """The right name, and what is called with the wrong one."""
    for name in [*policies.names()][::4]:
        yield name, policies.get
    for name in policies.get("codel").parameters:
        yield name, lambda wrong: policies.get(f"codel:{wrong}=2")
    for name in scenario.SCENARIOS:
        yield name, scenario.get
        yield name, lambda wrong: bufgym.compare("afr", wrong)
    for name in suites.SUITES:
        yield name, suites.get
        yield name, lambda wrong: bufgym.compare("afr", wrong)
    for name in papers.FIGURES:
        yield name, papers.figure
    for name in LTE:
        yield name, lambda wrong: scenario.get("lte", **{wrong: 1})
        yield name, lambda wrong: bufgym.compare("afr", "lte", **{wrong: 1})
    for name in TOPIC:
        yield name, of_topic
    for name in ("capacity", "progress", "against", "max_bytes", "decide_at"):
        yield name, lambda wrong: bufgym.compare("afr", "lte", **{wrong: 1})
    for name in ("reward", "decide_at", "observation", "fields", "capacity", "max_bytes", "duration_s", "rate_hz"):
        yield name, lambda wrong: gym.make("bufgym/Uplink-v0", **{wrong: 1})
        yield name, lambda wrong: gym.make_vec("bufgym/Uplink-v0", 2, "vector_entry_point", **{wrong: 1})
    for name in ("retained", "delivered", "delay"):
        yield name, lambda wrong: gym.make("bufgym/Uplink-v0", reward={wrong: 1})
    for name in ("time_before", "relative_loss", "backlog", "service_ratio"):
        yield name, lambda wrong: gym.make("bufgym/Uplink-v0", fields=["rank", wrong])
    for name in ("episode", "trace", "scenario"):
        yield name, lambda wrong: gym.make("bufgym/Uplink-v0").reset(options={wrong: 1})


CASES = list(mistakes())


@pytest.mark.parametrize(("name", "call"), CASES)
def test_the_right_name_is_suggested(name: str, call: Callable[[str], Any]) -> None:
    with pytest.raises(BufgymError) as caught:
        call(without_one(name))
    told = str(caught.value)
    assert "unknown " in told and f"{without_one(name)!r}; did you mean {name!r}?" in told and "\n" not in told


def test_there_are_many() -> None:
    assert len(CASES) >= 60
