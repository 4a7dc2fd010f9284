"""The budget looks and cuts at whole steps; the file of lines goes on where it was cut; its table."""

import csv
import sys
from collections.abc import Sequence
from importlib import import_module
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from needs import needs

pytest.importorskip("stable_baselines3", reason=needs("extras", "stable_baselines3"))
pytest.importorskip("psutil", reason=needs("extras", "psutil"))

from filelock import FileLock

from bufgym import BufgymError
from studies import budget, libraries, ten_minutes
from studies.budget import Budget
from studies.libraries import Learner, Library, Task, Trained
from studies.ten_minutes import Training, as_table, forget, last_line, read, renew, train, words

HEAD = ",".join(budget.LINE)


class Clock:
    """Processor time that a test moves."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.s = 100.0
        monkeypatch.setattr(budget, "_processor_s", lambda: self.s)
        monkeypatch.setattr(budget.time, "process_time", lambda: self.s)


def test_a_budget_looks_after_each_of_its_minutes_and_its_looks_do_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step takes 25 s and a look 1,000 s: looks after 3 and 5 steps, 75 and 125 s of 60 and 120 s."""
    clock, seen = Clock(monkeypatch), []

    def look(due: float, cpu_s: float) -> None:
        seen.append((due, cpu_s))
        clock.s += 1_000

    watched = Budget([1, 2], look)
    watched.check()  # a library that tries its environment before it trains
    steps = caught = 0
    with watched:
        for _ in count():
            try:
                watched.check()
            except Exception:
                caught += 1
            steps += 1
            clock.s += 25
    assert seen == [(1, 75), (2, 125)] and (steps, caught) == (5, 0)


def test_two_minutes_that_pass_in_one_update_are_one_evaluation(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, seen = Clock(monkeypatch), []
    watched = Budget([1, 2, 5], lambda *line: seen.append(line))
    with watched:
        for _ in range(4):
            watched.check()
            clock.s += 130
    assert seen == [(2, 130), (5, 390)]


def test_a_schedule_that_ends_early_is_scored_at_its_end_and_an_error_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, seen = Clock(monkeypatch), []
    with Budget([1, 10], lambda *line: seen.append(line)):
        clock.s += 570
    assert seen == [(10, 570)]
    with pytest.raises(ZeroDivisionError), Budget([1], lambda *line: seen.append(line)):
        _ = 1 / 0
    assert len(seen) == 1


def heads(task: Task) -> Learner:
    """Drops the head at every full buffer, as Drop Oldest does, until it is cut."""
    env = task.make()

    def learn() -> None:
        for _ in count():
            if env.step(2)[2]:
                env.reset()

    return Learner(learn, lambda: Trained(lambda seen: np.full(len(seen), 2)))


def test_each_score_is_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(libraries.LIBRARIES, "heads", Library("Heads", "numpy", "pytest", heads))
    budget.page("heads", "paired", 3, [0.002, 0.01], tmp_path / "lines.csv", episodes=2)
    made = list(csv.DictReader((tmp_path / "lines.csv").read_text().splitlines()))
    assert [(line["minutes"], line["score"], line["seed"], line["why"]) for line in made] == [
        ("0.002", "0.0000", "3", ""),
        ("0.01", "0.0000", "3", ""),
    ]
    assert 0.1 < float(made[0]["cpu_s"]) < float(made[1]["cpu_s"])
    with pytest.raises(BufgymError, match="unknown library 'tianshu'; did you mean 'tianshou'"):
        budget.page("tianshu", lines=tmp_path / "lines.csv")
    with pytest.raises(BufgymError, match="must be positive and ascend"):
        budget.page("heads", minutes=[2, 1], lines=tmp_path / "lines.csv")


def test_environments_of_a_task_have_seeds_of_their_own_and_hold_actions_where_the_reward_knows_no_future() -> None:
    task, again = Task("paired", 2, 10, lambda: None), Task("regret", 2, 10, lambda: None)
    first, second = (task.make().reset()[0] for _ in range(2))
    assert not np.array_equal(first, second)
    assert np.array_equal(first, again.make().reset()[0])
    assert (task.settings["repeat"], again.settings["repeat"]) == (3, 1)
    assert task.fitting(1_000, 2.0) == 300_000


def test_the_network_of_the_examples_ppo_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its critic is not asked: with a bias of 1 on the second logit and weights of 0, action 1 is the most likely."""
    ppo: Any = import_module("examples.ppo")
    learned: list[Any] = []

    def main(settings: Any) -> dict[str, float]:
        network = ppo.Network(27, 3, 4)
        for part in network.actor.parameters():
            part.data.zero_()
        network.actor[-1].bias.data[1] = 1.0
        learned.append((settings.steps, ppo.make(ppo.TRAIN, 5, settings, "", "SameStep").num_envs))
        return {"cpu_s": 10.0}

    for name, value in (("main", main), ("Network", ppo.Network), ("make", ppo.make)):  # cleanrl replaces two of them
        monkeypatch.setattr(ppo, name, value)
    learner = libraries.cleanrl(Task("regret", 0, 10, lambda: None))
    learner.train()
    assert learner.policy().predict(np.zeros((4, 27)), deterministic=True)[0].tolist() == [1, 1, 1, 1]
    assert learned == [(40_960, 5), (60 * 40_960, 5)]  # ten seconds each, in ten minutes


LINES = f"""\
{HEAD}
sb3-ppo,2.9.2,regret,0,1,60.1,0.4,
sb3-ppo,2.9.2,regret,0,10,600.0,0.7,
sb3-ppo,2.9.2,regret,1,1,60.3,0.5,
sb3-ppo,2.9.2,regret,1,10,600.2,0.72,
tianshou,2.0.1,paired,0,1,60.2,0.61,
rllib,,regret,0,,,,does not install: no wheel
"""


def test_the_table_has_the_mean_over_seeds_and_reasons(tmp_path: Path) -> None:
    (tmp_path / "lines.csv").write_text(LINES)
    made = as_table(tmp_path / "lines.csv", [1, 10], {"chance": -0.1, "afr": 0.35})
    # .70 and .72: the mean's error is .01, and Student's t with one degree of freedom 12.7; a score ends at 1.
    assert made[0] == "| trainer | reward | seeds | 1 min | 10 min |"
    assert made[2].startswith("| stable-baselines3, PPO | regret | 2 | 0.45 | 0.71 [0.5") and "0.8" in made[2][-9:]
    assert made[3:] == [
        "| Tianshou, DQN | paired, held for 3 | 1 | 0.61 |  |",
        "| RLlib, PPO | regret | 0 |  | does not install: no wheel |",
        "| afr | no training |  |  | 0.35 |",
        "| chance | no training |  |  | -0.10 |",
    ]


def test_a_page_gets_the_table_between_its_marks(tmp_path: Path) -> None:
    (page := tmp_path / "page.md").write_text(f"above\n\n{ten_minutes.BEGIN}\nold\n{ten_minutes.END}\n\nbelow\n")
    for _ in range(2):
        renew(page, ["| a |", "|---|"])
    assert page.read_text() == f"above\n\n{ten_minutes.BEGIN}\n\n| a |\n|---|\n\n{ten_minutes.END}\n\nbelow\n"
    page.write_text("above")
    with pytest.raises(BufgymError, match=r"page\.md: has no <!-- begin"):
        renew(page, [])


def test_what_is_complete_stays_and_what_was_cut_or_failed_is_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (lines := tmp_path / "lines.csv").write_text(LINES)
    trained: list[Training] = []

    def train(training: Training, *_: object) -> None:
        assert training not in read(lines)
        trained.append(training)

    monkeypatch.setattr(ten_minutes, "train", train)
    names = ["sb3-ppo", "tianshou", "rllib"]
    ten_minutes.page(names, ["regret", "paired"], [0], [1, 10], lines)
    assert [one[:2] for one in trained] == [
        ("tianshou", "regret"),
        ("rllib", "regret"),
        ("sb3-ppo", "paired"),
        ("tianshou", "paired"),
        ("rllib", "paired"),
    ]
    assert lines.read_text() == "".join(LINES.splitlines(keepends=True)[:5])
    with FileLock(f"{lines}.lock"), pytest.raises(BufgymError, match="another process fills it"):
        ten_minutes.page(names, lines=lines)
    with pytest.raises(BufgymError, match="unknown library 'sb3-pp0'"):
        ten_minutes.page(["sb3-pp0"], lines=lines)


def test_a_training_that_fails_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process's last line; and what pip says where a library does not install."""
    lines, minutes = tmp_path / "lines.csv", [2.0, 1.0]
    training = Training("cleanrl", "regret", 0)
    train(training, minutes, lines, tmp_path, 1)
    [line] = read(lines)[training]
    assert line["why"] == "fails: error: minutes = [2.0, 1.0]: must be positive and ascend" and not line["score"]
    forget(lines, training)
    assert lines.read_text() == f"{HEAD}\n"

    def no_pip(begun: Sequence[str], **_: object) -> Any:
        assert begun[0] == str(tmp_path / "venv-absent" / "bin" / "python") and begun[-1] == "absent>=2"
        return type("Done", (), {"returncode": 1, "stderr": "ERROR: No matching distribution\n[notice] new pip\n"})

    monkeypatch.setitem(libraries.LIBRARIES, "absent", Library("Absent", "absent", "absent", heads))
    monkeypatch.setattr(ten_minutes, "words", lambda package: [f"{package}>=2"])
    monkeypatch.setattr(ten_minutes.venv, "create", lambda folder, **_: folder.mkdir())
    monkeypatch.setattr(ten_minutes.subprocess, "run", no_pip)
    train(absent := Training("absent", "regret", 0), minutes, lines, tmp_path, 1)
    assert read(lines)[absent][0]["why"] == "does not install: ERROR: No matching distribution"
    assert last_line("") == "no message"


def test_each_library_has_a_row_that_says_how_to_install_it(tmp_path: Path) -> None:
    assert words("ray") == ["torch", "ray[rllib]"] and words("tianshou") == ["tianshou>=2"]
    assert all(isinstance(words(library.package), list) for library in libraries.LIBRARIES.values())
    here = Library("Here", "numpy", "numpy", heads)
    assert ten_minutes.python_of(here, tmp_path) == sys.executable
