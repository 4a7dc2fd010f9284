"""The table of curves, from a file of a run that was cut short and one that ended."""

from pathlib import Path

import pytest
from needs import needs

pytest.importorskip("stable_baselines3", reason=needs("extras", "stable_baselines3"))

from studies.sb3_defaults import CAPACITY, Episodes, draw_curves, summary

CURVES = """\
settings,seed,steps,score
default,0,0,-0.5
default,0,100352,0.2
default,0,200704,0.9
default,1,0,-0.5
default,1,51200,0.4
"8 rows",3,114688,0.5
"""


def test_the_score_after_so_many_steps_is_that_of_the_rollout_that_reaches_them(tmp_path: Path) -> None:
    (tmp_path / "curves.csv").write_text(CURVES)
    lines = summary(tmp_path / "curves.csv", 100_000)
    assert lines[2:] == ["| default | 0.30 | 0.20, 0.40 |", "| 8 rows | 0.50 | 0.50 |"]
    draw_curves(tmp_path / "curves.csv", {"afr": 0.3}, tmp_path / "curves.svg")
    assert "<svg" in (tmp_path / "curves.svg").read_text()


def test_drop_oldest_is_0_and_other_rules_are_better() -> None:
    episodes = Episodes(3)
    assert CAPACITY == 8 and episodes.of_rule("drop-oldest") == 0
    assert 0 < episodes.of_rule("afr") < episodes.of_rule("target-gap") < 1
