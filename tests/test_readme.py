"""What README, start page and guide tell users to type is there; policies run and tables come out as printed."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import pytest

from bufgym import cli, policies, reproduce
from bufgym.cli import main

REPO = Path(__file__).resolve().parent.parent
GUIDE = [f"docs/guide/{path.name}" for path in sorted((REPO / "docs" / "guide").glob("*.md"))]
PAGES = ("README.md", "CONTRIBUTING.md", "docs/index.md", "docs/concepts.md", "docs/guide.md", *GUIDE)
README = "\n".join((REPO / name).read_text(encoding="utf-8") for name in PAGES)
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
SITE = re.findall(r"[\w/-]+\.md", (REPO / "mkdocs.yml").read_text(encoding="utf-8"))
SPANS = re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```$", "", README, flags=re.MULTILINE | re.DOTALL))


def told() -> list[list[str]]:
    """The words after ``bufgym`` of every command line."""
    lines = [line for language, block in BLOCKS if not language for line in block.splitlines()]
    return [line.partition("#")[0].split()[1:] for line in (*lines, *SPANS) if line.startswith("bufgym ")]


def test_every_command_exists() -> None:
    (commands,) = (a for a in cli._parser()._actions if isinstance(a, argparse._SubParsersAction))
    found = told()
    assert len(found) > 30 and {"list", "reproduce", "topics"} <= {words[0] for words in found}
    unknown = [words for words in found if words[0] not in commands.choices]
    for command, *words in found:
        if command not in ("list", "reproduce"):
            continue
        known = cli.KINDS if command == "list" else ("all", "NAME", *reproduce.FIGURES)
        names = " ".join(words).partition(" --")[0].split()
        unknown += [[command, name] for name in names if name not in known]
    assert not unknown


def blocks_of(file: str) -> str:
    (block,) = (block for language, block in BLOCKS if language == "python" and block.startswith(f"# {file}\n"))
    return block


@pytest.mark.parametrize(
    ("file", "name", "command"),
    [
        ("mine.py", "every-other", ["bench", "--trace", "lte-synthetic-0", "--seconds", "2"]),
        ("urgent.py", "urgent-first", ["topics", "--trace", "lte-synthetic-0"]),
    ],
)
def test_policies_run_as_printed(
    file: str, name: str, command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine, client = tmp_path / file, tmp_path / "client.toml"
    mine.write_text(blocks_of(file))
    topics = [f'[[topic]]\nname = "{p}"\npriority = {p}\nrate_hz = 20\nsize_bytes = 200000\n' for p in (1, 2, 3)]
    client.write_text("\n".join(["duration_s = 2", *topics]))
    chosen = ["--capacity", "4", "--seeds", "1", "--policy-file", str(mine)]
    chosen += ["--policies", name, *([] if command[0] == "bench" else ["--config", str(client)])]
    try:
        assert main([*command, *chosen]) == 0
        shown = capsys.readouterr().out
        assert f"\n{name} " in shown and "invalid" not in shown
    finally:
        policies.registry._REGISTRY.pop(name, None)


@pytest.mark.slow
def test_a_new_user_can_follow_start_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    text = (REPO / "docs" / "index.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(tmp_path)
    commands = [block.split()[1:] for language, block in blocks if not language and block.startswith("bufgym ")]
    assert [words[0] for words in commands] == ["play", "gallery", "bench"]
    for words in commands:
        assert main([*words, *(["--speed", "0", "--steps", "20"] if words[0] == "play" else [])]) == 0
    assert (tmp_path / "gallery" / "interruption.webp").exists()
    shown = capsys.readouterr().out
    (program,) = (block for language, block in blocks if language == "python")
    exec(compile(program, "index.md", "exec"), {})
    assert "decision 20" in shown and re.fullmatch(r"[\d.]+ \d+\n", capsys.readouterr().out)


@pytest.mark.slow
def test_the_table_is_what_its_command_prints(capsys: pytest.CaptureFixture[str]) -> None:
    text = (REPO / "README.md").read_text(encoding="utf-8")
    command, table = re.findall(r"```\n(bufgym bench --policies [^\n]*)\n```\n\n```text\n(.*?)```", text, re.DOTALL)[0]
    assert main(command.split()[1:]) == 0
    assert capsys.readouterr().out.strip() == table.strip()


def test_the_guides_index_has_every_page_and_keeps_its_old_anchors() -> None:
    index = (REPO / "docs" / "guide.md").read_text(encoding="utf-8")
    assert {f"docs/{page}" for page in re.findall(r"\]\((guide/[\w-]+\.md)", index)} == set(GUIDE)
    assert {page.removeprefix("docs/") for page in GUIDE} <= set(SITE)
    old = ("Recordings", "Benchmark suites", "Training", "Environments", "Experts", "Data sets", "Pictures")
    assert all(f"\n## {title}\n" in index for title in old)


@pytest.mark.parametrize(
    "page", ["README.md", *(f"docs/{path.name}" for path in sorted((REPO / "docs").glob("*.md"))), *GUIDE]
)
def test_links_lead_somewhere(page: str) -> None:
    text = (REPO / page).read_text(encoding="utf-8")
    anchors = {
        re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in re.findall(r"^#+ (.*)$", README, re.M)
    }
    for target in re.findall(r"\]\(([^)]+)\)", re.sub(r"```.*?```", "", text, flags=re.DOTALL)):
        path, _, anchor = target.partition("#")
        if not target.startswith("http"):
            # Pages that the site makes from the code are in its menu; tests/test_site.py builds it.
            there = ((REPO / page).parent / path).resolve()
            assert not path or there.exists() or there in [REPO / "docs" / name for name in SITE], target
            assert not anchor or anchor in anchors, target
