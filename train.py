"""Train an agent and compare it with the fixed policies: ``python train.py``, or ``--help`` for all settings.

Results are in runs/NAME/. After a kill or Ctrl-C, the same command with ``--resume`` goes on from the last checkpoint.
"""

import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from cyclopts import App

from agents.runs import prepare
from agents.settings import ALGORITHMS, FLAT, PPO, Hindsight, Settings, Tune
from bufgym.cli.options import OPTIONS
from bufgym.utils.errors import BufgymError
from bufgym.utils.files import locked

app = App(
    "train.py",
    help_format="plaintext",
    default_parameter=OPTIONS,
    error_formatter=lambda said: f"error: {said}",
    suppress_keyboard_interrupt=False,
)
BEFORE = {"maskable-ppo": "ppo", "ppo": "ppo", "dqn": "dqn", "cma-es": "tune RULE"}
"""A value that ``--algo`` had -> the command that now does it; for others hindsight does."""


@app.default
def _two_ways(*, settings: Annotated[Hindsight, FLAT] = Hindsight()) -> None:  # noqa: B008
    """Train an agent on a bufgym environment, or on a whole suite, and evaluate it on held-out episodes.

    Without a command: hindsight. In an environment also ppo, for about a minute each, to compare.
    """
    main(settings, others_of(settings) if settings.kind == "environment" else ())


def add_command(algorithm: type[Settings]) -> None:
    """Make a command of an algorithm; its options are the settings."""

    def command(*, settings: Annotated[algorithm, FLAT] = algorithm()) -> None:  # type: ignore[valid-type, call-arg]  # noqa: B008
        main(settings)

    command.__doc__ = algorithm.__doc__
    app.command(command, name=algorithm.algo)


for each in ALGORITHMS:
    add_command(each)


@app.command(name=Tune.algo)
def _tune(rule: str, /, *, settings: Annotated[Tune, FLAT] = Tune()) -> None:  # noqa: B008
    """Search a rule's named numbers by CMA-ES over whole episodes; the result is its name with its settings.

    Args:
        rule: The policy, as in bench: gap-priority, target-gap, or one that --policy-file registers.
    """
    from agents.tuning import tune

    tune(replace(settings, rule=rule))


def main(settings: Settings, others: Sequence[Settings] = ()) -> None:
    """Train by these settings, and by others of the same environment; evaluate, report, keep the best agent."""
    folder = prepare(settings)
    try:
        _train(folder, settings, others)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(folder.name) from None


def _train(folder: Path, settings: Settings, others: Sequence[Settings]) -> None:
    # Only once the settings are known to be good: torch takes seconds to load.
    from agents.learner import learner_of
    from agents.report import Trained, keep

    def trained(settings: Settings) -> Trained:
        home = folder / settings.algo if others else folder
        home.mkdir(exist_ok=True)
        learner = learner_of(settings)
        runs = learner.train(home)
        return Trained(settings, folder, runs, [learner.agent(run) for run in runs], lines=lines)

    with locked(folder):
        objective = learner_of(settings).objective(folder, settings.seed)
        lines = objective.lines_to_beat()
        done = sorted(map(trained, (settings, *others)), key=lambda way: way.best.merit, reverse=True)
        keep(replace(done[0], beside=done[1:]), objective.report)


def others_of(settings: Settings) -> list[Settings]:
    """The other way to an agent, with the settings that both have, for at most a minute of one core."""
    shared = {name: getattr(settings, name) for name in ("validation_episodes", "name", "resume", "seeds", "seed")}
    return [PPO(steps=min(settings.steps, 60_000), environment=settings.environment, **shared)]


def typed(words: Sequence[str]) -> None:
    """Do what was typed; a mistake ends in one line, and Ctrl-C in the command that goes on."""
    try:
        for k, word in enumerate(words):
            if word.startswith("--algo"):
                now = BEFORE.get(word.partition("=")[2] or "".join(words[k + 1 : k + 2]), "hindsight")
                raise BufgymError(f"--algo is a command now: type python train.py {now}, then the other settings")
        app(words)
    except KeyboardInterrupt as stop:
        print("; ".join(["stopped", *(f"{_resuming(words, name)} goes on" for name in stop.args)]), file=sys.stderr)
        raise SystemExit(130) from None
    except BufgymError as error:
        raise SystemExit(f"error: {error}") from None
    except OSError as error:
        raise SystemExit(f"error: {error.filename or 'runs'}: {error.strerror or error}") from None


def _resuming(words: Sequence[str], name: str) -> str:
    """The command that was typed, and what resumes the run of this name."""
    is_named = any(word.partition("=")[0] == "--name" for word in words)
    more = [*([] if is_named else ["--name", name]), *([] if "--resume" in words else ["--resume"])]
    return shlex.join(["python", "train.py", *words, *more])


if __name__ == "__main__":
    typed(sys.argv[1:])
