"""Check results/leaderboard.csv: ``leaderboard.py stale``, ``sample N`` or ``COMMIT``; 1 if a row does not hold.

``leaderboard.py pages`` does as much for the pages of results, ``stamp PAGE`` says that a page was made anew.

``stale`` runs nothing. It names the rows whose policy has changed since they were made. ``sample`` runs N rows that the
date draws. COMMIT runs each row that differs from that commit's. A row whose suite needs recordings is named and left
out. A page states the fingerprint of the statistics by which its intervals and shares were made, as a row states that
of its policy: ``pages`` names those that were made by other ones.
"""

import random
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path

from bufgym.benchmark import leaderboard
from bufgym.scenario.suites import SUITES

FILE = Path("results/leaderboard.csv")


def name_stale() -> int:
    """Name each stale row and the command that makes it again."""
    board = leaderboard.read(FILE)
    stale = leaderboard.stale(board)
    for name in stale:
        print(f"{name}: its policy has changed since; again: {board[name].command} --out FOLDER, then website.row")
    unknown = sum(entry.made_of == leaderboard.UNKNOWN for entry in board.values())
    print(f"{len(board)} rows, {len(stale)} stale, {unknown} do not say what their policy was made of")
    return int(bool(stale))


def name_stale_pages() -> int:
    """Name each page whose intervals were made by other statistics than today's."""
    pages = {page: page.read_text(encoding="utf-8") for page in sorted(Path("results").glob("*.md"))}
    stale = leaderboard.stale_pages(pages)
    for page in stale:
        print(f"{page}: statistics have changed since; run the page's commands again, then leaderboard.py stamp {page}")
    made = [leaderboard.statistics_of(text) for text in pages.values()]
    stated = sum(one not in (None, leaderboard.UNKNOWN) for one in made)
    unknown = made.count(leaderboard.UNKNOWN)
    print(f"{stated} pages with intervals, {len(stale)} stale; {unknown} more do not say how they were made")
    return int(bool(stale))


def stamp(page: Path) -> int:
    """State today's statistics in a page that was just made."""
    page.write_text(leaderboard.stamped(page.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


def validate(names: Iterable[str]) -> int:
    """Run these rows; 1 if one differs."""
    board, broken = leaderboard.read(FILE), 0
    for name in names:
        if SUITES[board[name].suite].needs:
            print(f"{name}: left out, its suite needs recordings", flush=True)
            continue
        broken |= subprocess.run([sys.executable, "-m", "bufgym", "validate", name], check=False).returncode
    return int(broken != 0)


def sample(count: int) -> int:
    """Validate so many rows; each day draws others."""
    names = sorted(leaderboard.read(FILE))
    return validate(random.Random(time.strftime("%Y%m%d")).sample(names, count))


def main(commit: str) -> int:
    """Validate what is new since ``commit``."""
    before = subprocess.run(["git", "show", f"{commit}:{FILE}"], capture_output=True, text=True, check=True).stdout
    old = Path("build/leaderboard-before.csv")
    old.parent.mkdir(exist_ok=True)
    old.write_text(before, encoding="utf-8")
    known, now = leaderboard.read(old), leaderboard.read(FILE)
    return validate(name for name, entry in now.items() if name not in known or known[name].values != entry.values)


if __name__ == "__main__":
    if sys.argv[1] == "sample":
        sys.exit(sample(int(sys.argv[2])))
    if sys.argv[1] in ("pages", "stamp"):
        sys.exit(name_stale_pages() if sys.argv[1] == "pages" else stamp(Path(sys.argv[2])))
    sys.exit(name_stale() if sys.argv[1] == "stale" else main(sys.argv[1]))
