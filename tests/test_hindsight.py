"""Learning from the clairvoyant: the student begins as the rule, its mean regret falls, and no bad student leads."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from agents.held_out import split_scenario
from agents.hindsight import HindsightLearner, Lesson, Lessons, Rows, School, padded
from agents.hindsight_network import CONTEXT, SLOT, Student, mean_regret
from agents.mixed_env import Cell
from agents.settings import Hindsight
from agents.tasks import Environment, Suites
from bufgym import policies
from bufgym.envs import SenderVectorEnv
from bufgym.envs.expert import clairvoyant
from bufgym.envs.expert.player import Player
from bufgym.model.buffer import ACCEPT
from bufgym.policies import learned, weights
from bufgym.policies.rule_fields import RULE_FIELDS, RULE_SLOT_FIELDS
from bufgym.scenario.numbered import draw
from bufgym.sim import run
from bufgym.sim.metrics import outcome

L = 4
SHORT = dataclasses.replace(split_scenario(Environment())[0], duration_s=4.0)
CELL = Cell("", SHORT, L)


def random_student(seed: int, size: float = 0.3) -> Student:
    """A student whose networks are no longer zero."""
    torch.manual_seed(seed)
    student = Student(7)
    for scorer in (student.drop, student.accept):
        torch.nn.init.normal_(scorer.out.weight, 0, size)
    return student


def test_mean_regret_by_hand() -> None:
    """Two valid actions, e^0 : e^log(3), regrets 1 and 0.2; an invalid one counts nothing, whatever its score."""
    scores = torch.tensor([[0.0, math.log(3.0), 50.0]])
    regret = torch.tensor([[1.0, 0.2, math.inf]])
    assert float(mean_regret(scores, regret)) == pytest.approx(0.25 * 1.0 + 0.75 * 0.2)


@pytest.mark.kernels
def test_an_untrained_student_is_the_rule() -> None:
    """Row by row the outcomes of gap-price, with equal sizes and with a spread of them."""
    student = Student(8).weights().policy("student")
    for scenario in (SHORT, dataclasses.replace(SHORT, size_cv=0.5)):
        episodes = [draw(scenario, seed) for seed in range(6)]
        plain, rule = dataclasses.replace(student, compile=False), policies.get("gap-price")
        rows = [run(policy, episodes, L, scenario.value) for policy in (student, plain, rule)]
        ours, in_python, theirs = ([outcome(row, i) for i in range(6)] for row in rows)
        assert ours == in_python == theirs


def test_fields_show_the_rule_and_keep_their_limits() -> None:
    """At every decision of a random student the fields name what gap-price does there."""
    env = SenderVectorEnv(
        16, dataclasses.replace(SHORT, size_cv=0.5), L, decide_at="arrival", info="mask", actions="slots"
    )
    env.reset(seed=1)
    senders, wild = env.rows.senders, random_student(0).weights()
    student, rule = Player(wild.policy("wild"), 16), Player(policies.get("gap-price"), 16)
    low, high = (np.array([getattr(f, end) for f in RULE_FIELDS]) for end in ("low", "high"))
    slot_low, slot_high = (np.array([getattr(f, end) for f in RULE_SLOT_FIELDS]) for end in ("low", "high"))
    differ = 0
    for _ in range(80):
        actions, asked = student.actions(senders), rule.actions(senders)
        context, slots = learned.seen(student.memory, wild, L)
        assert ((low <= context) & (context <= high)).all()
        assert ((slot_low <= slots) & (slots <= slot_high)).all()
        drops = np.where(
            slots[:, -1, SLOT.index("rule_drops")] > 0, L, slots[:, :-1, SLOT.index("rule_drops")].argmax(1)
        )
        shown = np.where(context[:, CONTEXT.index("rule_accepts")] > 0, L + 1, drops)
        np.testing.assert_array_equal(shown, asked)
        assert (np.delete(slots, -1, 1).any(2).sum(1) == senders.batch.senders["occupancy"]).all()
        differ += int((actions != asked).sum())
        env.step(actions)
    assert differ > 0


def test_torch_and_compiled_scores_choose_alike() -> None:
    """The compiled policy of random weights takes torch's best valid action, at every decision that it reaches."""
    student = random_student(2)
    rows = Rows(CELL, 12, student.weights(), (0.0, 0.0), np.random.default_rng(0))
    chosen = []
    for _ in range(60):
        actions, seen = rows._observe(student.weights(), student.weights())
        valid = torch.isfinite(torch.from_numpy(padded(rows.step(student.weights(), student.weights()), L).regret))
        scores = student(torch.from_numpy(seen.slots), torch.from_numpy(seen.context)).detach()
        best = scores.masked_fill(~valid, -math.inf)
        top = best.max(dim=1).values
        assert (best[torch.arange(12), torch.from_numpy(actions)] >= top - 1e-3).all()
        chosen += actions.tolist()
    assert len(set(chosen)) > 3


def test_a_lesson_has_the_regrets_of_the_states_that_rows_reach() -> None:
    """They are the clairvoyant's; the row of the rule is played by the rule, the others by the student."""
    wild = random_student(3).weights()
    rows = Rows(CELL, 8, Student(7).weights(), (0.25, 0.25), np.random.default_rng(4))
    rule = Player(policies.get("gap-price"), 8)
    for _ in range(20):
        regrets = clairvoyant(rows.env).regrets()
        asked = rule.actions(rows.env.rows.senders)
        before = rows.env.rows.senders.batch.senders["occupancy"].copy()
        actions, _ = rows._observe(Student(7).weights(), wild)
        lesson = rows.step(Student(7).weights(), wild)
        np.testing.assert_allclose(np.where(np.isfinite(lesson.regret), lesson.regret, np.nan), regrets, atol=1e-6)
        ruled = rows._ruled
        np.testing.assert_array_equal(actions[ruled], asked[ruled])
        assert ruled.sum() == 2 and (before <= L).all()


def test_lessons_keep_all_until_their_room_is_full() -> None:
    rng = np.random.default_rng(0)
    lessons = Lessons(10, L)

    def lesson(n: int, mark: float) -> Lesson:
        shapes = (n, L + 1, len(SLOT)), (n, len(CONTEXT)), (n, L + 2)
        return Lesson(*(np.full(shape, mark, np.float32) for shape in shapes))

    for mark in (1.0, 2.0):
        lessons.add(lesson(4, mark), rng)
    assert lessons.count == 8 and sorted(set(lessons.draw(200, rng)[1][:, 0].tolist())) == [1.0, 2.0]
    for _ in range(30):
        lessons.add(lesson(4, 3.0), rng)
    slots, context, regret = lessons.draw(200, rng)
    assert lessons.count == 10 and (context == 3).all() and (slots == 3).all() and (regret == 3).all()


def test_padding_leaves_the_newcomer_and_its_actions_last() -> None:
    slots = np.arange(3 * len(SLOT), dtype=np.float32).reshape(1, 3, len(SLOT))
    wide = padded(Lesson(slots, np.zeros((1, len(CONTEXT)), np.float32), np.array([[1, 2, 3, 4]], np.float32)), 4)
    assert wide.regret[0].tolist() == [1, 2, math.inf, math.inf, 3, 4]
    np.testing.assert_array_equal(wide.slots[0, [0, 1, 4]], slots[0])
    assert not wide.slots[0, 2:4].any()


def test_the_best_so_far_leads() -> None:
    """Fitness, the less the better: the rule has 5, then 3, 4 and 3 come."""
    school, led = School(Hindsight(width=4), math.inf), []
    for mark, fitness in enumerate((5.0, 3.0, 4.0, 3.0)):
        torch.nn.init.constant_(school.mean.drop.out.bias, float(mark))
        school.compare(lambda agent, fitness=fitness: fitness)
        led.append((float(school.leader.drop.out.bias.detach()), school.best))
    assert led == [(0, 5), (1, 3), (1, 3), (3, 3)]


def test_gradient_steps_lower_the_regret_of_what_was_seen() -> None:
    """On fixed lessons the loss falls to less than that of the rule."""
    rng = np.random.default_rng(0)
    rows, lessons = Rows(CELL, 32, Student(16).weights(), (0.0, 0.0), rng), Lessons(4000, L)
    rows.scatter(40, rng)
    start = Student(16).weights()
    for _ in range(60):
        lessons.add(rows.step(start, start), rng)
    school = School(Hindsight(width=16), math.inf)
    batch = lessons.draw(1000, rng)
    losses = [school.learn(batch) for _ in range(60)]
    assert losses[-1] < 0.8 * losses[0]


TINY = Hindsight(
    steps=640, num_envs=16, batch_size=32, width=4, room=64, checkpoint_every=320, validate_every=320,
    validation_episodes=2, environment=Environment(capacity=L, duration_s=2.0, episodes=2),
)  # fmt: skip


@pytest.mark.parametrize("task", ["environment", "suite"])
def test_training_keeps_an_agent_and_goes_on(task: str, tmp_path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    """The kept file is a policy of the benchmark; a resumed run adds to the curve and to the steps."""
    monkeypatch.setattr("agents.objectives.environment.PARTS", 1)
    monkeypatch.setattr("agents.objectives.environment.EPISODES", 4)
    settings = TINY
    if task == "suite":
        on = Suites(("interruption-v1",), capacities=(3, 5))
        settings = dataclasses.replace(TINY, environment=Environment(), suites=on)
    first = HindsightLearner(settings).train_seed(tmp_path, 1)
    saved = torch.load(first.folder / "hindsight.pt", weights_only=True)
    assert saved["steps"] >= 640 and saved["best"] < math.inf
    agent = weights.load(first.model)
    assert agent.name == "hindsight" and first.model.stat().st_size <= 40_000
    episodes = [draw(SHORT, seed) for seed in range(2)]
    assert outcome(run(agent, episodes, 6, SHORT.value), 0).delivered > 0
    longer = dataclasses.replace(settings, steps=960)
    second = HindsightLearner(longer).train_seed(tmp_path, 1)
    assert second.validation[: len(first.validation)] == first.validation
    assert second.validation[-1][0] > first.validation[-1][0]


def test_accepting_at_an_idle_socket_is_never_unlearned() -> None:
    """A student of any usual size sends when the socket is idle and the queue empty, so that it is never silent."""
    env = SenderVectorEnv(8, SHORT, L, decide_at="arrival", info="mask", actions="slots")
    env.reset(seed=3)
    player = Player(random_student(5, size=0.02).weights().policy("wild"), 8)
    assert (player.actions(env.rows.senders) == L + 1).all() and ACCEPT < 0
