"""The table of curves, from a file of a run that was cut short and one that ended; and the scores of rules."""

from pathlib import Path

import pytest
from needs import needs

pytest.importorskip("stable_baselines3", reason=needs("extras", "stable_baselines3"))

from studies.sb3_defaults import RULES, Episodes, Run, draw_curves, forget, read, summary

CURVES = """\
trainer,reward,actions,rows,task,capacity,repeat,seed,steps,score,cpu_s
PPO,regret,candidates,1,lte,8,1,0,0,-0.5,0.0
PPO,regret,candidates,1,lte,8,1,0,100352,0.2,30.0
PPO,regret,candidates,1,lte,8,1,0,200704,0.9,60.0
PPO,regret,candidates,1,lte,8,1,1,0,-0.5,0.0
PPO,regret,candidates,1,lte,8,1,1,51200,0.4,20.0
DQN,retained,slots,8,generated-v1,16,1,3,114688,0.5,9.0
PPO,paired,candidates,8,lte,8,3,0,100352,0.6,40.0
"""


def test_the_score_after_so_many_steps_is_that_of_the_rollout_that_reaches_them(tmp_path: Path) -> None:
    (tmp_path / "curves.csv").write_text(CURVES)
    lines = summary(tmp_path / "curves.csv", 100_000, {"chance": -0.1, "afr": 0.3})
    # .2 and .4: the mean's error is .1, and Student's t with one degree of freedom 12.706; a score ends at 1.
    first, low = lines[2].partition("[")[0], float(lines[2].partition("[")[2].partition(",")[0])
    assert first == "| PPO, regret | 0.30 " and low == pytest.approx(0.3 - 1.27, abs=0.05)
    assert lines[2].endswith(", 1.00] | 0.20, 0.40 | 25 |")
    assert lines[3:] == [
        "| DQN, retained, 8 rows, generated-v1, L = 16, slots | 0.50 [–] | 0.50 | 9 |",
        "| PPO, paired, 8 rows, held for 3 | 0.60 [–] | 0.60 | 40 |",
        "| afr | 0.30 |  |  |",
        "| chance | -0.10 |  |  |",
    ]
    draw_curves(tmp_path / "curves.csv", {"afr": 0.3}, tmp_path / "curves.svg")
    assert "<svg" in (tmp_path / "curves.svg").read_text()


def test_a_seed_is_found_by_all_else(tmp_path: Path) -> None:
    (tmp_path / "curves.csv").write_text(CURVES)
    found = read(tmp_path / "curves.csv")
    assert [*found[Run("PPO", "regret", "candidates", 1, "lte", 8, seed=7)]] == [0, 1]
    assert Run("PPO", "retained", "candidates", 1, "lte", 8) not in found


def test_a_seed_that_was_cut_is_made_anew(tmp_path: Path) -> None:
    (curves := tmp_path / "curves.csv").write_text(CURVES)
    forget(curves, Run("PPO", "regret", "candidates", 1, "lte", 8, seed=1))
    assert [*read(curves)[Run("PPO", "regret", "candidates", 1, "lte", 8)]] == [0]
    assert len(curves.read_text().splitlines()) == 1 + 3 + 2


def test_drop_oldest_is_0_and_other_rules_are_better() -> None:
    episodes = Episodes(3)
    assert episodes.of_rule("drop-oldest") == 0
    assert 0 < episodes.of_rule("afr") < episodes.of_rule("target-gap") < 1
    assert episodes.of_rule(RULES["always 0"]) == episodes.of_rule("min-motion-gap") > episodes.of_rule(RULES["chance"])
