"""The page of what each part is worth: which variants it trains, and its tables, from runs made up by hand."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import train_cases  # noqa: F401  (it skips without the extra)
from cli_cases import Patch

from agents import ablation
from agents.settings import MOTION, Settings
from bufgym.policies import learned

GIVEN = Settings(suite=ablation.SUITES, algo="evolution", name="parts", hidden=4, warm_up=10)
HEAD = "steps,seconds,score,regret,over_afr,over_rivals\n"


def test_each_variant_lacks_what_its_name_says() -> None:
    made = ablation.variants(GIVEN)
    assert len({variant.name for variant in made.values()}) == len(made)
    assert made["everything"].observed == MOTION and made["one scorer for all links"].warm_up == 0
    for name, left_out in ablation.WITHOUT.items():
        assert {*MOTION} - {*made[name].observed} == {*left_out} <= {*learned.NAMES}
    for hidden, still in ablation.HIDDEN:
        variant = made[f"{hidden} hidden units where the link moves, {still} where it stands still"]
        assert (variant.hidden, variant.still_hidden, variant.warm_up) == (hidden, still, 10)


def run_of(folder: Path, name: str, algo: str, validations: dict[int, str]) -> Path:
    """A run's folder, as train.py leaves it, but for the agents."""
    run = folder / name
    settings = dataclasses.replace(Settings(suite="interruption-v1", name=name), algo=algo, seeds=3)
    for seed, rows in validations.items():
        (run / f"seed-{seed}").mkdir(parents=True)
        (run / f"seed-{seed}" / "validation.csv").write_text(HEAD + rows, encoding="utf-8")
    (run / "settings.json").write_text(json.dumps({"command": settings.command, **dataclasses.asdict(settings)}))
    return run


def test_learning_shows_the_best_so_far_at_each_moment(tmp_path: Path) -> None:
    run = run_of(tmp_path, "mine", "dqn", {4: "0,0.5,0,0,1.5,0\n10,14,0,0,0.8,0\n20,50,0,0,0.9,0\n30,61,0,0,0.7,0\n"})
    _, _, row, *_, text, _ = ablation.learning([run])
    #                                 0 s    15 s   30 s   60 s (61 is near enough), then it had ended
    assert row == "| mine | dqn | 4 | 1.50 | 0.80 | 0.80 | 0.70 |  |  | 0.70 (61 s) |"
    assert text == "python train.py --suite interruption-v1 --algo dqn --seeds 3 --name mine"


def test_the_best_of_n_seeds_is_chosen_by_validation_and_shown_on_the_test(tmp_path: Path, monkeypatch: Patch) -> None:
    """Validation says 0.5, 0.6, 0.7, the test 0.58, 0.55, 0.9: of two, seed 0 is chosen twice and seed 1 once."""
    validations = {s: f"0,0,0,0,0,1.5\n1,1,0,0,0,{over}\n" for s, over in enumerate((0.5, 0.6, 0.7))}
    run = run_of(tmp_path, "mine", "evolution", validations)
    tested = {"seed-0": 0.58, "seed-1": 0.55, "seed-2": 0.9}
    monkeypatch.setattr(ablation, "tested", lambda settings, model: [tested[model.parent.name]])
    rows = ["| best of 1 | 0.600 | 0.677 |", "| best of 2 | 0.533 | 0.570 |", "| best of 3 | 0.500 | 0.580 |"]
    assert ablation.more_seeds(run)[2:] == rows
