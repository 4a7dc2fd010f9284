"""Command lines drawn from the parser itself: each ends in 0, or in 2 with one line; the work itself is left out."""

import contextlib
import functools
import importlib
import io
import os
import random
import sys
import tempfile
from pathlib import Path
from typing import Any, NoReturn

from cyclopts import App

REPO = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(REPO))

WORDS = """0 1 2 -1 1e9 1e-9 nan inf 1,2 1,1 none x afr afr,drop-oldest decimate:every=2 decimate:every=0 afr:x=1
lte-v1 topics-v1 fleet-v1 lte-synthetic-0 drive-0 exponential:0.5 exponential:2 saturating:3 nowhere nowhere.csv
/dev/null /dev/zero . out.csv out.png out csv mahimahi validation test uniform client.toml link.csv Uplink-v1 -- -o"""
VALUES = [*WORDS.split(), "", "9" * 30, "1" * 5000, "\x1b[31m", "\n", "\u2013", "\udcff"]

WORK = """bufgym.benchmark.run.run bufgym.benchmark.sweep.run_sweep bufgym.benchmark.leaderboard.make
bufgym.benchmark.leaderboard.validate bufgym_robot.cost.measure bufgym.traces.datasets.fetch.fetch_dataset
bufgym_papers.figures.commands._text bufgym.cli.play.play bufgym_robot.commands.send
bufgym_robot.commands.receive bufgym_robot.commands.link bufgym_robot.ros2.commands.send
bufgym_robot.ros2.commands.receive bufgym_relay.commands.serve bufgym_robot.fleet.commands.robot
bufgym_relay.commands.foxglove bufgym_robot.cost.cost bufgym_robot.validate.validate
bufgym.envs.expert.dataset.make"""
"""What takes long, downloads, or needs a terminal."""


def leave_out_work() -> None:
    from bufgym.utils.errors import BufgymError

    def left_out(*_: object, **__: object) -> NoReturn:
        raise BufgymError("left out")

    for path in WORK.split():
        module_name, name = path.rsplit(".", 1)
        module = importlib.import_module(module_name)
        # A command keeps its options.
        setattr(module, name, functools.wraps(getattr(module, name))(left_out))


def drawn(uniform: random.Random, command: App) -> list[str]:
    """Some of its options and arguments, with values that may be of their kind or not."""
    commands = [name for name in command if not name.startswith("-")]
    if commands:
        name = uniform.choice(commands)
        return [name, *drawn(uniform, command[name])]
    words = ["--help"] if uniform.random() < 0.005 else []
    for argument in command.assemble_argument_collection().filter_by(parse=True):
        if argument.name == "*":
            continue
        positional = argument.field_info.is_positional
        if uniform.random() > (0.95 if positional else 0.15):
            continue
        words += [] if positional else [uniform.choice(argument.names)]
        flag, many = argument.token_count() == (0, False), argument.token_count()[1]
        count = 0 if flag else uniform.choice([0, 1, 2]) if many else 1
        choices = argument.get_choices()
        pool: list[Any] = list(choices) if choices and uniform.random() < 0.8 else VALUES
        words += [str(uniform.choice(pool)) for _ in range(count)]
    return words


def run(k: int, seed: str) -> None:
    from mutations import limited

    from bufgym import cli

    words = drawn(random.Random(f"{seed}-command-{k}"), cli.app())
    out, err = io.StringIO(), io.StringIO()
    try:
        with limited(), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code: Any = cli.main(words)
    except SystemExit as end:
        code = end.code
    except BaseException as error:
        raise AssertionError(f"command {k} of seed {seed}: {words}: {error!r}") from error
    said = err.getvalue()
    assert code in (0, 1, 2), (words, code)
    one = said.count("\n") == 1 or words[:2] == ["trace", "info"]  # which has a sentence for each file
    assert code != 2 or (one and said.replace("\n", "").isprintable()), (words, said)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        os.chdir(scratch)
        Path("client.toml").write_bytes((REPO / "examples" / "client.toml").read_bytes())
        Path("link.csv").write_text("t_ms,bytes,interval_ms\n1000,500000,1000\n")
        leave_out_work()
        for number in range(int(sys.argv[1])):
            run(number, sys.argv[2])
