"""Episodes by their numbers in a benchmark or from a pool, suites as environments, their worth, arguments as text."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from env_cases import last_info
from gymnasium.envs.registration import EnvSpec
from refusal_cases import refuse, refused

from bufgym import policies
from bufgym.benchmark.run import run
from bufgym.benchmark.sweep import Sweep, run_sweep
from bufgym.envs import SenderEnv, SenderVectorEnv
from bufgym.envs.expert import Player
from bufgym.model import qoi
from bufgym.scenario import Interruption, Streams, Uplink, suites
from bufgym.scenario.numbered import draw
from bufgym.traces import Trace, drive_motion, write_csv
from bufgym.utils.errors import BufgymError

PLAYED = ("random", "drop-oldest")
L = 2


def played(env: Any, policy: str, **reset: Any) -> dict[str, Any]:
    """The last info of the episode that ``policy`` plays."""
    player = Player(policies.get(policy))
    return last_info(env, lambda *_: player.action(env.unwrapped.sub_envs.senders), **reset)


def score(rows: list[dict[str, Any]], row: dict[str, Any]) -> float:
    """Between the Drop Oldest of the same episode and the clairvoyant."""
    (base,) = [
        other["qoi"]
        for other in rows
        if other["policy"] == "drop-oldest" and all(other[key] == row[key] for key in ("scenario", "trace", "seed"))
    ]
    gap = row["clairvoyant"] - base
    return (row["qoi"] - base) / gap if gap > 1e-9 * row["clairvoyant"] else math.nan


@pytest.fixture
def mixed(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A suite of two scenarios, each with a V of its own, on two traces."""

    def build(split: str, data: Path | None) -> dict[str, suites.Setting]:
        traces = tuple(Trace.steps([(1.0, 500_000), (2.0, 0)], name=f"{split}-{k}").scaled(1 + k / 2) for k in range(2))
        common: dict[str, Any] = {"traces": traces, "rate_hz": 5, "duration_s": 5, "size_bytes": 100_000}
        timed = Uplink(**common, value=qoi.saturating(3))
        moving = Uplink(**common, motion=(drive_motion(3, 30),), value=qoi.exponential(0.4))
        return {"time": suites.Setting(timed, "timed"), "motion": suites.Setting(moving, "moving")}

    monkeypatch.setitem(suites.SUITES, "mixed-v1", suites.Suite("mixed-v1", "mixed", build, (L,), 2))
    yield "mixed-v1"


def test_the_numbers_of_a_row_lead_to_its_episode(mixed: str, tmp_path: Path) -> None:
    """Alone and in a batch, for a randomised policy too; and what the episode was worth is what the row says."""
    rows = run_sweep(Sweep(mixed, PLAYED), tmp_path, backend="sequential", form="csv", progress=False)
    assert len(rows) == 2 * 2 * 2 * (len(PLAYED) + 1)  # and AFR
    rows = [row for row in rows if row["policy"] in PLAYED]
    env = gym.make("bufgym/Suite-v1", suite=mixed, split="test", capacity=L, bound=True, actions="slots")
    infos = []
    for row in rows:
        numbers = {name: row[name] for name in ("scenario", "trace", "seed")}
        infos.append(info := played(env, row["policy"], options=numbers))
        assert info["qoi"] == pytest.approx(row["qoi"])
        assert info["delivered"] == row["delivered"] and info["clairvoyant"] == pytest.approx(row["clairvoyant"])
        assert info["regret"] == pytest.approx(row["regret"])
        assert info["score"] == pytest.approx(score(rows, row), nan_ok=True)
        del numbers["trace"]  # the seed tells it
        assert played(env, row["policy"], options=numbers)["qoi"] == info["qoi"]
    assert len({round(info["qoi"], 9) for info in infos}) > 8  # they differ
    envs: Any = gym.make_vec(
        "bufgym/Suite-v1", len(rows), suite=mixed, split="test", capacity=L, bound=True, actions="slots"
    )
    _, _ = envs.reset(options={"episodes": [{k: row[k] for k in ("scenario", "trace", "seed")} for row in rows]})
    players = {name: Player(policies.get(name), len(rows)) for name in PLAYED}
    last: list[dict[str, Any]] = [{} for _ in rows]
    while not all(last):
        senders = envs.unwrapped.sub_envs.senders
        due = senders.batch.senders["waiting"]
        actions = [players[row["policy"]].action(senders, i) if due[i] else L for i, row in enumerate(rows)]
        _, _, ended, _, info = envs.step(np.array(actions))
        for i in np.flatnonzero(ended):
            last[i] = last[i] or {name: info[name][i] for name in ("qoi", "clairvoyant", "regret", "score")}
    for ours, alone in zip(last, infos, strict=True):
        assert ours == pytest.approx({name: alone[name] for name in ours}, nan_ok=True)


def test_the_rows_of_a_bench_without_a_suite_are_found_too() -> None:
    uplink = Uplink(traces=tuple(Trace.constant(2e6, 9, name="same") for _ in range(2)), duration_s=3)
    env = SenderEnv(uplink, L, actions="slots")
    for row in run([policies.get("random")], uplink, [L], 2):
        info = played(env, "random", options={"trace": row["trace"], "seed": row["seed"]})
        assert info["qoi"] == pytest.approx(row["qoi"])
    assert row["trace"] == "same#2" and played(env, "random", options={"trace": 1, "seed": 1})["qoi"] == info["qoi"]
    alone = SenderEnv(Interruption(t_max=30), L, actions="slots")
    alone.reset(options={"seed": 5})
    assert alone.sub_envs.senders.episodes[0].last_decision == draw(Interruption(t_max=30), 5).last_decision  # type: ignore[union-attr]


def suite_env(**arguments: Any) -> Any:
    return gym.make("bufgym/Suite-v1", **arguments, actions="slots")


@pytest.mark.parametrize(
    ("act", "says"),
    [
        (lambda suite: suite.reset(options={"scenario": "time"}), "options: no seed: it names a row, as in options="),
        (lambda suite: suite.reset(options={"scenario": "no", "seed": 0}), "'no': must be one of time"),
        (lambda suite: suite.reset(options={"seed": 0}), "scenario: missing; a suite's row has one"),
        (lambda suite: suite.reset(options={"scenario": "time", "seed": 2_000}), "trace = 2: must be 0..1"),
        (
            lambda suite: suite.reset(options={"scenario": "time", "seed": 0, "trace": "b"}),
            "unknown trace 'b'; known: .*, or their numbers 0..1",
        ),
        (lambda suite: suite.reset(options={"trace": "nope"}), "unknown trace 'nope'"),
        (lambda suite: suite.reset(options={"episode": None, "seed": 0}), "options: an episode, or its scenario"),
        (lambda suite: suite.reset(options=5), "options = 5: must be a dict of episode, scenario, trace, seed"),
        (lambda suite: suite.reset(options={"number": 3}), "known: episode, scenario, trace, seed"),
        (
            lambda _: SenderEnv("lte", L, actions="slots").reset(options={"scenario": "lte", "seed": 0}),
            "only the episodes of a suite",
        ),
        (
            lambda _: SenderEnv("lte", L, actions="slots").reset(options={"seed": 0}),
            r"trace = None: must be 0..7 or one of lte",
        ),
        (
            lambda _: SenderEnv("lte", L, actions="slots").reset(options={"trace": "lte-synth-3"}),
            "'lte-synth-3'; did you mean 'lte-synthetic-3'",
        ),
        (
            lambda _: SenderEnv("lte", L, actions="slots").reset(options={"trace": "nope"}),
            "unknown trace 'nope'; known: lte-synthetic-0, .* 0..7",
        ),
        (
            lambda _: SenderVectorEnv(1, "lte", actions="slots").reset(options={"episodes": [{"k": 1}]}),
            "unknown entry .k.; known",
        ),
        (lambda _: suite_env(suite="topics-v1"), "suite topics-v1 is one of topics"),
        (lambda _: suite_env(split="all"), "split = 'all': must be one of train, validation, test"),
        (lambda _: suite_env(suite="lte-belgium-v1"), "needs a folder of recordings"),
        (lambda _: gym.make("bufgym/Topics-v0", bound=True), "bound = True: the clairvoyant is known for one queue"),
    ],
)
def test_no_such_episode_or_suite(mixed: str, act: Any, says: str) -> None:
    refuse(says, act, SenderEnv("suite", L, suite=mixed, split="test", actions="slots"))


@pytest.mark.parametrize(
    ("T", "action", "h", "best", "score"),
    [
        (3, 1, 1.9375, 2.5, -3.5),  # reject all: 1 + V(4), where 1 + 2 V(2) was possible and Drop Oldest has 2.375
        (3, 0, 2.375, 2.5, 0.0),  # the oldest goes each time: 1 + V(3) + V(1)
        (2, 0, 2.25, 2.25, math.nan),  # whichever of the two is kept, 1 + V(1) + V(2)
    ],
)
def test_the_bound_worked_by_hand(T: int, action: int, h: float, best: float, score: float) -> None:
    """L = 1, V(d) = 1 - 0.5^d, an interruption of T messages."""
    given: dict[str, Any] = {"law": "fixed", "t_max": T, "value": "exponential:0.5", "disable_env_checker": True}
    env = gym.make("bufgym/Interruption-v1", capacity=1, bound=True, **given, actions="slots")
    env.reset(seed=0)
    ended, info, first = False, {}, action != 1
    while not ended:
        _, _, ended, _, info = env.step(2 if first else action)  # there is room for the first
        assert ended or "score" not in info
        first = False
    found = [info[name] for name in ("qoi", "clairvoyant", "regret", "score")]
    assert info["certified"] == 1
    assert found == pytest.approx([h, best, 1 - h / best, score], nan_ok=True)


TEXTS: list[tuple[str, dict[str, Any], dict[str, Any]]] = [
    ("bufgym/Interruption-v1", {"value": "saturating:4"}, {"value": qoi.saturating(4)}),
    ("bufgym/Uplink-v1", {"traces": "lte-synthetic-3", "motion": "drive-1"}, {}),
    ("bufgym/Uplink-v1", {"traces": ["lte-synthetic-3", "lte-synthetic-0"], "motion": "none", "scale": [0.5, 2]}, {}),
    ("bufgym/Topics-v0", {"traces": "lte-synthetic-3", "motion": ["drive-0"], "value": "exponential:0.5"}, {}),
    ("bufgym/Topics-v0", {"scenario": "examples/client.toml"}, {}),
    ("bufgym/Suite-v1", {"suite": "interruption-v1", "split": "validation"}, {}),
]


@pytest.mark.parametrize(("env_id", "arguments", "objects"), TEXTS)
def test_text_makes_the_same_also_as_json(env_id: str, arguments: dict[str, Any], objects: dict[str, Any]) -> None:
    env: Any = gym.make(env_id, capacity=3, **arguments)
    again: Any = gym.make(EnvSpec.from_json(env.spec.to_json()))
    scenario = env.unwrapped.sub_envs.scenario
    for name, expected in objects.items():
        assert getattr(scenario, name) == expected
    if "traces" in arguments:
        names = arguments["traces"]
        assert [trace.name for trace in scenario.traces] == ([names] if isinstance(names, str) else names)
        motions = [name for name in np.atleast_1d(arguments["motion"]) if name != "none"]
        assert [motion.name for motion in scenario.motion] == motions
    assert again.unwrapped.sub_envs.scenario.value == scenario.value
    for first, second in zip(env.reset(seed=3), again.reset(seed=3), strict=True):
        np.testing.assert_equal(first, second)


def test_text_may_name_a_file(tmp_path: Path) -> None:
    write_csv(Trace.steps([(1.0, 500_000), (2.0, 0)]), tmp_path / "mine.csv")
    (tmp_path / "recording.csv").write_text("time_s,bytes\n0,1000\n0.5,2000\n1,500\n")
    env: Any = gym.make(
        "bufgym/Uplink-v1",
        traces=str(tmp_path / "mine.csv"),
        workload=str(tmp_path / "recording.csv"),
        motion="none",
        actions="slots",
    )
    env.reset(seed=0)
    assert env.unwrapped.sub_envs.senders.episodes[0].arrivals["size_bytes"].tolist() == [1000, 2000, 500]


def uplink(**arguments: Any) -> Any:
    return gym.make("bufgym/Uplink-v1", **arguments, actions="slots")


test_text_that_names_nothing = refused(
    (lambda: uplink(traces="nowhere"), "nowhere: no such file, and no shipped trace"),
    (lambda: uplink(motion=["drive-0", "nowhere"]), "nowhere: no such file"),
    (lambda: uplink(value=3), "value = 3: must be a bufgym.model.qoi Value, a function"),
    (lambda: uplink(workload="nowhere.csv"), "nowhere.csv"),
    (lambda: uplink(scenario="nowhere.toml"), "nowhere.toml"),
)


SLOW: dict[str, dict[str, Any]] = {
    "bufgym/Interruption-v1": {"t_max": 30},
    "bufgym/Uplink-v1": {"duration_s": 4.0, "size_bytes": 1_000_000},
    "bufgym/Suite-v1": {"suite": "interruption-v1"},
}


@pytest.mark.parametrize("env_id", SLOW)
def test_a_randomised_policy_is_random_in_an_environment(env_id: str) -> None:
    """Same seed same run, alone and as a row of a batch; other seeds and Drop Oldest differ; and the episode keeps
    its draws, so that a rollout does the same."""
    env: Any = gym.make(env_id, capacity=3, **SLOW[env_id], actions="slots")

    def sent(policy: str, seed: int) -> list[int]:
        played(env, policy, seed=seed)
        senders = env.unwrapped.sub_envs.senders
        return [int(k) for k in senders.batch.order[0, : senders.batch.senders[0]["transmitted"]]]

    random = [sent("random", seed) for seed in range(4)]
    assert random == [sent("random", seed) for seed in range(4)]
    assert random != [sent("drop-oldest", seed) for seed in range(4)]
    env.reset(seed=0)
    Player(policies.get("random")).action(env.unwrapped.sub_envs.senders)
    assert env.unwrapped.sub_envs.senders.episodes[0].arrivals["uniform"].any()


UPLINK = Uplink(traces=(Trace.steps([(0.4, 9e6), (0.5, 0), (0.6, 2e6)]),), jitter=0.8, duration_s=0.4)
CAPACITY = 3


def test_a_reset_that_is_refused_touches_no_row() -> None:
    """Of three episodes given the last is too long: the rows before it go on with what they have."""
    batch = SenderVectorEnv(3, UPLINK, CAPACITY, actions="slots")
    batch.reset(seed=1)
    before = batch.sub_envs.senders.batch.arrivals.copy()
    long = Uplink(traces=UPLINK.traces, duration_s=2.0).draw(Streams.seeded(3))
    with pytest.raises(BufgymError, match="these senders have room for"):
        batch.reset(options={"episodes": [UPLINK.draw(Streams.seeded(2)), None, long]})
    assert (batch.sub_envs.senders.batch.arrivals == before).all() and batch.sub_envs.senders.begun.tolist() == [
        1,
        1,
        1,
    ]
