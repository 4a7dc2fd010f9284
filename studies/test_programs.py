"""The documented programs of ``studies`` and ``website`` run as they are documented, each at its shortest."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from needs import needs

REPO = Path(__file__).resolve().parent.parent
SHORT = {
    "studies.relay_load load": "--robots 2 --viewers 1 --seconds 1 --slow --flood",
    "studies.relay_load idle": "--connections 20",
    "studies.relay_load page": "--robots 2 --seconds 1",
    "studies.relay_others": "--robots 2 --viewers 1 --seconds 1",
    "studies.relay_return": "--clients 2 --kills 1 --away 1",
    "studies.relay_soak": "--robots 3 --viewers 3 --minutes 0.05",
    "studies.hyperparameters": "--env bufgym/Uplink-v1 --seconds 1 --algorithms hindsight",
}
"""Program and verb -> the options that make it short."""
NEEDED = {
    "studies.relay_load page": ("browser", "chromium"),
    "studies.relay_soak": ("nats", "nats-server"),
    "studies.relay_others": ("mqtt", "mosquitto"),
}
ELSEWHERE = {
    "studies.bounds": "studies/test_bounds.py",
    "studies.budget": "studies/test_ten_minutes.py, and it needs the other libraries",
    "studies.coverage": "studies/test_coverage.py",
    "studies.fit": "studies/test_fit_page.py",
    "studies.fit_sizes": "studies/test_fit_sizes.py",
    "studies.learned": "tests/test_families.py",
    "studies.peers": "needs the other packages",
    "studies.plausible": "tests/traces/test_plausible.py",
    "studies.perf": "studies/test_perf.py",
    "studies.round_trips": "packages/robot/tests/test_round_trip.py",
    "studies.sb3_defaults": "studies/test_sb3_defaults.py",
    "studies.shipped": "studies/test_shipped.py",
    "studies.yardstick": "studies/test_yardstick.py",
    "studies.sizes": "needs a recording, and PyAV",
    "studies.ten_minutes": "studies/test_ten_minutes.py, and it trains for hours",
    "website.films": "website/test_gallery.py",
    "website.interfaces": "website/test_interfaces.py",
    "website.played": "website/test_played.py",
    "website.previews": "website/test_previews.py",
    "website.relay_options": "packages/relay/tests/test_options_page.py",
    "website.returns": "it plays 100 episodes in each environment, and takes minutes",
    "website.row": "needs the folder of a suite's run",
    "website.shares": "needs the folder of a suite's run",
}
"""Programs that another test runs, or none."""


def test_each_documented_program_is_here() -> None:
    pages = [*(REPO / "website").glob("*.py"), *(REPO / "studies").glob("*.*"), *(REPO / "docs").rglob("*.md")]
    written = "\n".join(path.read_text(encoding="utf-8") for path in pages)
    documented = set(re.findall(r"python -m ((?:studies|website)\.\w+)", written))
    assert documented == {words.split()[0] for words in SHORT} | set(ELSEWHERE)
    verbs = set(re.findall(r"python -m (studies\.relay_load \w+)", written))
    assert verbs == {words for words in SHORT if words.startswith("studies.relay_load")}


@pytest.mark.nightly
@pytest.mark.parametrize("words", SHORT)
def test_it_runs(words: str) -> None:
    group, program = NEEDED.get(words, ("", ""))
    if group and not shutil.which(program):
        pytest.skip(needs(group, f"no {program}"))
    command = [sys.executable, "-m", *shlex.split(f"{words} {SHORT[words]}")]
    done = subprocess.run(command, cwd=REPO, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()
