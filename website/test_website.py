"""The programs in ``website`` that measure run as they are documented, each at its shortest."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parent.parent
SHORT = {
    "relay_load load": "--robots 2 --viewers 1 --seconds 1 --slow --flood",
    "relay_load idle": "--connections 20",
    "relay_load page": "--robots 2 --seconds 1",
    "relay_mesh": "--robots 3 --viewers 3 --seconds 3",
    "relay_others": "--robots 2 --viewers 1 --seconds 1",
    "hyperparameters": "--env bufgym/Uplink-v0 --seconds 1 --algorithms evolve",
}
"""Program and verb -> the options that make it short."""
NEEDS = {"relay_load page": "chromium", "relay_mesh": "nats-server", "relay_others": "mosquitto"}
ELSEWHERE = {
    "films": "website/test_gallery.py",
    "round_trips": "tests/robot/test_round_trip.py",
    "row": "needs the folder of a suite's run",
    "shares": "needs the folder of a suite's run",
    "sizes": "needs a recording, and PyAV",
}
"""Programs that another test runs, or none."""


def test_each_documented_program_is_here() -> None:
    pages = [*(REPO / "website").glob("*.py"), *(REPO / "docs").rglob("*.md")]
    written = "\n".join(path.read_text(encoding="utf-8") for path in pages)
    told = set(re.findall(r"python -m website\.(\w+)", written))
    assert told == {words.split()[0] for words in SHORT} | set(ELSEWHERE)
    verbs = set(re.findall(r"python -m website\.(relay_load \w+)", written))
    assert verbs == {words for words in SHORT if words.startswith("relay_load")}


@pytest.mark.nightly
@pytest.mark.parametrize("words", SHORT)
def test_it_runs(words: str) -> None:
    needed = NEEDS.get(words)
    if needed and not shutil.which(needed):
        pytest.skip(f"no {needed} here")
    command = [sys.executable, "-m", *shlex.split(f"website.{words} {SHORT[words]}")]
    done = subprocess.run(command, cwd=REPO, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()
