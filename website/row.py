"""Put one policy's row of a suite's run into the leaderboard: ``python -m website.row FOLDER POLICY --into CSV``.

FOLDER is one of ``bufgym bench --suite --out``. The other rows stay as they are, and the suite's ranks are given anew.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from bufgym.benchmark import leaderboard
from bufgym.benchmark.tasks import task_of
from bufgym.utils.errors import BufgymError


def put(folder: Path, policy: str, path: Path) -> None:
    """Write the row, sorted in by the quantity that its suite is ranked by."""
    made = leaderboard.of_folder(folder)
    found = [entry for entry in made if entry.policy == policy]
    if not found:
        raise BufgymError(f"{folder}: no policy {policy!r}: must be one of {', '.join(e.policy for e in made)}")
    (new,) = found
    board = list(leaderboard.read(path).values())
    suite = [entry for entry in board if entry.suite == new.suite and entry.policy != policy]
    first = task_of(new.suite).listed[0]
    ranked = sorted(
        [entry for entry in suite if entry.rank] + ([new] if new.rank else []), key=lambda e: -e.values[first].value
    )
    ranked = [replace(entry, rank=rank) for rank, entry in enumerate(ranked, 1)]
    others = [entry for entry in suite if not entry.rank] + ([] if new.rank else [new])
    names = list(dict.fromkeys([*(entry.suite for entry in board), new.suite]))
    by_suite = {name: [entry for entry in board if entry.suite == name] for name in names}
    by_suite[new.suite] = [*ranked, *others]
    leaderboard.write([entry for name in names for entry in by_suite[name]], path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("policy")
    parser.add_argument("--into", type=Path, default=Path("results/leaderboard.csv"))
    given = parser.parse_args()
    try:
        put(given.folder, given.policy, given.into)
    except BufgymError as error:
        raise SystemExit(f"error: {error}") from None
