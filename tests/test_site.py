"""The site: its pages are made from the registries, and it builds without a broken link."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import bufgym
from bufgym import policies
from bufgym.observe import FIELDS, TOPIC_FIELDS
from bufgym.scenario.suites import SUITES
from website import cards, commands, environments, markdown, papers, suites
from website import policies as policy_page

REPO = Path(__file__).resolve().parent.parent


def test_every_environment_has_a_page_that_names_all_that_it_observes() -> None:
    assert set(environments.HISTORY) == {*bufgym.ENVIRONMENTS, *bufgym.ON_TASKS, environments.FLEET}
    assert all(id.endswith(history[0].name) for id, history in environments.HISTORY.items())
    for id in bufgym.ENVIRONMENTS:
        page, fields = environments.page(id), FIELDS + (TOPIC_FIELDS if "Topics" in id else ())
        assert all(f"| `{field.name}` | {field.per} " in page for field in fields)
        assert f"gallery/{environments.slug(id)}.webp" in page
    assert "| `t_max` | `400` | " in environments.page("bufgym/Interruption-v0")


def test_pages_have_all_of_their_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    assert all(f"| `{name}` |" in suites.page() for name in SUITES)
    assert commands.page().count("```text\nusage: bufgym") == len(re.findall(r"^###? ", commands.page(), re.MULTILINE))
    assert {name for name in policies.names() if name.startswith("learned-")} == set(cards.CARDS)
    shipped = {suite: numbers for suite, *numbers in cards.board("learned-motion")}
    assert shipped and all(f"| {suite} | {' | '.join(numbers)} |" in cards.page() for suite, numbers in shipped.items())
    monkeypatch.setattr(policy_page, "picture", lambda policy: "")
    names = [*policies.names(), *policies.names(named_only=True)]
    assert sorted(re.findall(r"^### (.*)$", policy_page.page(), re.MULTILINE)) == sorted(names)
    listed = set(re.findall(r'<a id="([^"]+)">', papers.page()))
    for name in policies.names():
        assert set(re.findall(r"papers\.md#(\w+)", markdown.cited(policies.get(name).source))) <= listed, name


def test_a_picture_of_a_policy_shows_what_it_keeps() -> None:
    """Drop Oldest keeps the last eight of sixty, between the messages before and after the interruption."""
    svg = policy_page.picture(policies.get("drop-oldest"))
    assert re.findall(r'rect x="(\d+)"', svg) == [str(10 * k) for k in (0, *range(53, 62))]
    assert "H = 5.06" in svg


def test_columns_of_numbers_stand_to_the_right() -> None:
    rows = [("afr", "0.30 [0.28, 0.33]", "5, 10"), ("min|gap", "0.52", "none")]
    assert markdown.table(("policy", "score", "L"), rows).splitlines()[1:] == [
        "| --- | ---: | --- |",
        "| afr | 0.30 [0.28, 0.33] | 5, 10 |",
        "| min\\|gap | 0.52 | none |",
    ]


@pytest.mark.nightly
def test_the_site_builds_without_a_broken_link(tmp_path: Path) -> None:
    for package in ("mkdocs", "material", "mkdocstrings", "jupytext"):
        pytest.importorskip(package, reason="the extra docs is not installed")
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
