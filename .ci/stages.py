"""Run a tier of checks stage by stage: ``stages.py check|test|everything|nightly [arguments of pytest]``.

``everything`` is what the last ``test`` skipped. ``nightly`` goes on after a failure, and keeps each stage's output in
``build/nightly``; the others stop at the first stage that fails. All end with a table of stages, results and seconds,
then the slowest tests; ``test`` and ``everything`` also say what was not tested.
"""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.etree import ElementTree

import missing
from missing import NEEDS

REPO = Path(__file__).resolve().parent.parent
BIN = Path(sys.executable).parent
PYTHON = sys.executable
TSC = BIN.parent / "node_modules" / ".bin" / "tsc"
SKIPS = REPO / "build" / "test" / "skipped.json"
"""Test that the last ``make test`` skipped -> why."""
COVERAGE = ["--cov=bufgym", "--cov-report="]
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
SKIPPED = 77
"""Exit code of a command that cannot run here; the last line of its output says why."""
DATA = Path(os.environ.get("BUFGYM_SHARED_DATA", REPO.parent / "shared" / "data"))
"""Recorded traces and trajectories."""
NO_TESTS = 5
"""Exit code of pytest where no test was chosen."""
MINUTE = 60
NIGHTLY_S = 120.0 * MINUTE
"""The nightly run is over after so long, whatever is left to do."""


@dataclass(frozen=True)
class Stage:
    """A command, and what it needs."""

    name: str
    command: list[str]
    limit_s: float = 5 * MINUTE
    """It is killed after so many seconds."""
    environment: dict[str, str] = field(default_factory=dict)
    unless: str = ""
    """Why it is left out; empty if it runs."""
    report: Path | None = None
    """Where pytest writes the result of each test, as JUnit's XML."""


@dataclass(frozen=True)
class Result:
    """What came of a stage."""

    stage: Stage
    outcome: str
    """passed, FAILED, TOO SLOW or skipped."""
    seconds: float
    remark: str = ""

    @property
    def failed(self) -> bool:
        """Whether the tier fails for it."""
        return self.outcome.isupper()


def pytest(
    name: str,
    folder: Path,
    *arguments: str,
    compiled: bool = True,
    environment: dict[str, str] | None = None,
    limit_s: float = 20 * MINUTE,
) -> Stage:
    """A stage of tests, on two workers of one thread each: more only make them wait for one another."""
    report = folder / f"{name.replace(' ', '-')}.xml"
    command = [PYTHON, "-m", "pytest", "-n", "2", f"--junitxml={report}", "-o", "junit_family=xunit1", *arguments]
    settings = {"OMP_NUM_THREADS": "1", "BUFGYM_KERNELS": "c" if compiled else "python", **(environment or {})}
    return Stage(name, command, limit_s, settings, report=report)


def files_that_run_uncompiled() -> list[str]:
    """Test files with the marker ``kernels``: the others need not be imported."""
    found = sorted((REPO / "tests").rglob("test_*.py"))
    return [str(path.relative_to(REPO)) for path in found if "mark.kernels" in path.read_text(encoding="utf-8")]


def check() -> list[Stage]:
    """Format, lint, types of Python and of the page, layers, sizes of files, stale rows, workflows."""
    actionlint = BIN / "actionlint"
    no_tsc = "" if TSC.exists() else f"TypeScript is not here: {NEEDS['typescript'].command}"
    return [
        Stage("format", [str(BIN / "ruff"), "format", "--check", "."]),
        Stage("lint", [str(BIN / "ruff"), "check", "."]),
        Stage("types", [str(BIN / "mypy")]),
        Stage("page types", [str(TSC), "-p", ".ci/tsconfig.json"], unless=no_tsc),
        Stage("imports", [str(BIN / "lint-imports")]),
        Stage("file sizes", [PYTHON, ".ci/file_sizes.py"]),
        Stage("leaderboard", [PYTHON, ".ci/leaderboard.py", "stale"]),
        Stage("workflows", [str(actionlint)], unless="" if actionlint.exists() else "actionlint is not here"),
    ]


def measured(folder: Path) -> dict[str, str]:
    """Where coverage.py writes, and how it traces: cheaply where Python can."""
    core = {"COVERAGE_CORE": "sysmon"} if sys.version_info >= (3, 12) else {}
    return {"COVERAGE_FILE": str(folder / "lines"), **core}


def uncompiled(folder: Path, arguments: list[str]) -> list[Stage]:
    """Tests of kernels as plain Python, and which of the kernels' lines ran."""
    named = any((REPO / word.partition("::")[0]).exists() for word in arguments)
    chosen = ["-m", "kernels and not nightly", *arguments, *([] if named else files_that_run_uncompiled())]
    lines = [PYTHON, ".ci/kernel_lines.py", str(folder / "lines")]
    part = "pytest was given arguments, so only a part ran" if arguments else ""
    cov = [] if part else COVERAGE
    return [
        pytest("uncompiled", folder, *cov, *chosen, compiled=False, environment=measured(folder)),
        Stage("kernel lines", lines, unless=part),
    ]


def test(arguments: list[str]) -> list[Stage]:
    """What protects a commit."""
    folder = REPO / "build" / "test"
    settings = {"BUFGYM_SKIPPED": str(SKIPS)}
    compiled = pytest("compiled", folder, "-m", "not nightly", *arguments, environment=settings)
    return [*check(), compiled, *uncompiled(folder, arguments)]


def everything(arguments: list[str]) -> list[Stage]:
    """Install what the tests that ``make test`` skipped need, as far as this machine can, and run them."""
    if not SKIPS.exists():
        raise SystemExit("make everything runs what make test has skipped: first run make test")
    folder = REPO / "build" / "everything"
    chosen, left, installed = folder / "chosen.txt", folder / "skipped.json", str(folder / "installed.json")
    settings = {"BUFGYM_SKIPPED": str(left)} | ({"BUFGYM_SHARED_DATA": str(DATA)} if DATA.is_dir() else {})
    skipped = missing.read(SKIPS)
    chosen.write_text("".join(f"{test}\n" for test in skipped), encoding="utf-8")
    none = "" if skipped else "make test skipped nothing"
    no_npm = "" if shutil.which("npm") or TSC.exists() else "npm is not here"
    tool = [PYTHON, ".ci/missing.py"]
    tests = pytest("skipped before", folder, "-m", "not nightly", *arguments, f"@{chosen}", environment=settings)
    return [
        Stage("install", [*tool, "install", str(SKIPS), installed]),
        Stage("page types", [str(TSC), "-p", ".ci/tsconfig.json"], unless=no_npm),
        replace(tests, unless=none),
        Stage("skips", [*tool, "left", str(left), installed], unless=none),
    ]


def nightly(arguments: list[str]) -> list[Stage]:
    """All the rest: what takes too long for a commit, or needs many examples."""
    folder = REPO / "build" / "nightly"
    many = {"HYPOTHESIS_PROFILE": "nightly"}
    cov = {**many, **measured(folder)}
    add = [*COVERAGE, "--cov-append", *arguments]
    servers = ["packages/robot/tests", "packages/relay/tests"]
    # Named, as pytest ignores no folder that pyproject.toml names.
    others = ["tests", "packages/papers/tests", "agents", "studies", "website", "--ignore=tests/fuzz"]
    # Of the nightly tests, those of kernels alone run uncompiled: clusters, trainings and kills gain nothing.
    plain = ["-m", "kernels or not nightly", *others, *arguments]
    report = [PYTHON, "-m", "coverage", "report", "--skip-covered", "--include=bufgym/*"]
    sample = [".ci/mutants", "--sample=150", "--minutes=12", f"--seed={time.strftime('%Y%m%d')}"]
    make = ["make", "--no-print-directory"]
    recordings = "" if DATA.is_dir() else "the recordings are not here, and without them many claims differ"
    return [
        *check(),
        *uncompiled(folder, arguments),
        pytest("compiled", folder, *others, *add, environment=cov, limit_s=40 * MINUTE),
        pytest("servers", folder, *servers, *add, environment=cov, limit_s=20 * MINUTE),
        Stage("coverage", report, environment=measured(folder)),
        Stage("rclcpp", [PYTHON, ".ci/rclcpp.py", "-q", f"--junitxml={folder}/rclcpp.xml"], limit_s=30 * MINUTE),
        pytest("all uncompiled", folder, *plain, compiled=False, limit_s=25 * MINUTE),
        pytest("fuzz", folder, "tests/fuzz", *arguments, environment=many, limit_s=15 * MINUTE),
        Stage("claims", [*make, "claims", f"DATA={DATA}"], limit_s=30 * MINUTE, unless=recordings),
        Stage("pages", [PYTHON, ".ci/leaderboard.py", "pages"]),
        Stage("numbers", [PYTHON, ".ci/leaderboard.py", "sample", "20"], limit_s=30 * MINUTE),
        Stage("speed", [PYTHON, "-m", "studies.perf", "--history", "results/perf.jsonl"], limit_s=5 * MINUTE),
        Stage("mutants", [PYTHON, *sample], limit_s=25 * MINUTE),
        Stage("dist", [*make, "dist"], limit_s=5 * MINUTE),
        Stage("sdist", [PYTHON, ".ci/sdist.py"], limit_s=10 * MINUTE),
        *(Stage(f"install {python}", [".ci/install-matrix", python], limit_s=10 * MINUTE) for python in PYTHONS),
    ]


def carry_out(stage: Stage, log: Path | None) -> Result:
    """Run one stage, its output to ``log`` or to the terminal."""
    if stage.unless:
        return Result(stage, "skipped", 0.0, stage.unless)
    begun = time.monotonic()
    if stage.report:
        stage.report.parent.mkdir(parents=True, exist_ok=True)
        stage.report.unlink(missing_ok=True)
    print(
        f"--- {stage.name}: {shlex.join([*(f'{k}={v}' for k, v in stage.environment.items()), *stage.command])}",
        flush=True,
    )
    with open(log or os.devnull, "wb") as file:
        process = subprocess.Popen(
            stage.command,
            cwd=REPO,
            env={**os.environ, **stage.environment},
            stdin=subprocess.DEVNULL,
            stdout=file if log else None,
            stderr=subprocess.STDOUT if log else None,
            start_new_session=log is not None,
        )
        try:
            code = process.wait(stage.limit_s if log else None)
        except BaseException as error:  # too long, or Ctrl-C: nothing that the stage started goes on
            if log:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if not isinstance(error, subprocess.TimeoutExpired):
                raise
            code = None
    seconds = time.monotonic() - begun
    tests = remark(stage.report) if stage.report and stage.report.exists() else ""
    if code is None:
        return Result(stage, "TOO SLOW", seconds, f"killed after {stage.limit_s:g} s")
    if code == SKIPPED:
        return Result(stage, "skipped", seconds, last_line(log))
    if code == 0 or (stage.report and code == NO_TESTS):
        return Result(stage, "passed", seconds, tests or last_line(log))
    return Result(stage, "FAILED", seconds, tests or last_line(log) or f"exit code {code}")


def last_line(log: Path | None) -> str:
    """The last line of a stage's output that is not blank."""
    lines = log.read_text(encoding="utf-8", errors="replace").split("\n") if log else []
    return next((line.strip() for line in reversed(lines) if line.strip()), "")


def cases(report: Path) -> list[ElementTree.Element]:
    """All tests in a JUnit report."""
    return list(ElementTree.parse(report).getroot().iter("testcase"))


def name_of(case: ElementTree.Element) -> str:
    """Name of a test, as pytest takes it."""
    return f"{case.get('file') or case.get('classname')}::{case.get('name')}"


def remark(report: Path) -> str:
    """How many tests ran, and the first one that failed."""
    found = cases(report)
    bad = [case for case in found if case.find("failure") is not None or case.find("error") is not None]
    skipped = sum(case.find("skipped") is not None for case in found)
    text = f"{len(found) - skipped} tests, {skipped} skipped"
    return f"{text}, {len(bad)} failed: {name_of(bad[0])}" if bad else text


def slowest(results: Sequence[Result], count: int = 10) -> list[tuple[float, str, str]]:
    """Seconds, stage and name of the slowest tests of all stages."""
    timed = [
        (float(case.get("time", 0)), result.stage.name, name_of(case))
        for result in results
        if result.stage.report and result.stage.report.exists() and not result.stage.unless
        for case in cases(result.stage.report)
    ]
    return sorted(timed, reverse=True)[:count]


def table(results: Sequence[Result]) -> str:
    """Stages, results and seconds; then the slowest tests."""
    rows = [f"{r.stage.name:14}{r.outcome:9}{r.seconds:8.1f} s  {r.remark}".rstrip() for r in results]
    rows.append(f"{'in all':14}{'':9}{sum(r.seconds for r in results):8.1f} s")
    if any(r.stage.report for r in results):
        rows += ["", "Slowest tests:", *(f"{s:8.2f} s  {stage:11} {name}" for s, stage, name in slowest(results))]
    return "\n".join(rows)


def main(tier: str, arguments: list[str]) -> int:
    """Run a tier; 1 if a stage failed."""
    folder = REPO / "build" / tier
    folder.mkdir(parents=True, exist_ok=True)
    goes_on = tier == "nightly"
    if goes_on:
        (folder / "lines").unlink(missing_ok=True)
    stages = {"check": lambda _: check(), "test": test, "everything": everything, "nightly": nightly}[tier](arguments)
    results: list[Result] = []
    if tier == "test":
        SKIPS.unlink(missing_ok=True)
    begun = time.monotonic()
    for stage in stages:
        log = folder / f"{stage.name.replace(' ', '-')}.log" if goes_on else None
        left_s = round(max(0.0, NIGHTLY_S - (time.monotonic() - begun)))
        result = carry_out(replace(stage, limit_s=min(stage.limit_s, left_s)), log)
        results.append(result)
        if goes_on:
            print(f"{result.outcome} in {result.seconds:.0f} s {result.remark}", flush=True)
        if result.failed and not goes_on:
            break
    load = f" (load average {os.getloadavg()[0]:.1f})" if hasattr(os, "getloadavg") else ""
    text = f"make {tier}{load}\n{table(results)}"
    (folder / "summary.txt").write_text(text + "\n", encoding="utf-8")
    print(f"\n{text}")
    if tier in ("test", "everything") and (folder / "skipped.json").exists():
        print(missing.message(folder / "skipped.json"))
    return int(any(result.failed for result in results))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2:]))
