"""What README and site tell users to type is there, links lead somewhere, and the site builds from the registries."""

import ast
import importlib.util
import os
import re
import shlex
import subprocess
import sys
import textwrap
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from cli_cases import Patch
from needs import needs

from bufgym import cli, policies
from bufgym.cli import main
from bufgym.scenario.suites import SUITES
from website import cards, commands, markdown, pages, papers, suites
from website import policies as policy_page

REPO = Path(__file__).resolve().parent.parent
WRITTEN = [
    *("README.md", "CONTRIBUTING.md", "SECURITY.md", "agents/pretrained/README.md", "traces/README.md"),
    "packages/papers/PERCEPTION.md",
    *(path.relative_to(REPO).as_posix() for path in sorted((REPO / "docs").rglob("*.md"))),
    *(path.relative_to(REPO).as_posix() for path in sorted((REPO / "results").glob("*.md"))),
]
"""Pages that are files. (The changelog names commands of its day.)"""

TUTORIALS = sorted((REPO / "docs" / "tutorials").glob("*.py"))


class Block(NamedTuple):
    page: str
    language: str
    text: str


@cache
def texts() -> dict[str, str]:
    """Page -> Markdown: files, pages that the site makes of the code, and the text of the tutorials."""
    found = {name: (REPO / name).read_text(encoding="utf-8") for name in WRITTEN}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(policy_page, "picture", lambda policy: "")
        found |= {f"site:{name}": text for name, text in pages.made().items()}
    for path in TUTORIALS:
        lines = path.read_text(encoding="utf-8").splitlines()
        found[f"docs/tutorials/{path.name}"] = "\n".join(line[2:] for line in lines if line.startswith("# "))
    return found


@cache
def blocks() -> tuple[Block, ...]:
    fence = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
    return tuple(Block(page, *found) for page, whole in texts().items() for found in fence.findall(whole))


@cache
def typed() -> list[str]:
    """Every command of bufgym in a block or between backticks, without its comment and its program's folder."""
    found = [
        line.partition("  #")[0].strip()
        for block in blocks()
        if block.language in ("", "bash", "sh")
        for line in re.sub(r" *\\\n\s*", " ", block.text).splitlines()
    ]
    for whole in texts().values():
        prose = re.sub(r"^```.*?^```$", "", whole, flags=re.MULTILINE | re.DOTALL)
        found += [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", prose)]
    plain = dict.fromkeys(re.sub(r"^\.venv/bin/", "", line) for line in found)
    return [line for line in plain if line == "bufgym" or line.startswith("bufgym ")]


def test_the_parser_takes_each_command() -> None:
    app = cli.app()
    commands = [shlex.split(line)[1:] for line in typed()]
    lacking = sorted({name for name in cli.COMMANDS if not any(words[:1] == [name] for words in commands)})
    assert not lacking, f"no page shows how to use the commands {lacking}: docs/guide/ has a page for each task"
    for command in commands:
        if app.parse_commands(command)[2]:
            app.parse_args([*command, *(["x"] if command[-1] in ("--suite", "--config", "--scenario") else [])])


def programs() -> list[tuple[str, str]]:
    """(page or file, program) of every page, tutorial and example in Python."""
    found = [(block.page, block.text) for block in blocks() if block.language == "python"]
    paths = [*TUTORIALS, *sorted((REPO / "examples").rglob("*.py"))]
    return found + [(path.name, path.read_text(encoding="utf-8")) for path in paths]


def test_programs_import_public_names_alone() -> None:
    for page, text in programs():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom):
                private = [name.name for name in node.names if not _is_public(str(node.module), name.name)]
                assert not private, (page, node.module, private)
            elif isinstance(node, ast.Import):
                named = [name.name for name in node.names if name.name.startswith("bufgym")]
                modules = [n for n in named if not importlib.util.find_spec(n).submodule_search_locations]
                assert not modules, f"{page} imports {modules}, which are no subpackages"


def _is_public(module: str, name: str) -> bool:
    """Whether docs/stability.md has the name, or it is one of the modules there. Packages promise nothing yet."""
    if module.split(".")[0] == "agents":
        return hasattr(importlib.import_module(module), name)
    if module.split(".")[0] != "bufgym":
        return True
    return name in public_names().get(module, ()) or f"{module}.{name}" in public_names()


@cache
def public_names() -> dict[str, set[str]]:
    """Module -> its public names, in the table of docs/stability.md."""
    rows = re.findall(r"^\| `(bufgym[\w.]*)` \| (.*) \|$", texts()["docs/stability.md"], re.MULTILINE)
    return {module: set(re.findall(r"`(\w+)`", names)) for module, names in rows}


def test_programs_use_public_names_alone() -> None:
    """``traces.Trace`` after ``from bufgym import traces``, too; a public object's own attributes are its class's."""
    for page, text in programs():
        tree = ast.parse(text)
        known = {
            name.asname or name.name: f"{node.module}.{name.name}"
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
            for name in node.names
        } | {"bufgym": "bufgym"}
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                module = known.get(node.value.id, "")
                assert module not in public_names() or _is_public(module, node.attr), (page, module, node.attr)


@pytest.mark.parametrize("module", ["bufgym", *(m for m in public_names() if m != "bufgym")])
def test_one_list_of_public_names(module: str) -> None:
    """What a module has in ``__all__`` is what docs/api.md explains and docs/stability.md promises."""
    shown = re.findall(r"^::: (\S+)\n    options:\n      members: \[(.*)\]$", texts()["docs/api.md"], re.MULTILINE)
    explained = {name: names.split(", ") for name, names in shown}
    explained["bufgym.oracle"].append("clairvoyant")  # by itself on the page, as its module has the same name
    assert explained.keys() == public_names().keys() and texts()["docs/api.md"].count("\n::: ") == len(explained) + 1
    assert sum(map(len, explained.values())) <= 60
    if module == "bufgym.sb3":
        pytest.importorskip("sb3_contrib", reason=needs("extras", "stable-baselines3"))
    promised = importlib.import_module(module).__all__
    assert sorted(promised) == sorted(explained[module]) == sorted(public_names()[module])
    if "FleetEnv" not in promised or importlib.util.find_spec("pettingzoo"):
        assert all(getattr(importlib.import_module(module), name) is not None for name in promised)


def test_links_and_pictures_lead_somewhere() -> None:
    """To a file of the repository, as it is read without the site; an anchor is a title of some page."""
    titles = [title for text in texts().values() for title in re.findall(r"^#+ (.*)$", text, re.MULTILINE)]
    anchors = {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}
    for page, text in texts().items():
        if page.startswith("site:"):
            continue  # the site's build follows its links
        for target in re.findall(r"\]\(([^)]+)\)", re.sub(r"```.*?```", "", text, flags=re.DOTALL)):
            path, _, anchor = target.partition("#")
            if not target.startswith("http"):
                assert not path or ((REPO / page).parent / path).exists(), (page, target)
                assert not anchor or anchor in anchors or 'id="' in text, (page, target)


def test_what_a_docstring_cites_is_a_title_of_that_page() -> None:
    sources = [path for top in ("bufgym", "packages", "agents", "studies") for path in (REPO / top).rglob("*.py")]
    cited = [
        (path, page, " ".join(title.split()))
        for path in sources
        for page, title in re.findall(r'([\w/]+\.md),\s+"([^"]+)"', path.read_text(encoding="utf-8"))
    ]
    assert len(cited) > 20
    for path, page, title in cited:
        assert f"# {title}\n" in (REPO / page).read_text(encoding="utf-8"), (path, page, title)


RUN = {
    r"bufgym bench --policies learned,afr": "--seconds 2 --seeds 1",
    r"bufgym bench --policy-file mine\.py --policies every-other.*": "--seconds 2 --seeds 1",
    r"bufgym bench --scenario-file .*": "--seeds 1",
    r"bufgym bench --policy-file urgent.py .*": "--trace lte-synthetic-0 --seeds 1",
    r"bufgym dataset make --kind mixed .*": "--episodes 3 --option duration_s=2.0",
    r"bufgym dataset make --suite lte-v1 .*": "--episodes 2 --out data",
    r"bufgym bench --scenario \S+\.toml": "--seeds 1 --policies robofleet",
    r"bufgym (--help|list \w+|trace fetch --list)": "",
    r"bufgym trace generate .*": "-o made.csv",
    r"bufgym play --policies .*": "--speed 1000 --steps 20",
}
"""Pattern of a whole command -> the settings behind it that make it short. Others have tests of their own."""


def settings_of(line: str) -> str | None:
    return next((more for pattern, more in RUN.items() if re.fullmatch(pattern, line)), None)


@pytest.mark.nightly
@pytest.mark.parametrize("line", [line for line in typed() if settings_of(line) is not None])
def test_the_command_runs(line: str, tmp_path: Path, monkeypatch: Patch, capsys: Any) -> None:
    """In a folder with the guide's programs and the repository's examples and traces."""
    for block in blocks():
        named = re.match(r"# (\w+\.py)\n", block.text) if block.language == "python" else None
        if named and block.page.startswith("docs/guide"):
            (tmp_path / named[1]).write_text(block.text)
    for name in ("examples", "traces"):
        (tmp_path / name).symlink_to(REPO / name)
    monkeypatch.chdir(tmp_path)
    if "dataset make" in line:
        pytest.importorskip("minari", reason=needs("extras", "minari"))
    try:
        assert main([*shlex.split(line)[1:], *shlex.split(settings_of(line) or "")]) == 0
    except SystemExit as end:  # --help
        assert end.code == 0
    assert capsys.readouterr().out.strip()


BEFORE = {
    "docs/guide/experts.md": """
        import gymnasium as gym
        env = gym.make("bufgym:bufgym/Interruption-v1", capacity=2, t_max=6)
        env.reset(seed=0)""",
    "docs/guide/real-sockets.md": """
        import types
        frame, odometry = b"frame", types.SimpleNamespace(x=0.0)
        connection = types.SimpleNamespace(sendall=lambda message: queue.close())""",
    "docs/guide/truth.md": """
        from bufgym import scenario
        from bufgym.model.qoi import exponential
        from bufgym.scenario.numbered import draw
        v = exponential(0.618)
        episode = draw(scenario.get("interruption"), 0)""",
}
"""What a page has said before its program begins."""

AFTER = {"docs/guide/truth.md": "assert round(best.value, 5) == 0.98311", "docs/guide/real-sockets.md": "log.close()"}
"""What a page says of its program."""

ELSEWHERE = {
    "docs/guide/ros1.md": "packages/robot/tests/test_ros1.py",
    "docs/guide/ros2.md": "packages/robot/tests/test_ros2.py",
    "docs/guide/own-policy.md": "above, by a command",
    "docs/guide/yours-to-change.md": "below",
}
"""Page -> what runs its programs."""

PROGRAMS = [block for block in blocks() if block.language == "python" and block.page not in ELSEWHERE]


@pytest.mark.nightly
@pytest.mark.parametrize("block", PROGRAMS, ids=[f"{block.page}-{k}" for k, block in enumerate(PROGRAMS)])
def test_the_program_runs(block: Block, tmp_path: Path, monkeypatch: Patch) -> None:
    needed = {
        "sb3_contrib": "sb3_contrib",
        "stable_baselines3": "bufgym.sb3",
        "cma": "agents.tuning",
        "pettingzoo": "FleetEnv",
    }
    for package, sign in (needed | {"mcap": ".mcap", "cv2": "bufgym_papers.perception"}).items():
        if sign in block.text:
            pytest.importorskip(package, reason=needs("extras", package))
    monkeypatch.chdir(tmp_path)
    program = "\n".join([textwrap.dedent(BEFORE.get(block.page, "")), block.text, AFTER.get(block.page, "")])
    exec(compile(program, block.page, "exec"), {"__name__": "page"})


@pytest.mark.nightly
@pytest.mark.parametrize("source", TUTORIALS, ids=lambda source: source.stem)
def test_each_tutorial_runs_and_ends_with_its_picture(source: Path, tmp_path: Path) -> None:
    """A process of its own: tutorials register policies, scenarios and fields."""
    text = source.read_text(encoding="utf-8")
    for package in ("matplotlib", "sb3_contrib", "stable_baselines3", "pettingzoo"):
        if package == "matplotlib" or package in text.lower():
            pytest.importorskip(package, reason=needs("extras", package))
    last = re.findall(r"^# !\[[^\]]+\]\((.+)\)$", text, re.MULTILINE)[-1]
    where = os.environ | {"PYTHONPATH": str(REPO)}
    command = [sys.executable, str(source)]
    done = subprocess.run(command, cwd=tmp_path, env=where, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / last).stat().st_size > 5000
    assert (source.parent / last).exists()


@pytest.mark.nightly
def test_the_table_of_the_readme_is_what_its_command_prints(capsys: pytest.CaptureFixture[str]) -> None:
    block = re.compile(r"```\n(bufgym bench --policies [^\n]*)\n```\n\n```text\n(.*?)```", re.DOTALL)
    command, table = block.findall(texts()["README.md"])[0]
    assert main(command.split()[1:]) == 0
    assert capsys.readouterr().out.strip() == table.strip()


EXAMPLES = [
    path
    for path in sorted((REPO / "examples").glob("*.py"))
    if all(part in path.read_text(encoding="utf-8") for part in ("def main(", '"--steps"', '"--seeds"'))
]
"""Those that take ``--steps`` and ``--seeds``; the others have tests of their own."""


@pytest.mark.nightly
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_the_example_runs(path: Path) -> None:
    command = [sys.executable, str(path), "--steps", "40", "--seeds", "1"]
    where = os.environ | {"PYTHONPATH": str(REPO)}
    done = subprocess.run(command, cwd=path.parent, env=where, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


def test_pages_have_all_of_their_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    page = suites.page()
    assert not [name for name in SUITES if f"| `{name}` |" not in page]
    lines = commands.page()
    headings = re.findall(r"^###? (bufgym .*)$", lines, re.MULTILINE)
    assert not [name for name in cli.COMMANDS if f"bufgym {name}" not in headings]
    assert not [name for name in headings if f"```console\n{name}" not in lines]
    assert {name for name in policies.names() if name.startswith("learned")} == set(cards.CARDS)
    shipped = {suite: numbers for suite, *numbers in cards.board("learned")}
    rows = {suite: f"| {suite} | {' | '.join(numbers)} |" for suite, numbers in shipped.items()}
    assert rows and not [suite for suite, row in rows.items() if row not in cards.page()]
    monkeypatch.setattr(policy_page, "picture", lambda policy: "")
    names = [*policies.names(), *policies.names(named_only=True)]
    assert sorted(re.findall(r"^### (.*)$", policy_page.page(), re.MULTILINE)) == sorted(names)
    listed = set(re.findall(r'<a id="([^"]+)">', papers.page()))
    for name in policies.names():
        assert set(re.findall(r"papers\.md#(\w+)", markdown.cited(policies.get(name).source))) <= listed, name


@pytest.mark.nightly
def test_the_site_builds_without_a_broken_link(tmp_path: Path) -> None:
    for package in ("mkdocs", "material", "mkdocstrings", "jupytext"):
        pytest.importorskip(package, reason=needs("extras", package))
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(tmp_path / "site")]
    surroundings = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=REPO, env=surroundings, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    pages = {path.relative_to(tmp_path / "site").as_posix() for path in (tmp_path / "site").rglob("*.html")}
    assert {"index.html", "interactive.html", "environments/uplink.html", "tutorials/fleet.html"} <= pages
    # Nothing is fetched from elsewhere: every script, style and picture lies on the site.
    for name in sorted(pages):
        text = (tmp_path / "site" / name).read_text(encoding="utf-8")
        fetched = re.findall(r"""<(?:script|img|iframe)[^>]+src=["']?(https?:[^"' >]+)""", text)
        fetched += re.findall(r"""<link[^>]+rel=["']?stylesheet["']?[^>]+href=["']?(https?:[^"' >]+)""", text)
        assert not fetched, name
