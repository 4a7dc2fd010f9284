"""The budget cuts a block after its processor time, and the lines of the file."""

import csv
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from needs import needs

pytest.importorskip("stable_baselines3", reason=needs("extras", "stable_baselines3"))
pytest.importorskip("psutil", reason=needs("extras", "psutil"))

from bufgym import BufgymError
from studies import ten_minutes
from studies.ten_minutes import Budget, Trained, best, page


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


def test_the_best_action_is_valid() -> None:
    logits = np.array([[3.0, 2.0, 1.0], [1.0, 2.0, 3.0]], np.float32)
    assert best(ten_minutes.tensor(logits), np.array([[0, 1, 1], [1, 1, 1]])).tolist() == [1, 2]


def test_each_score_is_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = ten_minutes.FLAT | {"mask_in_observation": "tianshou"}
    accepts = Trained(lambda seen: np.where(seen["mask"][:, -1], 9, 0), settings)  # else it evicts the head
    monkeypatch.setitem(ten_minutes.LIBRARIES, "drop oldest", lambda budget: accepts)
    for _ in range(2):
        page("drop oldest", 0.5, tmp_path / "scores.csv", episodes=2)
    lines = list(csv.reader((tmp_path / "scores.csv").read_text().splitlines()))
    assert lines == [["library", "minutes", "score"], *[["drop oldest", "0.5", "0.0000"]] * 2]
    with pytest.raises(BufgymError, match="unknown library 'tianshu'; did you mean 'tianshou'"):
        page("tianshu", 0.5, tmp_path / "scores.csv")
