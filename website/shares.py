"""Shares of AFR's regret by the law of the sizes, as a table and a picture.

``python -m website.shares FOLDER docs/figures/jpeg-v1.svg`` reads the folder of ``bufgym bench --suite jpeg-v1 --out``.
It needs matplotlib (extra ``plot``).
"""

from __future__ import annotations

import sys
from pathlib import Path

from bufgym.benchmark.bootstrap import Interval
from bufgym.benchmark.folder import read
from bufgym.benchmark.score import scores
from bufgym.utils.libraries import library

POLICIES = {"target-gap": "tab:gray", "gap-price": "tab:blue", "price-dp": "tab:orange"}
"""Policies beside AFR, and their colours."""


def shares(folder: Path) -> dict[str, dict[str, Interval]]:
    """Law and load -> policy -> share of AFR's regret over the discriminative cells, with its interval."""
    rows = read(folder).rows
    found: dict[str, dict[str, Interval]] = {}
    for label in dict.fromkeys(row["scenario"].removesuffix("-bytes") for row in rows):
        part = [row for row in rows if row["scenario"].removesuffix("-bytes") == label]
        found[label] = {s.policy: s["share"] for s in scores(part).standings if s.policy in POLICIES}
    return found


def draw(path: Path, found: dict[str, dict[str, Interval]]) -> None:
    """Write a picture with a group of bars for each law and load."""
    library("matplotlib", "plot").rcParams["svg.fonttype"] = "none"
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.6), layout="constrained")
    axes = figure.subplots()
    for k, (policy, colour) in enumerate(POLICIES.items()):
        bars = [share[policy] for share in found.values()]
        reach = [[bar.value - bar.low for bar in bars], [bar.high - bar.value for bar in bars]]
        places = [place + 0.27 * (k - 1) for place in range(len(bars))]
        axes.bar(places, [bar.value for bar in bars], 0.25, yerr=reach, color=colour, label=policy, ecolor="0.3")
    axes.set_xticks(
        range(len(found)), [label.replace("-heavy", "\nheavy").replace("-light", "\nlight") for label in found]
    )
    axes.set(ylabel="share of AFR's regret")
    figure.legend(loc="outside upper right", frameon=False, ncols=len(POLICIES))
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


if __name__ == "__main__":
    table = shares(Path(sys.argv[1]))
    for title, entries in table.items():
        print(
            title, *(f"{name} {share.value:.2f} [{share.low:.2f}, {share.high:.2f}]" for name, share in entries.items())
        )
    draw(Path(sys.argv[2]), table)
