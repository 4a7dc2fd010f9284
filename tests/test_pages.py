"""All that README and site tell users to type: each command is one of the parser's, each program runs.

A command runs here with the settings in ``RUN``, or ``PARSED`` says why it is only parsed and what tests it.
"""

from __future__ import annotations

import argparse
import ast
import functools
import glob
import gzip
import importlib.util
import re
import shutil
import textwrap
import zipfile
from pathlib import Path
from typing import Any

import page_cases
import pytest
from page_cases import REPO, Block, blocks, commands, words

from agents.settings import Settings
from bufgym import cli
from bufgym.cli import main
from bufgym.policies import registry

# -------------------- commands: as they stand

RUN = {
    r"bufgym bench --policies learned-motion,afr|bufgym bench --policy-file mine\.py --policies every-other.*": (
        "--seconds 2 --seeds 1"
    ),
    r"bufgym bench (--scenario-file|--workload (frames|nav2)|--policies ppo\.zip).*": "--seeds 1",
    r"bufgym dataset make --kind mixed .*": "--episodes 3 --option duration_s=2.0",
    r"bufgym dataset make --suite lte-v1 .*": "--episodes 2 --out data",
    # In this process: another's, made for a test before, may have been begun in another folder.
    r"bufgym fleet --robots 1 .*": "--seeds 1 --jobs 1",
    r"bufgym topics --config \S+ --trace .*": "--seeds 1",
    r"bufgym topics --config \S+": "--seeds 1 --policies robofleet",
    r"bufgym (--help|list \w+|export runs/motion/.*|gallery|trace fetch --list|trace from-bag drive\.mcap)": "",
    r"bufgym trace generate .*": "-o made.csv",
    r"bufgym trace (convert|info|plot|validate) .*": "",
}
"""Pattern of a whole command -> the settings behind it that make it short."""

PARSED = {
    r"bufgym( (bench|export|leaderboard|report|reproduce|topics|tune|validate|trace( fetch| fit| from-bag)?))?": "",
    r"bufgym (bench --suite|topics --config)": "a name",
    r".*\bNAME\b.*": "a pattern",
    r"bufgym bench --suite .*": "minutes on all cores; tests/benchmark/test_sweep_folder.py runs small ones",
    r"bufgym validate .*": "minutes; tests/benchmark/test_leaderboard.py",
    r"bufgym (fleet|topics) --suite .*": "minutes; tests/benchmark/test_fleet_task.py, test_topics_task.py",
    r"bufgym fleet --robots (4|64) .*": "as with one robot",
    r"bufgym report results/lte": "tests/benchmark/test_report_folder.py",
    r"bufgym gallery .*": "tests/test_gallery.py; the first one by test_readme.py",
    r"bufgym live .*": "sockets; tests/live/test_command.py",
    r"bufgym ros2 .*": "needs ROS 2; tests/live/test_ros2.py",
    r"bufgym relay .*": "a server, and who connects to it; tests/relay",
    r"bufgym export .* --to c .*": "compiles for 40 s; tests/test_c_export.py",
    r"bufgym reproduce (afr-fig9|small-link)": "tests/reproduce/test_reproduce.py",
    r"bufgym reproduce afr-(fig7 afr-fig8|qoi-task|overlap) --data DIR": "minutes to an hour; test_frame_figures.py",
    r"bufgym reproduce robofleet-fig[3-7] --live": "a minute and more; tests/live/test_figures_live.py",
    r"bufgym trace fit .*": "needs recordings; tests/traces/test_fit.py",
    r"bufgym (perf( --peers| --profile| --queue)?|warmup)": "tests/benchmark/test_perf_and_play.py, test_warmup.py",
    r"bufgym (topics --policy-file|play|bench --policies .*seeds) .*": "tests/test_readme.py",
    r"bufgym bench --workload (drive\.mcap .*|FILE\.mcap)": "tests/test_cli_workload.py",
    r"bufgym bench .*(my-agent.zip|every-second|drive\.csv).*": "the tutorial before it makes its files; test_site.py",
    r"python3? (-m bufgym\.ros1|examples/ros[12]/fade\.py).*": "needs ROS; tests/live/test_ros1.py, test_ros2.py",
    r"python train\.py .*": "minutes to hours; tests/test_train.py",
    r"python tests/relay/(engines|load)\.py.*": "measures, for a minute; what it drives: tests/relay",
    r"python -m agents\..*": "needs a run's folder; tests/test_agents.py, test_scheduling.py, test_ablation.py",
    r"python examples/view_missed\.py": "tests/test_training_examples.py",
    r"bufgym trace fetch tum-rgbd-desk": "downloads 0.4 GB; tests/traces/test_fetch.py",
    r"python examples/trackers\.py.*": "needs small_gicp; tests/perception/test_trackers.py",
    r"python -m pytest .*": "a test",
    r"make .*": "a rule of the Makefile",
    r"pip install .*|python3 -m venv .*|pre-commit install|source \.venv/bin/activate": "set-up; .ci/install-matrix",
}
"""Pattern of a whole command -> why it does not run here, and what tests it."""


def entry(table: dict[str, str], line: str) -> str | None:
    """What the first pattern that fits the command leads to."""
    return next((words for pattern, words in table.items() if re.fullmatch(pattern, plain(line))), None)


def plain(line: str) -> str:
    """A command without the folder of its program."""
    return re.sub(r"^\.venv/bin/", "", line)


def command_parsers() -> dict[str, argparse.ArgumentParser]:
    """``"trace fit"`` -> its parser."""
    found: dict[str, argparse.ArgumentParser] = {}

    def add(parser: argparse.ArgumentParser, before: str) -> None:
        found[before.strip()] = parser
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                for name, child in action.choices.items():
                    add(child, f"{before} {name}")

    add(cli._parser(), "")
    return found


def test_the_parser_takes_each_command() -> None:
    found, parser = command_parsers(), cli._parser()
    said = [words(line)[1:] for line in commands() if plain(line).startswith("bufgym")]
    assert len(said) > 350
    for command in said:
        if " ".join(command) not in found and command != ["--help"]:
            parser.parse_args([*command, *(["x"] if command[-1] in ("--suite", "--config") else [])])


def test_python_is_given_what_it_takes() -> None:
    tyro = pytest.importorskip("tyro", reason="the extra train is not installed")
    for line in [line for line in commands() if plain(line).startswith("python")]:
        program, *settings = words(line)[1:]
        if program == "-m" and settings[0].startswith("agents."):
            page = importlib.import_module(settings.pop(0)).main
            # The same settings for a function that does nothing.
            assert not settings or tyro.cli(functools.wraps(page)(lambda *given, **named: "taken"), args=settings)
        elif program == "-m" and settings[0] != "pytest":
            assert importlib.util.find_spec(settings[0]) is not None
        elif program == "train.py" and settings != ["--help"]:
            assert tyro.cli(Settings, args=settings).algo
        else:
            assert (REPO / (settings[-1] if program == "-m" else program)).is_file()


def test_every_rule_of_make_is_in_the_makefile() -> None:
    rules = set(re.findall(r"^([\w-]+):", (REPO / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    told = {words(line)[1] for line in commands() if line.startswith("make ")}
    assert {"train", "test", "docs"} <= told <= rules


def test_each_command_runs_here_or_says_why_not() -> None:
    unknown = [line for line in commands() if entry(RUN, line) is None and entry(PARSED, line) is None]
    assert not unknown, "put them into RUN, or into PARSED with the reason"
    told = [plain(line) for line in commands()]
    assert all(any(re.fullmatch(pattern, line) for line in told) for pattern in [*RUN, *PARSED])


def test_a_block_without_a_language_holds_commands() -> None:
    for block in blocks():
        assert block.language in ("", "python", "text"), (block.page, block.language)
        if not block.language:
            lines = re.sub(r" *\\\n\s*", " ", block.text).splitlines()
            assert all(line.split(" ")[0] in page_cases.PROGRAMS for line in lines), (block.page, block.text)


def test_every_picture_stands_beside_the_command_that_makes_it() -> None:
    """Named in the paragraph behind it, or before the page's first section where one command makes all of them."""
    pictures = 0
    for page, text in page_cases.texts().items():
        for found in re.finditer(r"!\[[^\]]*\]\([^)]+\)", text):
            caption = " ".join(text[found.end() :].strip(") \n").split("\n\n")[:2])
            said = re.findall(r"`([^`]+)`", caption) + re.findall(r"Made by `([^`]+)`", text.partition("\n## ")[0])
            # Those of the tutorials: website/tutorials.py says so of all.
            made = any(" ".join(command.split()) in commands() for command in said)
            assert made or page.startswith("docs/tutorials/"), (page, found[0])
            pictures += 1
    assert pictures > 30


# -------------------- commands: run


@pytest.fixture
def folder(given: Path, tmp_path: Path) -> Path:
    """What the pages' commands read; each has its own."""
    return shutil.copytree(given, tmp_path / "pages")


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What they read, stand-ins for recordings included."""
    there = tmp_path_factory.mktemp("pages")
    for name in ("examples", "traces"):
        shutil.copytree(REPO / name, there / name)
    link, recording = there / "traces" / "lte-synthetic-0.csv", there / "5G-production-dataset.zip"
    for name in ("uplink.csv", "tram.csv", "report_tram_0002.csv"):
        shutil.copy(link, there / name)
    with zipfile.ZipFile(recording, "w") as archive:
        archive.write(link, "B_2019.12.16_11.49.59.csv")
    opportunities = "".join(f"{k}\n" for k in range(1, 20_001))  # 1.5 MB/s for 20 s
    (there / "mahimahi").mkdir()
    for name in ("TMobile-LTE-short.up.gz", "Verizon-EVDO-driving.up.gz", "mahimahi/ATT-LTE-driving.up.gz"):
        with gzip.open(there / name, "wt") as file:
            file.write(opportunities)
    frames = [f"{k / 30:.6f},900000,{k / 100}\n" for k in range(90)]
    (there / "frames.csv").write_text("".join(["time_s,bytes,x\n", *frames]))
    for block in blocks():
        named = re.match(r"# (\w+\.py)\n", block.text) if block.language == "python" else None
        if named and block.page.startswith("docs/guide"):
            (there / named[1]).write_text(block.text)
    (fleet,) = [block.text for block in blocks() if "register_later(" in block.text]
    (there / "fleet_agent.py").write_text(fleet)
    shipped = str(REPO / "agents" / "pretrained" / "learned-motion.safetensors")
    for name, file in {"own": "mine", "motion": "runs/motion/model", "fleet": "runs/fleet/model"}.items():
        (there / file).parent.mkdir(parents=True, exist_ok=True)
        assert main(["export", shipped, str(there / f"{file}.safetensors"), "--name", name]) == 0
    return there


def _recorded(there: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """drive.mcap, and the same as nav2_turtlebot.mcap with transforms."""
    pytest.importorskip("rosbags", reason="recordings need the extra 'ros'")
    monkeypatch.syspath_prepend(str(REPO / "tests" / "traces"))
    bag_cases = importlib.import_module("bag_cases")
    transforms = [(k * 100, "/tf", "std_msgs/msg/String", bag_cases.text("moved")) for k in range(20)]
    bag_cases.write_mcap(there / "drive.mcap", bag_cases.drive())
    bag_cases.write_mcap(there / "nav2_turtlebot.mcap", sorted(bag_cases.drive() + transforms))


def _untrained(there: Path) -> None:
    """ppo.zip"""
    pytest.importorskip("sb3_contrib", reason="the extra train is not installed")
    from sb3_contrib import MaskablePPO

    from bufgym.sb3 import SlotPolicy, make_vec_env

    MaskablePPO(SlotPolicy, make_vec_env("bufgym/Uplink-v0", 2, capacity=8), n_steps=8).save(there / "ppo.zip")


@pytest.mark.slow
@pytest.mark.parametrize("line", [line for line in commands() if entry(RUN, line) is not None])
def test_the_command_runs(
    line: str, given: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))
    monkeypatch.syspath_prepend(str(folder))
    for package, needed in {"minari": "dataset make", "matplotlib": "trace plot", "mcap": "live"}.items():
        if needed in line:
            pytest.importorskip(package)
    if ".mcap" in line:
        _recorded(folder, monkeypatch)
    if "ppo.zip" in line:
        _untrained(folder)
    said = words(line)[1:]
    said = [name for word in said for name in (sorted(glob.glob(word)) if "*" in word else [word])]
    assert {path.name for path in given.iterdir()} <= {path.name for path in Path.cwd().iterdir()}
    try:
        assert main([*said, *words(entry(RUN, line) or "")]) == 0
    except SystemExit as end:  # --help
        assert end.code == 0
    assert capsys.readouterr().out.strip()


# -------------------- programs

BEFORE = {
    "docs/guide/experts.md": """
        import gymnasium as gym
        env = gym.make("bufgym:bufgym/Interruption-v0", capacity=2, t_max=6)
        env.reset(seed=0)""",
    "docs/guide/real-sockets.md": """
        import types
        frame, odometry = b"frame", types.SimpleNamespace(x=0.0)
        connection = types.SimpleNamespace(send_and_wait_for_ack=lambda message: queue.close())""",
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
    "docs/guide/on-a-robot.md": "tests/live/test_ros1.py, test_ros2.py",
    "docs/guide/own-policy.md": "tests/test_readme.py and above, by a command",
    "docs/guide/yours-to-change.md": "tests/test_examples.py",
    "docs/index.md": "tests/test_readme.py",
}
"""Page -> what runs its programs."""

NAMED = [block for block in blocks() if block.language == "python" and block.page not in ELSEWHERE]
PROGRAMS = [
    block for block in NAMED if not re.match(r"# urgent\.py", block.text) and "register_later" not in block.text
]
LONG = {"docs/fleet.md": "settings = "}
"""Page -> where the part of its program begins that takes minutes: only what it imports and names is looked at."""


def test_pages_whose_programs_run_elsewhere_have_some() -> None:
    assert set(ELSEWHERE) == {b.page for b in blocks() if b.language == "python" and b.page in ELSEWHERE}
    assert {*BEFORE, *AFTER} <= {block.page for block in PROGRAMS}


@pytest.mark.slow
@pytest.mark.parametrize("block", PROGRAMS, ids=[f"{block.page}-{k}" for k, block in enumerate(PROGRAMS)])
def test_the_program_runs(block: Block, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("sb3_contrib", "cma", "pettingzoo", "mcap", "cv2"):
        needs = {
            "cma": "agents.objectives",
            "pettingzoo": "parallel_env",
            "mcap": ".mcap",
            "cv2": "bufgym.perception",
        }.get(package, package)
        if needs in block.text:
            pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    said, begins, rest = block.text.partition(LONG.get(block.page, "\0"))
    program = "\n".join([textwrap.dedent(BEFORE.get(block.page, "")), said, AFTER.get(block.page, "")])
    named: dict[str, Any] = {}
    exec(compile(program, block.page, "exec"), named)
    for node in ast.walk(ast.parse(begins + rest if begins else "")):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in named:
            getattr(named[node.value.id], node.attr)
