"""Evolved agents: where they begin, what they leave behind, that a killed run goes on and a seed repeats itself."""

from __future__ import annotations

import csv
import dataclasses
import pickle
from pathlib import Path

import numpy as np
import pytest

for extra in ("sb3_contrib", "tqdm", "tensorboard", "cma"):
    pytest.importorskip(extra, reason="the extra [train] is not installed")

import train  # noqa: E402  (these need the extra)
from agents import evolution, grounds, training, worlds  # noqa: E402
from bufgym import policies  # noqa: E402
from bufgym.errors import BufgymError  # noqa: E402
from bufgym.oracle import integer, law  # noqa: E402
from bufgym.policies import learned, weights  # noqa: E402
from bufgym.scenario import Interruption  # noqa: E402
from bufgym.sim import run  # noqa: E402
from bufgym.sim.metrics import outcome  # noqa: E402

TINY = train.Arguments(
    suite="interruption-v1",
    capacities="4",
    algo="evolution",
    name="tiny",
    steps=60_000,
    validate_every=20_000,
    validation_episodes=30,
    test_seeds=25,
)


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(("sees", "like"), [("motion", "min-motion-gap"), ("time", "min-gap")])
def test_it_begins_with_the_smallest_merged_gap(sees: str, like: str) -> None:
    """Without its leaning towards the new, the regret of the first weights is that of the policy they stand for."""
    weights = evolution.start(evolution.SEES[sees], 3, np.random.default_rng(0))
    weights.drop.skip[weights.fields.index("rank")] = 0.0
    (ground,) = grounds.grounds([SHORT], seed=1)
    assert ground.regret(learned.policy("first", weights)) == ground.regret(policies.get(like))


def test_weights_are_a_vector_and_back() -> None:
    """Searched are all numbers but those that every drop shares, and the acceptance's hidden layer."""
    made = evolution.start(evolution.MOTION, 3, np.random.default_rng(0))
    assert (made.slot, made.context) == (evolution.MOTION[:5], evolution.MOTION[5:])
    vector = evolution.to_vector(made)
    assert len(vector) == 5 + (10 * 3 + 3 + 3) + (10 + 1) + 5 * 5
    again = evolution.from_vector(made, vector)
    assert (evolution.to_vector(again) == vector).all()
    assert (again.memory() == made.memory()).all()
    changed = evolution.from_vector(made, np.arange(len(vector), dtype=float))
    assert changed.drop.skip.tolist() == [0, 1, 2, 3, 4, *[0] * 5]  # 0: what the context adds to every drop
    assert changed.mix is not None and changed.mix[-1, -1] == len(vector) - 1
    assert (changed.accept.layers[0][0] == made.accept.layers[0][0]).all()


# --- grounds ---------------------------------------------------------------------------------------------------------


SHORT = worlds.Cell("short", Interruption(t_max=40), 5)


@pytest.mark.parametrize("name", ["afr", "min-gap", "drop-oldest", "drop-newest", "linear-alpha"])
def test_one_run_through_the_longest_interruption_is_a_run_through_each(name: str) -> None:
    (ground,) = grounds.grounds([SHORT], seed=1)
    assert isinstance(ground, grounds.Lengths) and ground.exact
    scenario, policy = ground.scenario, policies.get(name)
    each = [outcome(run(policy, [scenario.episode(T)], 5, scenario.value), 0).qoi for T in range(1, 41)]
    np.testing.assert_allclose(ground.qoi(policy)[1:], each, rtol=1e-12)
    best = [1 + integer(5, T, scenario.value) for T in range(1, 41)]
    share = law(scenario)[1:]
    assert ground.regret(policy) == pytest.approx(1 - share @ each / (share @ best), abs=1e-12)


@pytest.mark.slow
def test_sampled_grounds_take_traces_in_turn_and_meet_the_same_episodes_again() -> None:
    given = worlds.cells("sustained-v1", "train", (5, 10))
    found = grounds.grounds(given[:4], seed=3, episodes=8)
    assert [ground.cell for ground in found] == given[:4]
    episodes = [ground.episodes for ground in found if isinstance(ground, grounds.Sampled)]
    assert [len(drawn) for drawn in episodes] == [2] * 4
    traces = [episode.link.trace.name for drawn in episodes for episode in drawn]
    assert len(set(traces)) == 8
    afr = policies.get("afr")
    assert found[0].regret(afr) == found[0].regret(afr)
    assert len(grounds.grounds(given, seed=3, episodes=3)) == 3  # fewer episodes than cells: so many cells


def test_a_yard_asks_for_the_better_of_afr_and_drop_oldest() -> None:
    """As good as the better one on every ground is 1; on exact grounds each counts, the worst most."""
    cells = [SHORT, SHORT._replace(capacity=9)]
    yard = grounds.Yard(grounds.grounds(cells, seed=1))
    afr = policies.get("afr")
    assert yard.over_rivals(afr) == pytest.approx(1.0)
    mine = [g.regret(policies.get("min-gap")) / g.regret(afr) for g in yard.grounds]
    assert yard.over_rivals(policies.get("min-gap")) == pytest.approx(np.sqrt(np.mean(np.square(mine))))
    assert yard.over_rivals(policies.get("drop-newest")) == grounds.WORST
    assert yard.decisions() == 2 * 42


@pytest.mark.slow
def test_interruptions_side_by_side_are_what_each_is_alone() -> None:
    """Rows of one batch with L of their own, again and again, in two V."""
    cells = worlds.cells("interruption-v1", "train", (1, 4, 9))[:6]
    given = [ground for ground in grounds.grounds(cells, seed=1) if isinstance(ground, grounds.Lengths)]
    assert len(given) == 6
    for one_v in (given[:3], given[3:]):
        together = grounds.SideBySide(one_v)
        for name in ("min-gap", "afr", "min-gap"):
            assert together.regrets(policies.get(name)) == [g.regret(policies.get(name)) for g in one_v]


@pytest.mark.slow
def test_a_yard_in_parts_asks_for_what_the_rivals_reach_on_all_of_them() -> None:
    """Two parts with one ground each, of the same L and V: each part's regret over the mean of both rivals'."""
    cell = worlds.cells("sustained-v1", "train", (10,))[1]
    parts = [grounds.grounds([cell], seed, episodes=1) for seed in (1, 2)]
    yard, policy = grounds.Yard(*parts), policies.get("min-gap")
    mine = [part[0].regret(policy) for part in parts]
    assert mine[0] != mine[1]
    rival = yard.rivals.mean()
    assert yard.over_rivals(policy, 0) == pytest.approx(mine[0] / rival)
    assert yard.over_rivals(policy, 3) == pytest.approx(mine[1] / rival)  # parts are taken in turn
    assert yard.over_rivals(policy) == pytest.approx(np.mean(mine) / rival)
    assert yard.decisions() == yard.decisions(0) + yard.decisions(1)


# --- two scorers -----------------------------------------------------------------------------------------------------


def test_the_scorer_of_a_still_link_is_searched_alone_with_its_own_hidden_layer() -> None:
    still = evolution.start(evolution.MOTION, 6, np.random.default_rng(0))
    whole = dataclasses.replace(evolution.start(evolution.MOTION, 0, np.random.default_rng(0)), still=still)
    first = evolution.Search.of(whole, True, seed=0)
    vector = np.arange(len(evolution.to_vector(still)), dtype=float)
    made = first.weights(vector)
    assert made.still is not None and made.still.widths == (6, 0) and made.widths == (0, 0)
    assert (evolution.to_vector(made.still) == vector).all()
    assert (evolution.to_vector(made) == evolution.to_vector(whole)).all()
    second = evolution.Search.of(made, False, seed=0)
    again = second.weights(np.arange(len(evolution.to_vector(whole)), dtype=float))
    assert again.still is made.still and again.drop.skip[2] == 2


# --- runs ------------------------------------------------------------------------------------------------------------


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


@pytest.mark.slow
def test_a_warm_up_learns_a_second_scorer_first() -> None:
    few = {"capacities": "25", "validation_episodes": 200, "steps": 100_000, "warm_up": 20_000, "still_hidden": 2}
    both = dataclasses.replace(TINY, suite="interruption-v1,sustained-v1", name="warm", **few)
    (run,) = training.train_all(both, training.prepare(both))
    search = pickle.loads((run.folder / "evolution.pkl").read_bytes())
    agent, first = search.mean, evolution.start(evolution.MOTION, 2, np.random.default_rng(0))
    assert not search.still and agent.still.widths == (2, 0) and agent.widths == (0, 0)
    for mean, begin in ((agent.still, first), (agent, search.like)):
        assert (evolution.to_vector(mean) != evolution.to_vector(begin)).any()


def test_a_warm_up_needs_interruptions() -> None:
    lonely = dataclasses.replace(TINY, suite="sustained-v1", capacities="25", warm_up=20_000)
    with pytest.raises(BufgymError, match="needs a suite of interruptions"):
        evolution.train(lonely, training.prepare(lonely), 0)


@pytest.mark.slow
def test_several_suites_at_once_have_a_table_each(capsys: pytest.CaptureFixture[str]) -> None:
    few = {"capacities": "25", "test_seeds": 1, "validation_episodes": 200, "steps": 200_000}
    both = dataclasses.replace(TINY, suite="interruption-v1,sustained-v1", name="both", sees="time", hidden=0, **few)
    train.main(both)
    told = capsys.readouterr().out
    for suite in both.suites:
        assert f"\n{suite}\n" in told
        assert Path(f"runs/both/{suite}/rows.csv").exists()
    agent, noted = weights.read("runs/both/model.safetensors")
    assert agent.fields == evolution.TIME and agent.mix is not None and noted["suite"] == both.suite


def test_it_needs_a_suite() -> None:
    with pytest.raises(SystemExit, match="name one"):
        train.main(dataclasses.replace(TINY, suite=""))
