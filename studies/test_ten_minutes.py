"""The budget cuts a block after its processor time, and the lines of the file."""

import csv
from importlib import import_module
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from needs import needs

pytest.importorskip("stable_baselines3", reason=needs("extras", "stable_baselines3"))
pytest.importorskip("psutil", reason=needs("extras", "psutil"))

from bufgym import BufgymError
from studies import ten_minutes
from studies.ten_minutes import Budget, Trained, page


def test_a_budget_cuts_even_a_block_that_catches_every_exception() -> None:
    cuts = 0
    with Budget(0.01):
        for _ in count():
            try:
                sum(range(1_000))
            except Exception:
                cuts += 1
    assert cuts == 0


def test_a_block_that_ends_by_itself_or_by_an_error_is_left_alone() -> None:
    with Budget(10):
        pass
    with pytest.raises(ZeroDivisionError), Budget(10):
        _ = 1 / 0


def test_each_score_is_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The last action drops the head at a full buffer, as Drop Oldest does: its score is 0."""
    heads = Trained(lambda seen: np.full(len(seen), 2))
    monkeypatch.setitem(ten_minutes.LIBRARIES, "drop oldest", lambda budget, task: heads)
    for _ in range(2):
        page("drop oldest", "retained", 0.5, tmp_path / "scores.csv", episodes=2)
    lines = list(csv.reader((tmp_path / "scores.csv").read_text().splitlines()))
    assert lines == [["library", "reward", "minutes", "score"], *[["drop oldest", "retained", "0.5", "0.0000"]] * 2]
    with pytest.raises(BufgymError, match="unknown library 'tianshu'; did you mean 'tianshou'"):
        page("tianshu", minutes=0.5, out=tmp_path / "scores.csv")


def test_the_network_of_the_examples_ppo_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its critic is not asked: with a bias of 1 on the second logit and weights of 0, action 1 is the most likely."""
    ppo: Any = import_module("examples.ppo")
    learned: list[Any] = []

    def main(settings: Any) -> None:
        network = ppo.Network(27, 3, 4)
        for part in network.actor.parameters():
            part.data.zero_()
        network.actor[-1].bias.data[1] = 1.0
        learned.append(settings)

    monkeypatch.setattr(ppo, "main", main)
    monkeypatch.setattr(ppo, "Network", ppo.Network)  # which cleanrl replaces
    trained = ten_minutes.cleanrl(Budget(10), ten_minutes.Task("retained"))
    assert trained.predict(np.zeros((4, 27)), deterministic=True)[0].tolist() == [1, 1, 1, 1]
    assert [(settings.reward, settings.steps) for settings in learned] == [("retained", 6_000_000)]
