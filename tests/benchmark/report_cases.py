"""A run made by hand, for the tests of its report."""

import json
from pathlib import Path
from typing import Any

from bufgym.benchmark.rows import write_rows

BEST = 100.0
QOI = {"clairvoyant": 100.0, "<b>": 95.0, "afr": 90.0, "drop-oldest": 80.0, "random": 60.0}
"""H of each policy in every episode. Scores: 1, 3/4, 1/2, 0, -1; regrets 0, 5, 10, 20, 40 %."""

MANIFEST = {
    "format": 2,
    "task": "queue",
    "bufgym": "0.1.0",
    "suite": "tiny-v1",
    "split": "test",
    "about": "Two outages and a good link.",
    "made": "2026-05-01",
    "command": "bufgym bench --suite tiny-v1 --out <here>",
    "policies": list(QOI),
    "unranked": {"clairvoyant": "it knows the future"},
    "capacities": [2, 4],
    "seeds": 3,
    "changes": {},
    "episodes": "",
    "scenarios": {
        "short": {"about": "Out for 5 s.", "value": "exponential:0.618", "outage_s": 5.0},
        "long": {"about": "Out for 20 s.", "value": "exponential:0.618", "outage_s": 20.0},
        "good": {"about": "Never out.", "value": "exponential:0.618"},
    },
}

TIMELINE = {
    "scenario": "long",
    "capacity": 2,
    "trace": "t",
    "seed": 0,
    "about": "The first.",
    "arrival_s": [0.0, 1.0, 2.0, 3.0, 4.0, 5.0],
    "x": [0.0, 0.5, 1.0, 4.0, 4.5, 5.0],
    "rate": {"t_s": [0.0, 2.0, 4.0], "bytes_per_s": [1e5, 0.0, 1e5]},
    "demand_bytes_per_s": 8e4,
    "policies": {
        "afr": {"qoi": 3.5, "regret": 0.1, "received": [[0, 0.0, 0.5], [2, 2.0, 4.1]], "dropped": [[1, 2.0], [3, 3.0]]},
        "<b>": {"qoi": 1.0, "regret": 0.5, "received": [], "dropped": [[k, 5.0] for k in range(6)]},
    },
}


def make(folder: Path, **changes: Any) -> Path:
    """A run: every policy on 2 traces x 3 seeds of 3 scenarios; on the good link nobody loses more than 0.1 %."""
    rows = []
    for scenario in MANIFEST["scenarios"]:
        for trace in ("t", "u"):
            for seed in range(3):
                for capacity in (2, 4):
                    for policy, qoi in QOI.items():
                        regret = (1 - qoi / BEST) / (400 if scenario == "good" else 1)
                        row = {"scenario": scenario, "trace": trace, "seed": seed, "capacity": capacity}
                        row |= {"policy": policy, "qoi": BEST * (1 - regret), "clairvoyant": BEST, "regret": regret}
                        row |= {"certified": scenario != "long", "mean_sojourn_s": capacity / 10, "mean_age_s": 0.5}
                        rows.append({**row, "peak_backlog_bytes": 100_000 * capacity})
    rows = changes.pop("rows", rows)
    folder.mkdir(exist_ok=True)
    (folder / "manifest.json").write_text(json.dumps({**MANIFEST, **changes}), encoding="utf-8")
    (folder / "timeline.json").write_text(json.dumps(TIMELINE), encoding="utf-8")
    write_rows(rows, folder / "rows.csv")
    return folder
