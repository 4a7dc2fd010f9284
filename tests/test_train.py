"""Training end to end with tiny settings: what it leaves behind, and that a killed run goes on."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_cases import Capsys, Patch
from refusal_cases import refuse
from train_cases import KilledError, columns, in_a_folder_of_its_own  # noqa: F401

import train
from agents import held_out, ppo, runs
from agents.callbacks import Curve, checkpoints
from agents.constants import NAMES, UNTAUGHT
from agents.held_out import FixedEpisodes
from agents.hindsight_network import Student
from agents.learner import learner_of
from agents.report import verdict
from agents.settings import DQN, PPO, Environment, Hindsight, SingleDecisions, Suites
from bufgym import policies
from bufgym.benchmark.rows import read_rows
from bufgym.policies import registry
from bufgym.scenario import suites
from bufgym.utils.errors import BufgymError

SHARED: dict[str, Any] = {"name": "tiny", "steps": 512, "validate_every": 250_000, "validation_episodes": 2}
SMALL: dict[str, Any] = {**SHARED, "width": 8, "num_envs": 4, "batch_size": 64, "checkpoint_every": 128}
UPDATE: dict[str, Any] = {"n_steps": 32, "epochs": 1}
REPLAYED: dict[str, Any] = {"train_freq": 2, "gradient_steps": 1, "learning_starts": 64, "target_update_interval": 128}
ON = Environment(capacity=3, duration_s=1.0, episodes=3)
TINY = PPO(environment=ON, **SMALL, **UPDATE)
TYPED = PPO(environment=Environment(capacity=3, episodes=3), width=8, learning_rate=1e-3, **SHARED)
"""Settings that are all options."""
LEARNERS = {"ppo": TINY, "dqn": DQN(environment=ON, **SMALL, **REPLAYED)}
ON_SUITE: dict[str, Any] = {"suites": Suites(("interruption-v1",), capacities=(4, 6), test_seeds=10), "name": "tiny"}
ON_SUITE |= {"steps": 1_152, "validate_every": 384, "validation_episodes": 60}
ROWS = {"num_envs": 12, "batch_size": 96}
SUITE: dict[str, Any] = {
    name: dataclasses.replace(learner, **ON_SUITE, **ROWS, environment=type(learner.environment)())
    for name, learner in LEARNERS.items()
} | {"hindsight": Hindsight(**ON_SUITE, **ROWS)}
"""Three updates of 384 decisions: two rows of each of 3 scenarios x 2 capacities, 32 steps each."""


def curve_of(folder: Path) -> list[float]:
    return [steps for (steps,) in columns(folder / "curve.csv", "steps")]


@pytest.mark.parametrize("env", ["bufgym/Uplink-v1", pytest.param("bufgym/Interruption-v1", marks=pytest.mark.nightly)])
def test_a_run_leaves_its_results(env: str, capsys: Capsys) -> None:
    plain = "Inter" in env
    on = Environment("bufgym/Interruption-v1", 3, episodes=3) if plain else dataclasses.replace(ON, duration_s=3.0)
    train.main(dataclasses.replace(TINY, environment=on, steps=128))
    folder = Path("runs/tiny")
    results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    rows = {row["policy"]: row for row in results["scores"]}
    assert set(rows) == {*registry.names(for_topics=False), *NAMES, "agent (seed 0)"} and len(rows) == len(
        results["scores"]
    )
    assert list(rows) == sorted(rows, key=lambda name: -rows[name]["qoi"])
    assert all(row["arrived"] == pytest.approx(row["delivered"] + row["dropped"]) for row in rows.values())
    assert len({row["arrived"] for row in rows.values()}) == 1  # all met the same episodes
    assert rows["agent (seed 0)"]["invalid"] == 0 and results["settings"]["env"] == env
    notes = json.loads((folder / "notes.json").read_text(encoding="utf-8"))
    assert notes["training"].startswith("python train.py ppo --") and notes["seeds"] == [0]
    assert notes["scores"]["qoi"] == rows["agent (seed 0)"]["qoi"]
    assert json.loads((folder / "seed-0" / "notes.json").read_text(encoding="utf-8"))["seeds"] == [0]
    assert (folder / "figure.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / runs.MODEL).exists()
    assert list((folder / "seed-0" / "tensorboard").glob("events*"))
    printed = capsys.readouterr().out
    assert "drop-oldest" in printed and "agent (seed 0)" in printed


def test_two_ways_are_compared_and_the_best_is_kept(capsys: Capsys) -> None:
    """The first validation is of the network before it is taught."""
    on = Environment(capacity=8, duration_s=3.0, episodes=3)
    taught = Hindsight(environment=on, **{**SHARED, "steps": 3_000, "validate_every": 3_000})
    train.main(taught, train.others_of(taught))
    folder = Path("runs/tiny")
    (_, first), *_ = columns(folder / "hindsight" / "seed-0" / "validation.csv", "steps", "qoi")
    judges, test = FixedEpisodes(on, "validation", 2), FixedEpisodes(on, "test", 3)
    untaught = Student(taught.resolved.candidates, taught.width).weights().policy("untaught")
    assert first == np.mean([outcome.qoi for outcome in judges.play(untaught)])
    results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    scores = {row["policy"]: row["qoi"] for row in results["scores"]}
    best = results["settings"]["algo"]
    for algo in ("hindsight", "ppo"):
        name = "agent (seed 0)" if algo == best else f"agent by {algo} (seed 0)"
        agent = policies.load(folder / algo / "seed-0" / runs.MODEL)
        assert scores[name] == np.mean([outcome.qoi for outcome in test.play(agent)])
    assert (folder / runs.MODEL).read_bytes() == (folder / best / "seed-0" / runs.MODEL).read_bytes()
    assert "the best rule written by hand, " in capsys.readouterr().out


def test_a_killed_run_goes_on_from_its_checkpoint(monkeypatch: Patch) -> None:
    folder = runs.prepare(TINY)
    row = Curve._on_rollout_end

    def dies_half_way(self: Curve) -> None:
        row(self)
        if self.num_timesteps >= 384:
            raise KilledError

    with monkeypatch.context() as patch, pytest.raises(KilledError):
        patch.setattr(Curve, "_on_rollout_end", dies_half_way)
        learner_of(TINY).train_seed(folder, 0)
    home = folder / "seed-0"
    # The untrained agent was validated. The third rollout was collected, but not learnt from: it does not count.
    assert [path.stem for path in checkpoints(home)] == ["000000000000", "000000000128", "000000000256"]
    assert curve_of(home) == [128, 256, 384]
    before = ppo.sb3.PPO.load(checkpoints(home)[-1])
    again = dataclasses.replace(TINY, resume=True)
    assert runs.prepare(again) == folder
    run = learner_of(again).train_seed(folder, 0)
    assert curve_of(home) == [128, 256, 384, 512] and run.seconds > 0
    after = ppo.sb3.PPO.load(checkpoints(home)[-1])
    assert (before.num_timesteps, after.num_timesteps) == (256, 512)
    # The optimizer went on counting, two gradient steps an update.
    assert {int(state["step"]) for state in after.policy.optimizer.state_dict()["state"].values()} == {8}
    # Once more: there is nothing left to do.
    assert learner_of(again).train_seed(folder, 0).curve == run.curve


def test_what_ctrl_c_says_goes_on(monkeypatch: Patch, capsys: Capsys) -> None:
    """The first run has no name: the command names the folder that it got."""
    words = dataclasses.replace(TYPED, name="").command.split()[2:]

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    gone_on: list[Any] = []
    for typed, more in ((words, "--name train-1 --resume"), ([*words, "--name=mine"], "--resume")):
        monkeypatch.setattr(train, "_train", stop)
        with pytest.raises(SystemExit) as ended:
            train.typed(typed)
        going_on = f"python train.py {' '.join(typed)} {more}"
        assert ended.value.code == 130 and capsys.readouterr().err == f"stopped; {going_on} goes on\n"
        monkeypatch.setattr(train, "_train", lambda *run: gone_on.append(run))
        with pytest.raises(SystemExit):
            train.typed(going_on.split()[2:])
        name = "mine" if typed[-1] == "--name=mine" else "train-1"
        assert gone_on.pop() == (Path("runs") / name, dataclasses.replace(TYPED, name=name, resume=True), ())


def test_a_run_is_not_overwritten_or_mixed_with_another() -> None:
    unnamed = dataclasses.replace(TINY, name="")
    assert runs.prepare(unnamed) == Path("runs/train-1")
    assert runs.prepare(unnamed) == Path("runs/train-2")
    assert runs.prepare(dataclasses.replace(unnamed, resume=True)) == Path("runs/train-2")
    runs.prepare(TINY)
    refuse("exists", runs.prepare, TINY)
    with pytest.raises(BufgymError, match="capacity was 3, now 4"):
        runs.prepare(dataclasses.replace(TINY, resume=True, environment=dataclasses.replace(ON, capacity=4)))
    refuse("no run", runs.prepare, dataclasses.replace(TINY, resume=True, name="other"))


def test_held_out_traces_are_never_trained_on() -> None:
    trained, tested = ({trace.name for trace in part.traces} for part in held_out.split_scenario(ON))  # type: ignore
    assert trained and len(tested) == 16 and not trained & tested


SPLITS = ("test", "validation")


def test_episodes_are_scored_between_drop_oldest_and_the_clairvoyant() -> None:
    on = dataclasses.replace(ON, duration_s=5.0, episodes=4)
    test, validation = (held_out.fixed_episodes(dataclasses.replace(TINY, environment=on), s) for s in SPLITS)
    assert (len(test.episodes), len(validation.episodes)) == (4, 2)
    outcomes = {name: test.play(policies.get(name)) for name in ("drop-oldest", "afr", "rosbridge", "clairvoyant")}
    assert test.score(outcomes["drop-oldest"]) == 0 and test.score(outcomes["clairvoyant"]) == pytest.approx(1)
    entries = {entry["policy"]: entry for entry in held_out.summarise(outcomes, test.rows(outcomes), "afr")}
    low, high = entries["afr"]["score_95"]
    assert low <= entries["afr"]["score"] <= high
    assert entries["afr"]["score"] == pytest.approx(test.score(outcomes["afr"]))
    assert np.isnan(entries["rosbridge"]["score"]) and entries["afr"]["minus_agent"] == 0


@pytest.mark.nightly
@pytest.mark.parametrize("algo", SUITE)
def test_a_suite_is_trained_validated_and_tested_on(algo: str, capsys: Capsys) -> None:
    train.main(SUITE[algo])
    folder = Path("runs/tiny")
    results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    agent = f"agent ({SUITE[algo].algo})"
    standings = {standing["policy"]: standing for standing in results["standings"]}
    untaught = [policy.name for policy in UNTAUGHT]
    assert set(standings) == {*registry.names(for_topics=False), *untaught, agent}
    assert not standings[agent]["unranked_because"]
    assert {cell["exact"] for cell in results["cells"]} == {True}
    assert results["held_out"] == {"suite": "interruption-v1", "split": "test", "episodes": 60}
    # The columns of the benchmark, and the training seed: none for a fixed policy.
    rows = read_rows(folder / "rows.csv")
    assert {(row["policy"] == agent, row["training_seed"]) for row in rows} == {(True, 0), (False, None)}
    assert {row["scenario"] for row in rows} == set(suites.get("interruption-v1").settings("test"))
    assert not any(row["invalid"] for row in rows if row["policy"] == agent)
    # Validated before the first update, every 384 steps, and at the end; the best is kept.
    home = folder / "seed-0"
    merit = (home / "validation.csv").read_text(encoding="utf-8").splitlines()[0].split(",")[-1]
    validation = {int(steps): value for steps, value in columns(home / "validation.csv", "steps", merit)}
    assert (folder / runs.MODEL).read_bytes() == (home / runs.MODEL).read_bytes()
    if algo in LEARNERS:
        assert list(validation) == [0, 384, 768, 1152]
        best = min(validation, key=lambda steps: validation[steps])
        assert (home / "model.zip").read_bytes() == (home / "checkpoints" / f"{best:012d}.zip").read_bytes()
    assert results["validation"] == {"0": min(validation.values())}
    assert (folder / "figure.png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    assert agent in printed and "cells (scenario, L) count" in printed


def weights(arguments: SingleDecisions, name: str) -> dict[str, np.ndarray]:
    learner: Any = learner_of(arguments)
    run = learner.train_seed(runs.prepare(dataclasses.replace(arguments, name=name)), arguments.seed)
    model = learner.algorithm.load(run.folder / "model.zip")
    return {key: tensor.numpy() for key, tensor in model.policy.state_dict().items()}


@pytest.mark.parametrize("algo", LEARNERS)
def test_the_same_seed_gives_the_same_weights_bit_for_bit(algo: str) -> None:
    arguments = dataclasses.replace(LEARNERS[algo], steps=128)
    first, again = weights(arguments, "first"), weights(arguments, "again")
    assert all((first[key] == again[key]).all() for key in first)
    other = weights(dataclasses.replace(arguments, seed=1), "other")
    assert not all((first[key] == other[key]).all() for key in first)


POSITIVE = (*("seeds", "capacity", "episodes", "width", "num-envs", "batch-size", "learning-rate"),)
OR_ZERO = ("seed", "steps", "validate-every", "validation-episodes", "gamma")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        *((f"ppo --{name}=0", f"--{name}: 0: must be") for name in POSITIVE),
        *((f"ppo --{name}=-1", f"--{name}: -1: must be") for name in (*POSITIVE, *OR_ZERO)),
        *((f"ppo --{name}=nan", f"--{name}: nan: must be") for name in ("gamma", "learning-rate")),
        *((f"ppo --{name}=no", f'"no" for --{name}. Choose from') for name in ("env", "reward")),
        ("ppo --gamma 1.5", "1.5: must be a number from 0 to 1"),
        ("ppo --batch-size 1", "1: must be a whole number >= 2"),
        ("--suite lte-belgium-v1", "needs a folder of recordings"),
        ("--suite no-such", "unknown suite 'no-such'"),
        ("--suite lte-v1,topics-v1", "suite lte-v1,topics-v1: an agent for topics or a fleet learns from one suite"),
        ("--suite lte-v1 --capacity 5", "--suite: it has environments of its own"),
        ("--suite lte-v1 --capacities 5", "Unknown option: --capacities"),
        ("--suite nowhere:LAB", "nowhere:LAB: no module 'nowhere' in"),
        ("dqn --suite fleet-v1", "regret of robots that share a link: give --reward retained --gamma 0.5"),
        ("--suite fleet-v1", "suite fleet-v1: hindsight learns none of this kind; these do: ppo, dqn"),
        ("--suite topics-v1", "suite topics-v1: hindsight learns none of this kind; these do: tune RULE --on SUITE"),
        ("ppo --width 1000", "width = 1000: a file of weights has at most 256 hidden units a layer"),
        ("ppo --backend dask", "Unknown option: --backend"),
        ("tune no-such", "unknown policy 'no-such'"),
        ("tune target-gap --on no-such", "unknown scenario 'no-such'"),
        ("tune target-gap --parameters pase_s", "unknown parameter 'pase_s'"),
        ("--resume --name none", "there is no run in"),
        ("--algo guided --num-envs 8", "type python train.py hindsight, then"),
        ("--suite lte-v1 --algo=maskable-ppo", "type python train.py ppo, then"),
        ("--algo cma-es", "type python train.py tune RULE, then"),
    ],
)
def test_mistakes_end_in_one_line_before_a_folder_is_made(words: str, message: str, capsys: Capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        train.typed(words.split())
    said = str(ended.value.code) if isinstance(ended.value.code, str) else " ".join(capsys.readouterr().err.split())
    assert said.startswith("error: ") and said.count("error") == 1 and message in said
    assert not Path("runs").exists()


def test_the_command_of_a_run_gives_its_settings_again() -> None:
    suites = Suites(("interruption-v1", "outage-v1"))
    for settings in (TYPED, Hindsight(suites=suites), PPO(suites=Suites(("fleet-v1",)), reward="retained")):
        made: list[Any] = []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(train, "main", made.append)
            with pytest.raises(SystemExit):
                train.typed(settings.command.split()[2:])
        assert made == [dataclasses.replace(settings, name="")]
    assert (
        TINY.command == "python train.py ppo --steps 512 --validate-every 250000 --validation-episodes 2 "
        "--capacity 3 --episodes 3 --width 8 --num-envs 4"
    )
    refuse("its messages have no size", Environment, "bufgym/Interruption-v1", size_bytes=5)


def test_without_words_two_ways_are_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    """``python train.py``, the command of ``make train``."""
    asked: list[Any] = []
    monkeypatch.setattr(train, "main", lambda settings, others=(): asked.append((settings, others)))
    with pytest.raises(SystemExit):
        train.typed([])
    assert asked == [(Hindsight(), [PPO(steps=60_000)])]


def test_seeds_together_have_an_interval_over_seeds_and_links() -> None:
    """Two rules stand for two trainings: the mean of their scores, and no narrower than the better known of the two."""
    test = FixedEpisodes(dataclasses.replace(ON, duration_s=10.0), "test", 6)
    outcomes = {name: test.play(policies.get(name)) for name in ("drop-oldest", "afr", "target-gap", "min-motion-gap")}
    rows, agents = test.rows(outcomes), [(0, "target-gap"), (1, "min-motion-gap")]
    joined = held_out.together(rows, {"ppo": agents})["ppo"]
    alone = {name: test.score(outcomes[name]) for _, name in agents}
    assert joined.score.value == pytest.approx(sum(alone.values()) / 2)
    # Two seeds: their mean's error is half of their difference, and Student's t with one degree of freedom is 12.7.
    away = abs(alone["target-gap"] - alone["min-motion-gap"]) / 2
    assert joined.score.value - joined.score.low > 12 * away > 0 and joined.score.high <= 1
    assert joined.difference.value == pytest.approx(
        np.mean([outcome.qoi for _, name in agents for outcome in outcomes[name]])
        - np.mean([outcome.qoi for outcome in outcomes["afr"]])
    )


def test_the_verdict_says_how_far_above_whom() -> None:
    def entry(policy: str, score: float, low: float, high: float) -> dict[str, Any]:
        return {"policy": policy, "score": score, "minus_agent_95": [low, high]}

    entries = [
        *(entry("learned", 0.75, 0.1, 0.3), entry("a", 0.7, 0.0, 0.0), entry("min-gap", 0.69, -0.2, 0.1)),
        *(entry("agent by ppo (seed 1)", 0.6, -2.0, -1.0), entry("agent by ppo (seed 0)", 0.5, -3.0, -1.0)),
        *(entry("always 1", 0.45, -5.0, -4.0), entry("afr", 0.4, -5.0, -4.0), entry("always 0", 0.3, -5.0, -4.0)),
    ]
    assert verdict(entries, "a", 61.4, "hindsight", "other links") == (
        "after 61 s a, by hindsight, scores 0.700 on episodes of other links: "
        "above the better constant action, always 1, by 0.250, above AFR by 0.300, "
        "level with the best rule written by hand, min-gap, (+0.010), "
        "below learned by 0.050, above agent by ppo (seed 1) by 0.100"
    )
