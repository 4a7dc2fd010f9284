"""Learning from the clairvoyant: the student begins as a rule, its costs are the clairvoyant's, and they fall."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from agents import ready_families
from agents.held_out import split_scenario
from agents.hindsight import HindsightLearner, School
from agents.hindsight_network import Student, expected, ranked
from agents.hindsight_rows import Lesson, Lessons, Part, TaughtRows
from agents.mixed_env import Cell
from agents.objectives import families
from agents.runs import MODEL
from agents.settings import Hindsight
from agents.tasks import FAMILY_NAMES, Environment, Families, Suites
from bufgym import policies
from bufgym.envs import SenderVectorEnv
from bufgym.envs.expert import clairvoyant
from bufgym.envs.expert.player import Player
from bufgym.model import qoi
from bufgym.policies import weights
from bufgym.policies.candidate_network import inputs
from bufgym.policies.ruled_network import fields_seen, seen
from bufgym.scenario import suites
from bufgym.scenario.numbered import by_trace, draw
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from bufgym.utils.errors import BufgymError

L = 4
SHORT = dataclasses.replace(split_scenario(Environment())[0], duration_s=4.0)


def rows_at(*capacities: int, n: int = 6, candidates: int = 2, seed: int = 0) -> TaughtRows:
    """``n`` rows at each L, a family for each."""
    parts = [Part(f"L = {c}", Cell("", SHORT, c), n) for c in capacities]
    return TaughtRows(parts, candidates, np.random.default_rng(seed))


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


def test_pairs_by_hand() -> None:
    """Output 3 times as likely, costs 1 and 0.2: 0.8 log(1 + 1/3); the third is not offered, so is in no pair."""
    outputs = torch.tensor([[0.0, math.log(3.0), 50.0]])
    assert ranked(outputs, torch.tensor([[1.0, 0.2, math.inf]])).tolist() == pytest.approx([0.8 * math.log(4 / 3)])
    three = ranked(torch.zeros(1, 3), torch.tensor([[0.0, 1.0, 5.0]]))
    assert three.tolist() == pytest.approx([(1 + 5 + 4) * math.log(2)])
    assert ranked(outputs, torch.zeros(1, 3)).tolist() == [0]  # names of one decision


def test_pairs_are_least_where_outputs_tell_what_is_saved_from_what_is_lost() -> None:
    """The second action saves 2 in three of four futures and loses 1 in the fourth: log(6) apart."""
    cost = torch.tensor([[2.0, 0.0]] * 3 + [[0.0, 1.0]])
    apart = torch.linspace(-3, 5, 8_001, dtype=torch.float64)
    losses = [float(ranked(torch.tensor([[0.0, x]] * 4), cost).sum()) for x in apart.tolist()]
    assert float(apart[int(np.argmin(losses))]) == pytest.approx(math.log(6), abs=0.01)


def test_an_action_that_was_given_up_is_taken_up_again() -> None:
    """By pairs the gradient at a wrong order is the difference of costs; that of the softmax is gone."""
    cost = torch.tensor([[1.0, 0.0]])
    for loss, gradient in ((lambda out: expected(out, cost)[0], 0.0), (lambda out: ranked(out, cost), -1.0)):
        outputs = torch.tensor([[60.0, 0.0]], requires_grad=True)
        loss(outputs).sum().backward()
        assert outputs.grad is not None and outputs.grad[0].tolist() == pytest.approx([-gradient, gradient], abs=1e-9)


@pytest.mark.parametrize("candidates", [2, 3])
def test_an_untrained_student_takes_action_0_and_on_a_steady_link_the_rules(candidates: int) -> None:
    """Whatever else it sees: accept where there is room, else drop the cheapest; or what gap-price does."""
    student, plain = Student(candidates, 8), fields_seen(candidates).index("rule_plain")
    shown = torch.randn((50, seen(candidates)), generator=torch.Generator().manual_seed(0))
    for is_plain, action in ((0.0, 0), (1.0, candidates + 2)):
        shown[:, plain] = is_plain
        assert student(shown).argmax(dim=1).tolist() == [action] * 50


@pytest.mark.parametrize("candidates", [2, 3])
def test_torch_and_the_file_choose_alike(candidates: int, tmp_path: Path) -> None:
    """A wild student plays by its outputs in torch; the compiled policy of its file would decide the same each time."""
    student = wild_student(candidates, candidates)
    agent = policies.load(weights.save(tmp_path / MODEL, student.weights(), {"name": "wild"}))
    rows = rows_at(L, n=12, candidates=candidates)
    (group,), player, chosen = rows.groups, Player(agent, 12), set[int]()

    def choose(now: Any, offered: Any) -> Any:
        actions = np.where(offered, student(torch.from_numpy(now)).detach().numpy(), -np.inf).argmax(axis=1)
        decided = player.actions(group.senders)
        assert np.take_along_axis(rows.decisions, actions[:, None], axis=1)[:, 0].tolist() == decided.tolist()
        chosen.update(actions.tolist())
        return actions

    for _ in range(300):  # 120 arrivals an episode
        rows.step(choose)
    assert len(chosen) > 2


def test_a_lesson_has_the_regrets_of_the_states_that_rows_reach() -> None:
    """They are the clairvoyant's in an environment of the same episodes, which takes the same actions at random.

    The last action is the rule's: it costs what the action costs that does the same.
    """
    rows = rows_at(L, n=12)
    taught, rng = rows.groups[0], np.random.default_rng(1)
    env = SenderVectorEnv(12, SHORT, L, decide_at="arrival", autoreset_mode="SameStep")
    shown, info = env.reset(seed=0, options={"episodes": list(taught.senders.episodes)})
    regrets, played = clairvoyant(env), []

    def choose(now: Any, offered: Any) -> Any:
        actions = np.where(offered[:, :-1], rng.random(offered[:, :-1].shape), -np.inf).argmax(axis=1)
        played.append(actions)
        return np.where(offered[:, 0], actions, offered.shape[1] - 1)  # the first message is the rule's, which accepts

    for _ in range(30):
        asked = regrets.regrets()
        lesson = rows.step(choose)
        np.testing.assert_array_equal(lesson.seen[:, : inputs(2)], shown)
        is_choice = np.isfinite(lesson.cost[:, 0])
        costs, of_rule = lesson.cost[is_choice, :-1], lesson.cost[is_choice, -1]
        np.testing.assert_allclose(costs, np.where(np.isnan(asked), np.inf, asked)[is_choice], rtol=1e-6, atol=1e-7)
        assert (np.isfinite(costs) == (info["action_mask"][is_choice] != 0)).all()
        assert (lesson.cost.min(axis=1) == 0).all()
        same = lesson.seen[is_choice, -4:] == 1
        assert (costs[same] == of_rule[np.nonzero(same)[0]]).all()
        played[-1][:2] = 0  # the rule plays 12 / 6 rows, or the next states would not be the same
        shown, *_, info = env.step(played[-1])
    assert len(set(np.concatenate(played).tolist())) > 2


def test_rows_of_several_l_are_spread_and_begin_anew() -> None:
    """120 arrivals an episode: after 300 steps each row has ended at least once, and rows are at different moments."""
    rows = rows_at(3, 9, n=8, candidates=3)
    assert rows.families == ["L = 3", "L = 9"] and rows.family.tolist() == [0] * 8 + [1] * 8
    assert rows.seen.shape == (16, seen(3))
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
    return Lesson(np.full((n, seen(2)), mark, np.float32), np.tile(np.array(cost, np.float32), (n, 1)))


def test_lessons_count_costs_in_units_of_action_0_by_family() -> None:
    """Action 0 costs (2 + 4) / 2 = 3 in the first family and 0.5 in the second; 200 / 3 is more than 60."""
    rng, lessons = np.random.default_rng(0), Lessons(2, 10, (seen(2), 4))
    inf = math.inf
    lessons.add(lesson(4, 1.0, 2.0, 0.0, 200.0, inf), np.array([0, 0, 0, 0]), rng)
    lessons.add(lesson(4, 2.0, 4.0, inf, 0.0, 6.0), np.array([0, 0, 0, 0]), rng)
    lessons.add(lesson(3, 3.0, 0.5, 0.0, 0.25, inf), np.array([1, 1, 1]), rng)
    lessons.add(lesson(2, 9.0, 0.0, inf, inf, inf), np.array([0, 1]), rng)  # no choice, no lesson
    assert lessons.counts.tolist() == [8, 3] and lessons.units.tolist() == pytest.approx([3.0, 0.5])
    shown, cost = lessons.draw(np.array([100, 50]), rng)
    found = {(float(s[0]), *(round(float(x), 4) for x in c)) for s, c in zip(shown, cost, strict=True)}
    assert found == {(1, 0.6667, 0, 60, inf), (2, 1.3333, inf, 0, 2), (3, 1, 0, 0.5, inf)}
    assert (shown[:100, 0] < 3).all() and (shown[100:, 0] == 3).all()


def test_lessons_keep_all_until_their_room_is_full() -> None:
    rng, lessons = np.random.default_rng(0), Lessons(1, 10, (seen(2), 4))
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


@pytest.mark.parametrize("sets", [Families(), Families(("task",))])
def test_gradient_steps_find_the_cheap_actions(sets: Families) -> None:
    """What is best depends on what is seen: after 200 steps almost all weight is there, and the mean follows."""
    rng, lessons = np.random.default_rng(0), Lessons(1, 1000, (seen(2), 5))
    family = np.zeros(300, np.int64)
    lessons.add(lesson(300, 1.0, 1.0, 0.0, 2.0, 2.0, 2.0), family, rng)
    lessons.add(lesson(300, -1.0, 1.0, 2.0, 2.0, 0.0, 2.0), family, rng)
    settings = Hindsight(width=16, batch_size=256, steps=1000, learning_rate=1e-2, candidates=2, sets=sets)
    school = School(settings.resolved, 1, math.inf)
    shown, offered = np.array([[1.0], [-1.0]], np.float32).repeat(seen(2), axis=1), np.ones((2, 5), np.bool_)
    assert school.choose(shown, offered).tolist() == [4, 0]  # the first shows a steady link
    sizes, losses = school.sizes(), []
    for step in range(600):
        school.steps = step
        losses.append(school.learn(*lessons.draw(sizes, rng), sizes))
    assert losses[0] > 0.9 and losses[-1] < 0.05 and school.lost[0] < 0.1
    assert school.choose(shown, offered).tolist() == [1, 3]
    assert school.choose(shown, ~np.eye(5, dtype=np.bool_)[[1, 3]]).tolist() != [1, 3]
    assert school.optimizer.param_groups[0]["lr"] == pytest.approx(1e-2 * (1 - 599 / 1000))


TINY = Hindsight(
    steps=640, num_envs=16, batch_size=32, width=4, room=2_000, checkpoint_every=320, validate_every=320,
    validation_episodes=2, environment=Environment(capacity=L, duration_s=2.0, episodes=2),
)  # fmt: skip
TASKS = {
    "environment": {},
    "suite": {"environment": Environment(), "suites": Suites(("generated-v1",), capacities=(3, 5))},
    "families": {"environment": Environment(), "sets": Families(("task", "lte"))},
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


def test_where_the_rule_alone_decides_there_is_nothing_to_learn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("agents.hindsight.WAITED", 10)
    monkeypatch.setattr("agents.hindsight_rows.LONGEST", 5)
    chosen = Suites(("interruption-v1", "generated-v1"), capacities=(3,))
    settings = dataclasses.replace(TINY, environment=Environment(), suites=chosen)
    with pytest.raises(BufgymError, match="interruption-v1: the rule gap-price alone decides there"):
        HindsightLearner(settings).train_seed(tmp_path, 1)


def test_the_largest_network_of_families_fits_its_file(tmp_path: Path) -> None:
    """69 x 64 + 64 + 64 x 64 + 64 + 64 x 6 + 6 = 9,030 numbers of 4 bytes and a header, at most 60 kB."""
    settings = Hindsight(sets=Families(("all",))).resolved
    assert (settings.candidates, settings.width, seen(3)) == (3, 64, 69)
    path = weights.save(tmp_path / MODEL, Student(3, 64).weights(), {"name": "families"})
    assert 4 * 9_030 < path.stat().st_size <= 60_000


def test_what_hindsight_cannot_teach_is_left_to_the_rule() -> None:
    """A wild student does what gap-price does where sizes differ and where V saturates."""
    student, rule = wild_student(0).weights().policy("student"), policies.get("gap-price")
    found = suites.get("jpeg-v1").settings("test").values()
    unequal = next(one.scenario for one in found if one.scenario.sizes != "equal" and one.max_bytes is None)
    saturating = dataclasses.replace(SHORT, value=qoi.saturating(8))
    for scenario, capacity, same in (
        (unequal, 8, True), (saturating, 8, True), (SHORT, 8, False)
    ):  # fmt: skip
        episodes = [draw(scenario, seed) for seed in range(3)]
        ours, theirs = (run(policy, episodes, capacity, scenario.value) for policy in (student, rule))
        assert ([outcome(ours, i) for i in range(3)] == [outcome(theirs, i) for i in range(3)]) == same


def test_every_family_has_links_of_its_own_in_each_split() -> None:
    """No trace of a family is in two splits, but the task is validated on its training links. Sizes are equal."""
    assert tuple(ready_families.FAMILIES) == FAMILY_NAMES == Families(("all",)).named("a folder")
    assert Families(("all",)).named(None) == FAMILY_NAMES[:-1] and ready_families.FAMILIES["uplinks"]("test") == []
    for name, made in ready_families.FAMILIES.items():
        links = {}
        for split in ("train", "validation", "test"):
            cells = made(split)
            assert {getattr(cell.scenario, "sizes", "equal") for cell in cells} <= {"equal"}
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
    assert Families(("lte", "task", "lte")).named(None) == ("lte", "task")


def test_the_report_has_a_line_for_each_family(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Validation and report count shares of AFR's regret; AFR has 1 on every family."""
    monkeypatch.setattr(families, "TEST_RUNS", 4)
    settings = dataclasses.replace(TINY, environment=Environment(), sets=Families(("outage", "task")))
    objective = families.FamiliesObjective(settings, tmp_path, 0)
    assert objective.columns == ("outage", "task", "mean")
    assert objective.validate(policies.get("afr")) == pytest.approx((1.0, 1.0, 1.0))
    assert objective.validate(policies.get("clairvoyant"))[-1] == pytest.approx(0, abs=1e-6)
