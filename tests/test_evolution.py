"""Evolved agents: where they begin, what they leave behind, that a killed run goes on and a seed repeats itself."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest

for extra in ("sb3_contrib", "tqdm", "tensorboard", "cma"):
    pytest.importorskip(extra, reason="the extra [train] is not installed")

import train  # noqa: E402  (these need the extra)
from agents import evolution, training, worlds  # noqa: E402
from bufgym import policies  # noqa: E402
from bufgym.policies import learned, weights  # noqa: E402
from bufgym.scenario import Interruption  # noqa: E402

TINY = train.Arguments(
    suite="interruption-v1",
    capacities="4",
    algo="evolution",
    name="tiny",
    steps=600_000,
    validate_every=200_000,
    validation_episodes=30,
    test_seeds=25,
    hidden=2,
)


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(("sees", "like"), [("motion", "min-motion-gap"), ("time", "min-gap")])
def test_it_begins_with_the_smallest_merged_gap(sees: str, like: str) -> None:
    """The regret of the first weights is that of the policy they stand for."""
    first = learned.policy("first", evolution.start(evolution.SEES[sees], 3, np.random.default_rng(0)))
    cell = worlds.Cell("short", Interruption(t_max=60), 5)
    (ground,) = evolution.grounds([cell], seed=1)
    assert ground.regret(first) == pytest.approx(ground.regret(policies.get(like)), abs=1e-12)
    assert ground.afr == ground.regret(policies.get("afr")) > 0
    assert ground.over_afr(policies.get("drop-newest")) == evolution.WORST


def test_weights_are_a_vector_and_back() -> None:
    made = learned.random_weights(evolution.MOTION, (3, 2), np.random.default_rng(0))
    vector = evolution.to_vector(made)
    assert len(vector) == 2 * (14 + 1 + 14 * 3 + 3 + 3 * 2 + 2 + 2)
    again = evolution.from_vector(made, vector)
    assert (evolution.to_vector(again) == vector).all()
    assert (again.memory() == made.memory()).all()
    changed = vector.copy()
    changed[0] += 1
    assert again.drop.skip[0] + 1 == evolution.from_vector(made, changed).drop.skip[0]


@pytest.mark.slow
def test_a_run_leaves_an_agent_goes_on_after_a_kill_and_repeats(capsys: pytest.CaptureFixture[str]) -> None:
    train.main(TINY)
    home = Path("runs/tiny/seed-0")
    whole, told = weights.read(home / evolution.MODEL)
    assert (told["algo"], told["suite"]) == ("evolution", "interruption-v1")
    assert "agent (evolution)" in capsys.readouterr().out
    assert Path("runs/tiny/model.safetensors").read_bytes() == (home / evolution.MODEL).read_bytes()
    with (home / "validation.csv").open(newline="", encoding="utf-8") as file:
        rows = [{name: float(number) for name, number in row.items()} for row in csv.DictReader(file)]
    assert rows[0]["steps"] == 0 and rows[-1]["steps"] >= TINY.steps
    assert all(0 <= row["regret"] < 1 for row in rows)

    # Half of the steps, then the rest: the same agent to the last bit.
    half = dataclasses.replace(TINY, name="half", steps=TINY.steps // 2)
    folder = training.prepare(half)
    training.train_all(half, folder)
    rest = dataclasses.replace(half, steps=TINY.steps, resume=True)
    training.train_all(rest, training.prepare(rest))
    again, _ = weights.read(folder / "seed-0" / evolution.MODEL)
    assert (again.memory() == whole.memory()).all()


def test_it_needs_a_suite() -> None:
    with pytest.raises(SystemExit, match="name one"):
        train.main(dataclasses.replace(TINY, suite=""))
