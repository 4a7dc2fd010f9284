"""The table of episodes that separate rules from constant actions, on made-up rows and a tiny environment."""

import pytest

from studies import yardstick

H = {
    "always 0": 5.0,
    "always 1": 4.0,
    "chance": 1.0,
    "drop-oldest": 2.0,
    "afr": 6.0,
    "target-gap": 9.0,
    "gap-price": 3.0,
}


def rows(best: float, **other: float) -> list[yardstick.Row]:
    """Rows of eight links on which each policy has so much H, and a little more on each next link."""
    return [
        {"scenario": "s", "trace": f"t{k}", "seed": 0, "capacity": 8, "policy": policy, "qoi": qoi + k / 100}
        | {"clairvoyant": best + k / 100, "certified": True, "regret": 0.0}
        for policy, qoi in {**H, **other}.items()
        for k in range(8)
    ]


def test_a_rule_that_is_far_above_the_better_constant_separates() -> None:
    """Between 2 and 12, always 0 has .3, target-gap .7: they leave 7 and 3 of AFR's 6, 67 % less of it."""
    label, zero, one, chance, afr, best, which, apart, verdict = yardstick.line("made up", rows(12.0))
    assert (label, zero, one, chance, afr, best) == ("made up", "0.300", "0.200", "\u22120.100", "0.400", "0.700")
    assert which == "target-gap" and apart.startswith("-0.67 [") and verdict == "yes"


def test_a_rule_that_is_level_does_not() -> None:
    *_, which, apart, verdict = yardstick.line("made up", rows(12.0, **{"target-gap": 5.0}))
    assert which == "target-gap" and apart == "+0.00 [+0.00, +0.00]" and verdict == "no"


def test_it_prints_a_line_for_each(capsys: pytest.CaptureFixture[str]) -> None:
    yardstick.page(capacities=(5,), episodes=3)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3 and lines[2].startswith("| Uplink-v1, L = 5 | 0.")
