"""Learning from the clairvoyant: the student begins as a rule, its costs are the clairvoyant's, and they fall."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from agents import hindsight_rows, ready_families
from agents.held_out import split_scenario
from agents.hindsight import HindsightLearner, School
from agents.hindsight_network import Student, expected
from agents.hindsight_rows import Lesson, Lessons, Part, Ruled, TaughtRows
from agents.mixed_env import Cell
from agents.objectives import families
from agents.runs import MODEL
from agents.settings import Hindsight
from agents.tasks import FAMILY_NAMES, Environment, Families, Suites
from bufgym import policies
from bufgym.envs import SenderVectorEnv
from bufgym.envs.expert import clairvoyant
from bufgym.policies import weights
from bufgym.policies.candidate_network import inputs
from bufgym.policies.ruled_network import seen
from bufgym.scenario import suites
from bufgym.scenario.numbered import by_trace, draw
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from bufgym.utils.errors import BufgymError

L = 4
SHORT = dataclasses.replace(split_scenario(Environment())[0], duration_s=4.0)


def rows_at(*capacities: int, n: int = 6, candidates: int = 2, ruled: bool = False, seed: int = 0) -> TaughtRows:
    """``n`` rows at each L, a family for each."""
    parts = [Part(f"L = {c}", Cell("", SHORT, c), n) for c in capacities]
    return TaughtRows(parts, candidates, ruled, np.random.default_rng(seed))


def wild_student(seed: int, candidates: int = 2) -> Student:
    """A student whose outputs are no longer those of the rule."""
    torch.manual_seed(seed)
    student = Student(candidates, 16)
    for layer in (student[0], student[-1]):
        torch.nn.init.normal_(layer.weight)
    torch.nn.init.zeros_(student[-1].bias)
    return student


def test_expected_cost_and_entropy_by_hand() -> None:
    """Two offered actions, e^0 : e^log(3), costs 1 and 0.2; one that is not offered counts nothing."""
    outputs = torch.tensor([[0.0, math.log(3.0), 50.0]])
    costs, entropy = expected(outputs, torch.tensor([[1.0, 0.2, math.inf]]))
    assert costs.tolist() == pytest.approx([0.25 * 1.0 + 0.75 * 0.2])
    assert entropy.tolist() == pytest.approx([-0.25 * math.log(0.25) - 0.75 * math.log(0.75)])


@pytest.mark.parametrize("candidates", [2, 3])
def test_an_untrained_student_is_the_rule(candidates: int) -> None:
    """It accepts where there is room and else drops the cheapest, as min-motion-gap does, at every L."""
    student = Student(candidates, 8).weights().policy("student")
    episodes = [draw(SHORT, seed) for seed in range(6)]
    for capacity in (1, L, 9):
        ours, theirs = (run(p, episodes, capacity, SHORT.value) for p in (student, policies.get("min-motion-gap")))
        assert [outcome(ours, i) for i in range(6)] == [outcome(theirs, i) for i in range(6)]


@pytest.mark.parametrize("candidates", [2, 3])
def test_torch_and_the_file_choose_alike(candidates: int, tmp_path: Path) -> None:
    """Episodes of a wild student, played by its outputs in torch and by the compiled policy of its file."""
    student = wild_student(candidates, candidates)
    agent = policies.load(weights.save(tmp_path / MODEL, student.weights(), {"name": "wild"}))
    episodes = [draw(SHORT, seed) for seed in range(4)]
    env = SenderVectorEnv(4, SHORT, L, decide_at="arrival", candidates=candidates, autoreset_mode="Disabled")
    seen, info = env.reset(options={"episodes": episodes})
    over, chosen = np.zeros(4, np.bool_), set()
    while not over.any():  # all have 120 arrivals, and ask at each of them
        outputs = student(torch.from_numpy(np.asarray(seen))).detach().numpy()
        actions = np.where(info["action_mask"] != 0, outputs, -np.inf).argmax(axis=1)
        chosen |= set(actions.tolist())
        seen, _, over, _, info = env.step(actions)
    senders = run(agent, episodes, L, SHORT.value)
    assert over.all() and info["qoi"].tolist() == [outcome(senders, i).qoi for i in range(4)]
    assert len(chosen) > 2


def test_a_lesson_has_the_regrets_of_the_states_that_rows_reach() -> None:
    """They are the clairvoyant's in an environment of the same episodes, which takes the same actions at random."""
    rows = rows_at(L, n=12)
    taught, rng = rows.groups[0], np.random.default_rng(1)
    env = SenderVectorEnv(12, SHORT, L, decide_at="arrival", autoreset_mode="SameStep")
    seen, info = env.reset(seed=0, options={"episodes": list(taught.senders.episodes)})
    regrets, played = clairvoyant(env), []

    def choose(now: Any, offered: Any) -> Any:
        actions = np.where(offered, rng.random(offered.shape), -np.inf).argmax(axis=1)
        played.append(actions)
        return actions

    for _ in range(30):
        asked = regrets.regrets()
        lesson = rows.step(choose)
        np.testing.assert_array_equal(lesson.seen, seen)
        np.testing.assert_allclose(lesson.cost, np.where(np.isnan(asked), np.inf, asked), rtol=1e-6, atol=1e-7)
        assert (np.isfinite(lesson.cost) == (info["action_mask"] != 0)).all() and (lesson.cost.min(axis=1) == 0).all()
        played[-1][:2] = 0  # the rule plays 12 / 6 rows, or the next states would not be the same
        seen, *_, info = env.step(played[-1])
    assert len(set(np.concatenate(played).tolist())) > 2


def test_rows_of_several_l_are_spread_and_begin_anew() -> None:
    """120 arrivals an episode: after 300 steps each row has ended at least once, and rows are at different moments."""
    rows = rows_at(3, 9, n=8, candidates=3)
    assert rows.families == ["L = 3", "L = 9"] and rows.family.tolist() == [0] * 8 + [1] * 8
    assert rows.seen.shape == (16, inputs(3))
    rows.scatter(np.random.default_rng(1))
    moments = [int(next) for group in rows.groups for next in group.senders.batch.senders["next"]]
    assert len(set(moments)) > 6
    begun = [group.senders.begun.copy() for group in rows.groups]
    for _ in range(300):
        rows.step(lambda seen, offered: np.zeros(16, np.int64))
    for group, before in zip(rows.groups, begun, strict=True):
        assert (group.senders.begun > before).all()


def lesson(n: int, mark: float, *cost: float) -> Lesson:
    """``n`` states that all show ``mark``, with the same costs."""
    return Lesson(np.full((n, inputs(2)), mark, np.float32), np.tile(np.array(cost, np.float32), (n, 1)))


def test_lessons_count_costs_in_units_of_action_0_by_family() -> None:
    """Action 0 costs (2 + 4) / 2 = 3 in the first family and 0.5 in the second; 200 / 3 is more than 60."""
    rng, lessons = np.random.default_rng(0), Lessons(2, 10, (inputs(2), 4))
    inf = math.inf
    lessons.add(lesson(4, 1.0, 2.0, 0.0, 200.0, inf), np.array([0, 0, 0, 0]), rng)
    lessons.add(lesson(4, 2.0, 4.0, inf, 0.0, 6.0), np.array([0, 0, 0, 0]), rng)
    lessons.add(lesson(3, 3.0, 0.5, 0.0, 0.25, inf), np.array([1, 1, 1]), rng)
    lessons.add(lesson(2, 9.0, 0.0, inf, inf, inf), np.array([0, 1]), rng)  # no choice, no lesson
    assert lessons.counts.tolist() == [8, 3] and lessons.units.tolist() == pytest.approx([3.0, 0.5])
    seen, cost = lessons.draw(np.array([100, 50]), rng)
    found = {(float(s[0]), *(round(float(x), 4) for x in c)) for s, c in zip(seen, cost, strict=True)}
    assert found == {(1, 0.6667, 0, 60, inf), (2, 1.3333, inf, 0, 2), (3, 1, 0, 0.5, inf)}
    assert (seen[:100, 0] < 3).all() and (seen[100:, 0] == 3).all()


def test_lessons_keep_all_until_their_room_is_full() -> None:
    rng, lessons = np.random.default_rng(0), Lessons(1, 10, (inputs(2), 4))
    for mark in (1.0, 2.0):
        lessons.add(lesson(4, mark, 1.0, 0.0, 0.0, 0.0), np.zeros(4, np.int64), rng)
    assert set(lessons.draw(np.array([200]), rng)[0][:, 0].tolist()) == {1.0, 2.0}
    for _ in range(30):
        lessons.add(lesson(4, 3.0, 1.0, 0.0, 0.0, 0.0), np.zeros(4, np.int64), rng)
    assert lessons.counts.tolist() == [10] and (lessons.draw(np.array([200]), rng)[0] == 3).all()


def test_families_that_lose_more_are_drawn_more() -> None:
    """Half of 1,000 states in equal parts, half by 3 : 1."""
    school = School(Hindsight(batch_size=1000).resolved, 2, math.inf)
    school.lost = [0.9, 0.3]
    assert school.sizes().tolist() == [250 + 375, 250 + 125]


def test_gradient_steps_find_the_cheap_actions() -> None:
    """What is best depends on what is seen: after 200 steps almost all weight is there, and the mean follows."""
    rng, lessons = np.random.default_rng(0), Lessons(1, 1000, (inputs(2), 4))
    family = np.zeros(300, np.int64)
    lessons.add(lesson(300, 1.0, 1.0, 0.0, 2.0, 2.0), family, rng)
    lessons.add(lesson(300, -1.0, 1.0, 2.0, 2.0, 0.0), family, rng)
    school = School(Hindsight(width=16, batch_size=256, steps=1000, learning_rate=1e-2).resolved, 1, math.inf)
    seen, offered = np.array([[1.0], [-1.0]], np.float32).repeat(inputs(2), axis=1), np.ones((2, 4), np.bool_)
    assert school.choose(seen, offered).tolist() == [0, 0]
    sizes, losses = school.sizes(), []
    for step in range(600):
        school.steps = step
        losses.append(school.learn(*lessons.draw(sizes, rng), sizes))
    assert losses[0] > 0.9 and losses[-1] < 0.05 and school.lost[0] < 0.1
    assert school.choose(seen, offered).tolist() == [1, 3]
    assert school.choose(seen, ~np.eye(4, dtype=np.bool_)[[1, 3]]).tolist() != [1, 3]
    assert school.optimizer.param_groups[0]["lr"] == pytest.approx(1e-2 * (1 - 599 / 1000))


TINY = Hindsight(
    steps=640, num_envs=16, batch_size=32, width=4, room=2_000, checkpoint_every=320, validate_every=320,
    validation_episodes=2, environment=Environment(capacity=L, duration_s=2.0, episodes=2),
)  # fmt: skip
TASKS = {
    "environment": {},
    "suite": {"environment": Environment(), "suites": Suites(("interruption-v1",), capacities=(3, 5))},
    "families": {"environment": Environment(), "sets": Families(("task", "steady"))},
}


@pytest.mark.parametrize("task", TASKS)
def test_training_keeps_an_agent_and_goes_on(task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kept file is a policy of the benchmark; a resumed run adds to the curve and to the steps."""
    monkeypatch.setattr("agents.hindsight.FIRST", 64)
    monkeypatch.setattr("agents.hindsight_rows.LONGEST", 5)
    settings = dataclasses.replace(TINY, **TASKS[task])
    first = HindsightLearner(settings).train_seed(tmp_path, 1)
    saved = torch.load(first.folder / "hindsight.pt", weights_only=True)
    assert saved["steps"] >= 640 and saved["mean"]["n_averaged"] > 0
    agent = weights.load(first.model)
    assert agent.name == "hindsight"
    for capacity in (3, 6):
        assert outcome(run(agent, [draw(SHORT, 0)], capacity, SHORT.value), 0).delivered > 0
    longer = dataclasses.replace(settings, steps=2_000)
    second = HindsightLearner(longer).train_seed(tmp_path, 1)
    assert second.validation[: len(first.validation)] == first.validation
    assert second.validation[-1][0] > first.validation[-1][0]


def test_the_largest_network_of_families_fits_its_file(tmp_path: Path) -> None:
    """56 x 64 + 64 + 64 x 64 + 64 + 64 x 6 + 6 = 8,198 numbers of 4 bytes and a header, at most 60 kB."""
    settings = Hindsight(sets=Families(("all",))).resolved
    assert (settings.candidates, settings.width, seen(3)) == (3, 64, 69) and settings.ruled
    path = weights.save(tmp_path / MODEL, Student(3, 64, ruled=True).weights(), {"name": "families"})
    assert 4 * 8_198 < path.stat().st_size <= 60_000


def test_a_student_with_the_rule_begins_as_the_rule_on_steady_links_and_where_sizes_differ() -> None:
    """Elsewhere it begins at action 0."""
    student, rule = Student(3, 8, ruled=True).weights().policy("student"), policies.get("gap-price")
    for suite, label in (("sustained-v1", ""), ("jpeg-v1", "jpeg-heavy-time")):
        found = suites.get(suite).settings("test")
        scenario = found[label].scenario if label in found else next(iter(found.values())).scenario
        episodes = [draw(scenario, seed) for seed in range(3)]
        ours, theirs = (run(policy, episodes, 8, scenario.value) for policy in (student, rule))
        assert [outcome(ours, i) for i in range(3)] == [outcome(theirs, i) for i in range(3)]


def test_where_the_rule_teaches_leaving_it_is_what_costs() -> None:
    """The second family stays with the rule; action 1 is the rule's, too."""
    inf, rng = math.inf, np.random.default_rng(0)
    lessons = Lessons(2, 10, (5, 4), Ruled(np.array([False, True]), same=2))
    cost = np.array([[4.0, 0.0, inf, 0.0]], np.float32)
    for family in (0, 1):
        lessons.add(Lesson(np.array([[7.0, family, 0.0, 1.0, 0.0]], np.float32), cost), np.array([family]), rng)
    states, costs = lessons.draw(np.array([50, 10]), rng)
    found = {(*s[:2].tolist(), *c.tolist()) for s, c in zip(states, costs, strict=True)}
    left = hindsight_rows.LEAVING
    assert found == {(7, 0, 1.0, 0, inf, 0), (7, 1, left, 0, inf, 0)}


def test_every_family_has_links_of_its_own_in_each_split() -> None:
    """No trace of a family is in two splits, but the task is validated on its training links.

    Sizes are equal in all families but those that say otherwise, and in short queues, where the rule teaches.
    """
    assert tuple(ready_families.FAMILIES) == FAMILY_NAMES == Families(("all",)).names
    for name, made in ready_families.FAMILIES.items():
        links = {}
        for split in ("train", "validation", "test"):
            cells = made(split)
            unequal = {getattr(cell.scenario, "sizes", "equal") != "equal" for cell in cells}
            assert unequal == ({False, True} if name == "random-short" else {"unequal" in name})
            scenarios = [cell.scenario for cell in cells if getattr(cell.scenario, "traces", ())]
            links[split] = {id_of(trace) for scenario in scenarios for trace in scenario.traces}
        assert not links["train"] & links["test"] and not links["validation"] & links["test"]
        assert name == "task" or not links["train"] & links["validation"]
    assert {cell.capacity for cell in ready_families.FAMILIES["frames"]("test")} >= {3, 8, 48}


def id_of(trace: Any) -> tuple[str, int]:
    return trace.name, int(trace.cumulative_bytes[-1])


def test_runs_of_a_family_are_of_many_links_and_l() -> None:
    """Ten of 24 links at 11 L each; 32 runs on sixteen links at one L are two episodes on each."""
    runs = ready_families.runs_of("frames", "validation", 10)
    assert len(runs) == 10 and len({run["link"] for run in runs}) > 5 and len({run["capacity"] for run in runs}) > 3
    alone = ready_families.runs_of("task", "test", 32)
    assert len({(run["link"], run["best"]) for run in alone}) == 32 and {run["capacity"] for run in alone} == {8}
    assert {run["link"] for run in alone} == {name for name, _ in by_trace(split_scenario(Environment())[1])}


def test_families_are_asked_for_by_name_and_alone() -> None:
    with pytest.raises(BufgymError, match="unknown family 'wifi'"):
        Families(("task", "wifi"))
    for more in ({"suites": Suites(("lte-v1",))}, {"environment": Environment(capacity=5)}):
        with pytest.raises(BufgymError, match="--families: they have links of their own"):
            Hindsight(sets=Families(("task",)), **more)
    assert Families(("lte", "task", "lte")).names == ("lte", "task")


def test_the_report_has_a_line_for_each_family(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Validation and report count shares of AFR's regret; AFR has 1 on every family."""
    monkeypatch.setattr(families, "TEST_RUNS", 4)
    settings = dataclasses.replace(TINY, environment=Environment(), sets=Families(("outage", "task")))
    objective = families.FamiliesObjective(settings, tmp_path, 0)
    assert objective.columns == ("outage", "task", "mean")
    assert objective.validate(policies.get("afr")) == pytest.approx((1.0, 1.0, 1.0))
    assert objective.validate(policies.get("clairvoyant"))[-1] == pytest.approx(0, abs=1e-6)
