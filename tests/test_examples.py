"""The examples, run as a user would, with settings small enough for a test."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parent.parent
EXAMPLES = [
    path
    for path in sorted((REPO / "examples").glob("*.py"))
    if all(part in path.read_text(encoding="utf-8") for part in ("def main(", '"--steps"', '"--seeds"'))
]
"""Those that take ``--steps`` and ``--seeds``; the others have tests of their own."""


def test_every_point_of_extension_has_its_example() -> None:
    assert {f"own_{what}" for what in ("scenario", "reward", "field", "value", "link")} <= {p.stem for p in EXAMPLES}


@pytest.mark.nightly
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_the_example_runs(path: Path) -> None:
    """A process of its own: examples register fields, rewards and scenarios."""
    command, where = (
        [sys.executable, str(path), "--steps", "40", "--seeds", "1"],
        os.environ | {"PYTHONPATH": str(REPO)},
    )
    done = subprocess.run(command, cwd=path.parent, env=where, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


def test_the_guide_shows_what_the_examples_do() -> None:
    section = (REPO / "docs" / "guide" / "yours-to-change.md").read_text(encoding="utf-8")
    text = "\n".join(path.read_text(encoding="utf-8") for path in EXAMPLES)
    blocks = [block.split("```")[0] for block in section.split("```python\n")[1:]]
    assert len(blocks) == 5 and all(block in text for block in blocks)
