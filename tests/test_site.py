"""The site: its pages are made from the registries, it builds without a broken link, its programs run."""

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
from website import cards, commands, environments, markdown, papers, suites, tutorials
from website import policies as policy_page

REPO = Path(__file__).resolve().parent.parent


def test_every_environment_has_a_page_with_its_history() -> None:
    assert set(environments.HISTORY) == {*bufgym.ENVIRONMENTS, *bufgym.ON_TASKS, environments.FLEET}
    for id, history in environments.HISTORY.items():
        assert id.endswith(history[0].name)


@pytest.mark.parametrize("id", bufgym.ENVIRONMENTS)
def test_an_environments_page_names_all_that_it_observes(id: str) -> None:
    page = environments.page(id)
    fields = FIELDS + (TOPIC_FIELDS if "Topics" in id else ())
    assert all(f"| `{field.name}` | {field.per} " in page for field in fields)
    for title in ("Action", "Observation", "Reward", "Episode end", "Arguments", "Versions"):
        assert re.search(rf"^## {title}\n\n\S", page, re.MULTILINE), title
    assert f"gallery/{environments.slug(id)}.webp" in page


def test_parameters_of_a_scenario_have_their_values_and_meanings() -> None:
    page = environments.page("bufgym/Interruption-v0")
    assert "| `t_max` | `400` | Longest T, messages. |" in page
    assert "| `value` | exponential:0.618 | V that QoI is measured with. |" in page


def test_the_page_of_policies_has_all_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy_page, "picture", lambda policy: "")
    page = policy_page.page()
    names = [*policies.names(), *policies.names(named_only=True)]
    assert sorted(re.findall(r"^### (.*)$", page, re.MULTILINE)) == sorted(names)
    assert "papers.md#wang2022afr" in page


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


def test_suites_and_commands_are_all_there() -> None:
    assert all(f"| `{name}` |" in suites.page() for name in SUITES)
    page = commands.page()
    assert "## bench\n" in page
    assert page.count("```text\nusage: bufgym") == page.count("\n## ") + page.count("\n### ")


def test_cards_show_the_numbers_of_the_results() -> None:
    page = cards.page()
    motion = {suite: rest for suite, *rest in cards.scores(cards.CARDS["learned-motion"])}
    assert motion["interruption-v1"] == ["0.51 [0.47, 0.55]", "0.982 [0.980, 0.983]", "0.965 [0.962, 0.967]"]
    shipped = {suite: (regret, score) for suite, regret, score in cards.board("learned-motion")}
    assert shipped["interruption-v1"] == ("0.43", "0.984") and "| interruption-v1 | 0.43 | 0.984 |" in page
    assert set(motion) == {"interruption-v1", "lte-v1", "outage-v1", "sustained-v1", "lte-belgium-v1"}
    assert {name for name in policies.names() if name.startswith("learned-")} == set(cards.CARDS)
    assert "python train.py --suite topics-v1" in page


def test_every_paper_that_a_policy_names_is_in_the_list() -> None:
    listed = set(re.findall(r'<a id="([^"]+)">', papers.page()))
    for name in policies.names():
        linked = re.findall(r"papers\.md#(\w+)", markdown.cited(policies.get(name).source))
        assert set(linked) <= listed, name


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("source", tutorials.sources(), ids=lambda source: source.stem)
def test_each_tutorial_runs_and_ends_with_its_picture(source: Path, tmp_path: Path) -> None:
    text = source.read_text(encoding="utf-8")
    for package in ("matplotlib", "sb3_contrib", "pettingzoo"):
        if package == "matplotlib" or package in text.lower():
            pytest.importorskip(package)
    last = re.findall(r"^# !\[[^\]]+\]\((.+)\)$", text, re.MULTILINE)[-1]
    # A process of its own: tutorials register policies, scenarios and fields.
    surroundings = {**os.environ, "PYTHONPATH": str(REPO)}
    done = subprocess.run(
        [sys.executable, str(source)], cwd=tmp_path, env=surroundings, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / last).stat().st_size > 5000
    assert (source.parent / last).exists()
