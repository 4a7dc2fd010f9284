"""What README and site tell users to type: every code block, and every command, wherever it stands."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from website import pages
from website import policies as policy_page

REPO = Path(__file__).resolve().parent.parent
WRITTEN = [
    *("README.md", "CONTRIBUTING.md", "SECURITY.md", "agents/pretrained/README.md", "traces/README.md"),
    *(path.relative_to(REPO).as_posix() for path in sorted((REPO / "docs").rglob("*.md"))),
]
"""Pages that are files. (The changelog names commands of its day.)"""

PROGRAMS = ("bufgym", "python", "python3", "make", "pip", "pre-commit", "docker", "source")


@dataclass(frozen=True)
class Block:
    """A fenced block."""

    page: str
    language: str
    text: str


@cache
def texts() -> dict[str, str]:
    """Page -> Markdown: those that are files, those that the site makes of the code, and the words of the tutorials."""
    found = {name: (REPO / name).read_text(encoding="utf-8") for name in WRITTEN}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(policy_page, "picture", lambda policy: "")
        found |= {f"site:{name}": text for name, text in pages.made().items()}
    for path in sorted((REPO / "docs" / "tutorials").glob("*.py")):
        lines = path.read_text(encoding="utf-8").splitlines()
        found[f"docs/tutorials/{path.name}"] = "\n".join(line[2:] for line in lines if line.startswith("# "))
    return found


@cache
def blocks() -> tuple[Block, ...]:
    """Every fenced block of every page."""
    return tuple(
        Block(page, language, text)
        for page, whole in texts().items()
        for language, text in re.findall(r"^```(\w*)\n(.*?)^```$", whole, re.MULTILINE | re.DOTALL)
    )


@cache
def commands() -> dict[str, str]:
    """Every command as it stands, its comment left out -> the first page that has it."""
    found: dict[str, str] = {}
    for block in blocks():
        if block.language in ("", "bash", "sh"):
            for line in re.sub(r" *\\\n\s*", " ", block.text).splitlines():
                found.setdefault(line.partition("  #")[0].strip(), block.page)
    for page, whole in texts().items():
        prose = re.sub(r"^```.*?^```$", "", whole, flags=re.MULTILINE | re.DOTALL)
        for span in re.findall(r"`([^`]+)`", prose):
            found.setdefault(" ".join(span.split()), page)
    return {line: page for line, page in found.items() if line.split(" ")[0].split("/")[-1] in PROGRAMS}


def words(line: str) -> list[str]:
    """A command's words, its program included."""
    return shlex.split(line)
