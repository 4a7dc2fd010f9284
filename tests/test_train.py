"""Training end to end with tiny settings: what it leaves behind, and that a killed run goes on."""

from __future__ import annotations

import csv
import dataclasses
import inspect
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

for extra in ("sb3_contrib", "tqdm", "tensorboard", "matplotlib"):
    pytest.importorskip(extra, reason="the extras [train] and [plot] are not installed")

import train  # noqa: E402  (these need the extras)
from agents import figure, held_out, report, runs, training  # noqa: E402
from agents.callbacks import Curve, checkpoints  # noqa: E402
from agents.evaluation import ValidationSets, Verdict  # noqa: E402
from agents.settings import Settings  # noqa: E402
from bufgym.benchmark.rows import read_rows  # noqa: E402
from bufgym.errors import BufgymError  # noqa: E402
from bufgym.policies import registry  # noqa: E402
from bufgym.scenario import suites  # noqa: E402

REPO = Path(__file__).resolve().parent.parent
TINY = Settings(
    name="tiny",
    steps=512,
    capacity=3,
    duration_s=1.0,
    width=8,
    num_envs=4,
    n_steps=32,
    batch_size=64,
    epochs=1,
    checkpoint_every=128,
    validation_episodes=2,
    episodes=3,
)
SUITE = dataclasses.replace(
    TINY,
    suite="interruption-v1",
    capacities="4,6",
    num_envs=12,
    n_steps=32,
    batch_size=96,
    steps=1_152,
    validate_every=384,
    validation_episodes=60,
    test_seeds=10,
)
"""Three updates of 384 decisions: two rows of each of 3 scenarios x 2 capacities, 32 steps each."""


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def curve_of(folder: Path) -> list[int]:
    """The steps at which the learning curve has rows."""
    with (folder / "curve.csv").open(newline="", encoding="utf-8") as file:
        return [int(row["steps"]) for row in csv.DictReader(file)]


@pytest.mark.parametrize("env", ["bufgym/Uplink-v0", "bufgym/Interruption-v0"])
def test_a_run_leaves_its_results(
    env: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures: list[dict[str, Any]] = []

    def draw(*args: Any, **kwargs: Any) -> None:
        pictures.append(inspect.signature(figure.draw).bind(*args, **kwargs).arguments)
        figure.draw(*args, **kwargs)

    monkeypatch.setattr(report, "draw", draw)
    settings = dataclasses.replace(TINY, env=env, steps=128, duration_s=3.0)
    train.main(dataclasses.replace(settings, network="plain" if "Inter" in env else "slots"))
    folder = Path("runs/tiny")
    results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    names = [row["policy"] for row in results["scores"]]
    assert sorted(names) == sorted([*registry.names(for_topics=False), "agent (seed 0)"])
    qoi = [row["qoi"] for row in results["scores"]]
    assert qoi == sorted(qoi, reverse=True)
    assert all(row["arrived"] == pytest.approx(row["delivered"] + row["dropped"]) for row in results["scores"])
    assert len({row["arrived"] for row in results["scores"]}) == 1  # all met the same episodes
    assert all(row["invalid"] == 0 for row in results["scores"] if row["policy"].startswith("agent"))
    assert results["settings"]["env"] == env
    notes = json.loads((folder / "notes.json").read_text(encoding="utf-8"))
    assert notes["training"].startswith("python train.py --") and notes["seeds"] == [0]
    assert notes["scores"]["qoi"] == next(row["qoi"] for row in results["scores"] if row["policy"].startswith("agent"))
    assert json.loads((folder / "seed-0" / "notes.json").read_text(encoding="utf-8"))["seeds"] == [0]
    # The curve begins with the untrained network; the bars are of ranked policies, each once, none below the floor.
    (picture,) = pictures
    assert [curve[:, 0].tolist() for curve in picture["curves"]] == [[0, 128]]
    scores = {row["policy"]: row["score"] for row in results["scores"]}
    bars = picture["bars"]
    assert {"drop-oldest", "agent (seed 0)"} <= set(bars) and not {"rosbridge", "clairvoyant", "zenoh-ring"} & set(bars)
    assert all(bar.value == scores[name] and (bar.value >= 0 or "agent" in name) for name, bar in bars.items())
    assert any("zenoh-ring" in note for note in picture["notes"])
    assert list(picture["lines"])[:2] == ["drop-oldest", "afr"] and picture["lines"]["drop-oldest"] == 0
    assert max(picture["lines"].values()) <= 1 and not set(picture["lines"]) & {"learned-motion", "clairvoyant"}
    assert (folder / "figure.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "model.zip").exists()
    assert list((folder / "seed-0" / "tensorboard").glob("events*"))
    printed = capsys.readouterr().out
    assert "drop-oldest" in printed
    assert "agent (seed 0)" in printed


def test_a_killed_run_goes_on_from_its_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    folder = runs.prepare(TINY)

    class KilledError(Exception):
        """Stands for what ends a process in the middle of training."""

    def dies_half_way(self: Curve) -> None:
        row(self)
        if self.num_timesteps >= 384:
            raise KilledError

    row = Curve._on_rollout_end
    with monkeypatch.context() as patch, pytest.raises(KilledError):
        patch.setattr(Curve, "_on_rollout_end", dies_half_way)
        training.train_seed(TINY, folder, 0)
    home = folder / "seed-0"
    # The untrained agent was validated. The third rollout was collected, but not learnt from: it does not count.
    assert [path.stem for path in checkpoints(home)] == ["000000000000", "000000000128", "000000000256"]
    assert curve_of(home) == [128, 256, 384]
    before = training.MaskablePPO.load(checkpoints(home)[-1])

    again = dataclasses.replace(TINY, resume=True)
    assert runs.prepare(again) == folder
    run = training.train_seed(again, folder, 0)
    assert curve_of(home) == [128, 256, 384, 512]
    assert run.seconds > 0
    after = training.MaskablePPO.load(checkpoints(home)[-1])
    assert (before.num_timesteps, after.num_timesteps) == (256, 512)
    # The optimizer went on counting, two gradient steps an update, and the learning rate on falling.
    counts = [int(state["step"]) for state in after.policy.optimizer.state_dict()["state"].values()]
    assert set(counts) == {8}
    assert after.policy.optimizer.param_groups[0]["lr"] < before.policy.optimizer.param_groups[0]["lr"]
    # Once more: there is nothing left to do.
    assert training.train_seed(again, folder, 0).curve == run.curve


def test_a_run_is_not_overwritten_or_mixed_with_another() -> None:
    unnamed = dataclasses.replace(TINY, name="")
    assert runs.prepare(unnamed) == Path("runs/train-1")
    assert runs.prepare(unnamed) == Path("runs/train-2")
    assert runs.prepare(dataclasses.replace(unnamed, resume=True)) == Path("runs/train-2")
    runs.prepare(TINY)
    with pytest.raises(BufgymError, match="exists"):
        runs.prepare(TINY)
    with pytest.raises(BufgymError, match="capacity was 3, now 4"):
        runs.prepare(dataclasses.replace(TINY, resume=True, capacity=4))
    with pytest.raises(BufgymError, match="no run"):
        runs.prepare(dataclasses.replace(TINY, resume=True, name="other"))


def test_held_out_traces_are_never_trained_on() -> None:
    training_scenario, test_scenario = held_out.split_scenario(TINY)
    trained = {trace.name for trace in training_scenario.traces}  # type: ignore[attr-defined]
    tested = {trace.name for trace in test_scenario.traces}  # type: ignore[attr-defined]
    assert len(tested) == 2
    assert trained
    assert not trained & tested


@pytest.mark.parametrize("decide_at", ["arrival", "overflow"])
def test_an_agent_that_acts_like_a_policy_scores_like_it(decide_at: str) -> None:
    """The agent's road (observations, actions, rows) and the policies' own are the same simulation."""
    test = held_out.FixedEpisodes(dataclasses.replace(TINY, decide_at=decide_at), "test")

    class DropOldest:
        """Accepts where that is possible, else evicts slot 0."""

        def predict(self, observation: object, *, deterministic: bool = False, action_masks: object = None) -> object:
            masks = np.asarray(action_masks)
            return np.where(masks[:, -1], TINY.capacity + 1, np.where(masks[:, 0], 0, TINY.capacity)), None

    outcomes = test.play(DropOldest())
    assert outcomes == test.run_fixed()["drop-oldest"]
    assert any(outcome.dropped for outcome in outcomes)


def test_episodes_are_scored_between_drop_oldest_and_the_clairvoyant() -> None:
    settings = dataclasses.replace(TINY, duration_s=5.0, episodes=4, validation_episodes=3)
    test, validation = (held_out.FixedEpisodes(settings, split) for split in ("test", "validation"))
    assert (len(test.episodes), len(validation.episodes)) == (4, 3)
    assert test.score(test.run("drop-oldest")) == 0 and test.score(test.run("clairvoyant")) == pytest.approx(1)
    outcomes = {name: test.run(name) for name in ("drop-oldest", "afr", "rosbridge")}
    entries = {entry["policy"]: entry for entry in held_out.summarise(outcomes, test.rows(outcomes), "afr")}
    low, high = entries["afr"]["score_95"]
    assert low <= entries["afr"]["score"] <= high and entries["afr"]["score"] == pytest.approx(
        test.score(outcomes["afr"])
    )
    assert np.isnan(entries["rosbridge"]["score"]) and entries["afr"]["minus_agent"] == 0


# --- on a suite ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("algo", training.ALGORITHMS)
def test_a_suite_is_trained_validated_and_tested_on(algo: str, capsys: pytest.CaptureFixture[str]) -> None:
    train.main(dataclasses.replace(SUITE, algo=algo))
    folder = Path("runs/tiny")
    results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    ranked = [standing["policy"] for standing in results["standings"] if standing["ranked"]]
    agent = f"agent ({algo})"
    assert {*registry.names(for_topics=False), agent} == {standing["policy"] for standing in results["standings"]}
    assert agent in ranked
    assert {cell["exact"] for cell in results["cells"]} == {True}
    assert results["held_out"] == {"suite": "interruption-v1", "split": "test", "episodes": 60}
    # The columns of the benchmark, and the training seed: none for a fixed policy.
    rows = read_rows(folder / "rows.csv")
    assert {row["training_seed"] for row in rows if row["policy"] == agent} == {0}
    assert {row["training_seed"] for row in rows if row["policy"] != agent} == {None}
    assert {row["scenario"] for row in rows} == set(suites.get("interruption-v1").settings("test"))
    invalid = sum(row["invalid"] for row in rows if row["policy"] == agent)
    assert invalid == 0 or algo == "ppo"
    # Validated before the first update, every 384 steps (evolution: a generation), and at the end; the best is kept.
    home = folder / "seed-0"
    with (home / "validation.csv").open(newline="", encoding="utf-8") as file:
        validation = {int(row["steps"]): float([*row.values()][-1]) for row in csv.DictReader(file)}
    model = runs.MODEL if algo == "evolution" else "model.zip"
    assert (folder / model).read_bytes() == (home / model).read_bytes()
    if algo in training.LEARNERS:
        assert list(validation) == [0, 384, 768, 1152]
        best = min(validation, key=lambda steps: validation[steps])
        assert (home / model).read_bytes() == (home / "checkpoints" / f"{best:012d}.zip").read_bytes()
    assert results["validation"] == {"0": min(validation.values())}
    assert (folder / "figure.png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    assert agent in printed
    assert "cells (scenario, L) count" in printed


def weights(arguments: Settings, name: str) -> dict[str, np.ndarray]:
    """All weights after training."""
    folder = runs.prepare(dataclasses.replace(arguments, name=name))
    run = training.train_seed(arguments, folder, arguments.seed)
    return {key: tensor.numpy() for key, tensor in training.load(arguments, run).policy.state_dict().items()}


@pytest.mark.parametrize("algo", list(training.LEARNERS))
def test_the_same_seed_gives_the_same_weights_bit_for_bit(algo: str) -> None:
    arguments = dataclasses.replace(TINY, algo=algo, steps=256)
    first, again = weights(arguments, "first"), weights(arguments, "again")
    assert all((first[key] == again[key]).all() for key in first)
    other = weights(dataclasses.replace(arguments, seed=1), "other")
    assert not all((first[key] == other[key]).all() for key in first)


@pytest.mark.slow
def test_on_a_suite_too_the_same_seed_gives_the_same_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    verdicts = iter([0.9, 0.1, 0.7, 0.8] * 2)
    monkeypatch.setattr(ValidationSets, "play", lambda self, agent, slots: Verdict(0.5, 0.0, next(verdicts)))
    first, again = weights(SUITE, "first"), weights(SUITE, "again")
    assert all((first[key] == again[key]).all() for key in first)
    # The second validation was the best: its agent is kept, not the last one.
    assert training.MaskablePPO.load("runs/first/seed-0/model.zip").num_timesteps == 384


@pytest.mark.slow
def test_a_suites_run_goes_on_with_its_best_so_far(monkeypatch: pytest.MonkeyPatch) -> None:
    verdicts = iter([0.9, 0.1, 0.7, 0.5, 0.6])
    monkeypatch.setattr(ValidationSets, "play", lambda self, agent, slots: Verdict(0.5, 0.0, next(verdicts)))
    folder = runs.prepare(SUITE)
    run = training.train_seed(dataclasses.replace(SUITE, steps=768), folder, 0)
    assert [(row[0], row[4]) for row in run.validation] == [(0, 0.9), (384, 0.1), (768, 0.7)]
    again = training.train_seed(dataclasses.replace(SUITE, resume=True), folder, 0)
    assert [(row[0], row[4]) for row in again.validation] == [(0, 0.9), (384, 0.1), (768, 0.7), (1152, 0.5)]
    assert again.merit == -0.1
    assert training.MaskablePPO.load(again.model).num_timesteps == 384


def test_dqn_goes_on_with_its_optimizer_and_a_fresh_replay() -> None:
    arguments = dataclasses.replace(TINY, algo="dqn")
    folder = runs.prepare(arguments)
    training.train_seed(dataclasses.replace(arguments, steps=256), folder, 0)
    before = training.MaskedDQN.load(checkpoints(folder / "seed-0")[-1])
    training.train_seed(arguments, folder, 0)
    after = training.MaskedDQN.load(checkpoints(folder / "seed-0")[-1])
    assert (before.num_timesteps, after.num_timesteps) == (256, 512)
    counts = [
        {int(state["step"]) for state in model.policy.optimizer.state_dict()["state"].values()}
        for model in (before, after)
    ]
    assert counts == [{before._n_updates}, {after._n_updates}]
    assert after._n_updates > before._n_updates > 0


def test_batches_divide_the_experience() -> None:
    assert training.even_batch(32_768, 4_096) == 4_096
    assert training.even_batch(34_560, 4_096) == 3_840  # nine of them: eight would be too large
    assert training.even_batch(100, 4_096) == 100
    with pytest.raises(BufgymError, match="batch_size = 4: num_envs x n_steps = 7 decisions"):
        training.even_batch(7, 4)


NOT_POSITIVE = (
    *("seeds", "steps", "capacity", "size_bytes", "duration_s", "width", "num_envs", "n_steps", "batch_size", "epochs"),
    *("learning_rate", "checkpoint_every", "validate_every", "validation_episodes", "episodes"),
)
NEGATIVE = ("seed", "hidden", "still_hidden", "gamma", "gae_lambda", "entropy", "warm_up", "test_seeds")
EVOLUTION = {"algo": "evolution", "suite": "interruption-v1"}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        *(({name: 0}, f"{name} = 0: must be") for name in NOT_POSITIVE),
        *(({name: -1}, f"{name} = -1: must") for name in (*NOT_POSITIVE, *NEGATIVE)),
        *(({name: float("nan")}, f"{name} = nan: must be a finite number") for name in ("gamma", "duration_s")),
        *(({name: "no-such"}, f"{name} = 'no-such': must be one of") for name in ("env", "algo", "network", "reward")),
        ({"env": "bufgym/Topics-v0"}, "env = 'bufgym/Topics-v0': a scheduler learns from a suite of topics"),
        ({"gamma": 1.5}, "gamma = 1.5: must lie in 0..1"),
        ({"batch_size": 1}, "batch_size = 1: must be >= 2"),
        ({"hidden": 257}, "hidden = 257: must lie in 0..256"),
        ({"suite": "no-such"}, "unknown suite 'no-such'"),
        ({"suite": "lte-v1", "capacities": "0"}, "capacities = '0': must be whole numbers >= 1"),
        ({"suite": "lte-v1", "capacities": "5,x"}, "capacities = '5,x': must be whole numbers such as"),
        ({"suite": "lte-belgium-v1"}, "needs a folder of recordings"),
        ({"suite": "lte-belgium-v1", "data": "no-such"}, "no-such"),
        ({"suite": "lte-v1,topics-v1"}, "suite lte-v1,topics-v1: a scheduler learns from one suite alone"),
        ({"suite": "fleet-v1", "algo": "dqn"}, "suite fleet-v1: a fleet's agent learns from one suite alone"),
        ({"algo": "evolution"}, "learns from a suite's episodes: name one"),
        ({**EVOLUTION, "fields": "rank"}, "fields = 'rank': must be rank, motion_merged, time_merged or index_merged"),
        ({**EVOLUTION, "fields": "rank,time_merged,colour"}, "fields = 'rank,time_merged,colour': must be"),
        ({**EVOLUTION, "suite": "sustained-v1", "warm_up": 9}, "warm_up = 9: needs a suite of interruptions"),
        ({"backend": "no-such"}, "backend = 'no-such': must be one of local, ray, dask"),
        ({"backend": "dask"}, "backend = 'dask': a cluster evaluates the candidates of --algo evolution alone"),
        ({**EVOLUTION, "address": "host:1"}, "address = 'host:1': is that of a cluster: name its kind"),
        ({"resume": True}, "there is no run in"),
    ],
)
def test_mistakes_end_in_one_line_before_a_folder_is_made(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(SystemExit) as error:
        train.main(dataclasses.replace(TINY, **wrong))  # type: ignore[arg-type]
    assert str(error.value).startswith("error: ")
    assert message in str(error.value) and "\n" not in str(error.value)
    assert not Path("runs").exists()


@pytest.mark.slow
def test_a_process_killed_for_good_goes_on_and_a_second_seed_joins(tmp_path: Path) -> None:
    command = [sys.executable, str(REPO / "train.py")]
    settings = {**dataclasses.asdict(TINY), "steps": 1_280}
    for name, value in settings.items():
        if name not in ("resume", "seeds", "suite", "data", "capacities"):
            command += [f"--{name.replace('_', '-')}", str(value)]
    environment = {**os.environ, "PYTHONPATH": str(REPO)}
    first = subprocess.Popen(command, env=environment, start_new_session=True, stdout=subprocess.DEVNULL)
    homes = [tmp_path / "runs" / "tiny" / f"seed-{seed}" for seed in (0, 1)]
    deadline = time.monotonic() + 60
    while not checkpoints(homes[0]) and time.monotonic() < deadline:
        time.sleep(0.01)
    os.killpg(first.pid, signal.SIGKILL)
    first.wait()
    assert checkpoints(homes[0])
    assert not (tmp_path / "runs" / "tiny" / "results.json").exists()
    again = [*command, "--resume", "--seeds", "2"]
    subprocess.run(again, env=environment, check=True, stdout=subprocess.DEVNULL, timeout=120)
    results = json.loads((tmp_path / "runs" / "tiny" / "results.json").read_text(encoding="utf-8"))
    assert results["seeds"] == [0, 1]
    for home in homes:
        assert curve_of(home) == list(range(128, 1_281, 128))
