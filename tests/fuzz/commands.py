"""Command lines drawn from the parser itself: each ends in 0, or in 2 with one line; the work itself is left out."""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import random
import sys
import tempfile
from pathlib import Path
from typing import Any, NoReturn

REPO = Path(__file__).resolve().parents[2]

VALUES = [
    *(
        "",
        "0",
        "1",
        "2",
        "-1",
        "1e9",
        "1e-9",
        "nan",
        "inf",
        "9" * 30,
        "1" * 5000,
        "1,2",
        "1,1",
        "none",
        "x",
        "\x1b[31m",
    ),
    *(
        "\n",
        "\u2013",
        "afr",
        "afr,drop-oldest",
        "decimate:every=2",
        "decimate:every=0",
        "afr:x=1",
        "lte-v1",
        "topics-v1",
    ),
    *(
        "fleet-v1",
        "lte-synthetic-0",
        "drive-0",
        "exponential:0.5",
        "exponential:2",
        "saturating:3",
        "nowhere",
        "nowhere.csv",
    ),
    *("/dev/null", "/dev/zero", ".", "out.csv", "out.png", "out", "csv", "mahimahi", "validation", "test", "uniform"),
    *("client.toml", "link.csv", "Uplink-v0", "--", "-o", "\udcff"),
]
WORK = (
    ("bufgym.benchmark.run", "run"),
    ("bufgym.benchmark.sweep", "run_sweep"),
    ("bufgym.benchmark.tune", "tune"),
    ("bufgym.benchmark.leaderboard", "make"),
    ("bufgym.benchmark.leaderboard", "validate"),
    ("bufgym.benchmark.perf", "measure"),
    ("bufgym.benchmark.perf_queue", "measure"),
    ("bufgym.traces.datasets.fetch", "fetch_dataset"),
    ("bufgym.cli.figures", "_text"),
    ("bufgym.gallery", "page"),
    ("bufgym.gallery", "write_film"),
    ("bufgym.cli.play", "_play"),
    ("bufgym.cli.live", "run_async"),
    ("bufgym.cli.ros2", "run_async"),
    ("bufgym.cli.relay", "run_async"),
    ("bufgym.cli.relay_robots", "run_async"),
    ("bufgym.live.validate", "validate"),
    ("bufgym.expert.dataset", "make"),
)
"""What takes long, downloads, or needs a terminal."""


def leave_out_work() -> None:
    import importlib
    import inspect

    from bufgym.errors import BufgymError

    def left_out(*given: object, **__: object) -> NoReturn:
        for one in given:
            if inspect.iscoroutine(one):  # else Python warns that nobody awaited it
                one.close()
        raise BufgymError("left out")

    for module, name in WORK:
        room = importlib.import_module(module)
        assert hasattr(room, name), f"{module}.{name}"
        setattr(room, name, left_out)


def drawn(uniform: random.Random, parser: argparse.ArgumentParser) -> list[str]:
    """Some of its options and arguments, with values that may be of their kind or not."""
    words: list[str] = []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            name = uniform.choice(list(action.choices))
            return [*words, name, *drawn(uniform, action.choices[name])]
        positional = not action.option_strings
        if isinstance(action, argparse._HelpAction | argparse._VersionAction):
            if uniform.random() > 0.005:
                continue
        elif uniform.random() > (0.95 if positional else 0.15):
            continue
        words += [] if positional else [uniform.choice(action.option_strings)]
        count = {None: 1, 0: 0, "?": 1, "+": uniform.choice([1, 2]), "*": uniform.choice([0, 1, 2])}[action.nargs]
        pool: list[Any] = list(action.choices) if action.choices and uniform.random() < 0.8 else VALUES
        words += [str(uniform.choice(pool)) for _ in range(count)]
    return words


def run_all(first: int, last: int) -> None:
    import signal

    from inputs import MOST_S, late
    from mutations import SEED

    from bufgym import cli

    signal.signal(signal.SIGALRM, late)
    leave_out_work()
    for k in range(first, last):
        uniform = random.Random(f"{SEED}-command-{k}")
        words = drawn(uniform, cli._parser())
        out, err = io.StringIO(), io.StringIO()
        signal.alarm(MOST_S)
        try:
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                code: Any = cli.main(words)
        except SystemExit as end:
            code = end.code
        except BaseException as error:
            raise AssertionError(f"command {k} of seed {SEED}: {words}: {error!r}") from error
        finally:
            signal.alarm(0)
        said = err.getvalue()
        assert code in (0, 1, 2), (words, code)
        assert code != 2 or (said.count("\n") == 1 and said[:-1].isprintable()), (words, said)


if __name__ == "__main__":
    sys.path[:0] = [str(REPO), str(REPO / "tests" / "fuzz")]
    from inputs import bounded

    with tempfile.TemporaryDirectory() as scratch:
        os.chdir(scratch)
        Path("client.toml").write_bytes((REPO / "examples" / "client.toml").read_bytes())
        Path("link.csv").write_text("t_ms,bytes,interval_ms\n1000,500000,1000\n")
        bounded()
        run_all(int(sys.argv[1]), int(sys.argv[2]))
