"""Run each row of docs/leaderboard.csv that differs from a commit's: ``leaderboard.py COMMIT``; 1 if one does not hold.

A row whose suite needs recordings is named and left out.
"""

import subprocess
import sys
from pathlib import Path

from bufgym.benchmark import leaderboard
from bufgym.scenario.suites import SUITES

FILE = Path("docs/leaderboard.csv")


def main(commit: str) -> int:
    """Validate what is new since ``commit``."""
    before = subprocess.run(["git", "show", f"{commit}:{FILE}"], capture_output=True, text=True, check=True).stdout
    old = Path("build/leaderboard-before.csv")
    old.parent.mkdir(exist_ok=True)
    old.write_text(before, encoding="utf-8")
    known, now, broken = leaderboard.read(old), leaderboard.read(FILE), 0
    for name, entry in now.items():
        if name in known and known[name].values == entry.values:
            continue
        if SUITES[entry.suite].needs:
            print(f"{name}: left out, its suite needs recordings")
            continue
        broken |= subprocess.run([sys.executable, "-m", "bufgym", "validate", name], check=False).returncode
    return int(broken != 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
