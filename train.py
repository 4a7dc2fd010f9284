"""Train an agent and compare it with the fixed policies: ``python train.py``, or ``--help`` for all settings.

Results are in runs/NAME/. After a kill, the same command with ``--resume`` goes on from the last checkpoint.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App

from agents.runs import prepare
from agents.settings import ALGORITHMS, FLAT, Evolve, GuidedPPO, Settings
from bufgym.cli.options import OPTIONS
from bufgym.ground.errors import BufgymError
from bufgym.ground.files import locked

app = App("train.py", help_format="plaintext", default_parameter=OPTIONS, error_formatter=lambda said: f"error: {said}")
BEFORE = {"guided": "evolve", "maskable-ppo": "ppo", "ppo": "ppo --unmasked", "dqn": "dqn", "guided-ppo": "guided-ppo"}
"""A value that ``--algo`` had -> the command that now does it."""


@app.default
def _evolve_beside(*, settings: Annotated[Evolve, FLAT] = Evolve()) -> None:  # noqa: B008
    """Train an agent on a bufgym environment, or on a whole suite, and evaluate it on held-out episodes.

    Without a command: evolve, and then, in an environment, guided-ppo for no longer, to compare.
    """
    main(settings, beside=settings.kind == "environment")


def add_command(algorithm: type[Settings]) -> None:
    """Make a command of an algorithm; its options are the settings."""

    def command(*, settings: Annotated[algorithm, FLAT] = algorithm()) -> None:  # type: ignore[valid-type, call-arg]  # noqa: B008
        main(settings)

    command.__doc__ = algorithm.__doc__
    app.command(command, name=algorithm.algo)


for each in ALGORITHMS:
    add_command(each)


def main(settings: Settings, beside: bool = False) -> None:
    """Train, evaluate, report; with ``beside`` PPO on the same actions too, for no longer than evolution took."""
    folder = prepare(settings)
    # Only once the settings are known to be good: torch takes seconds to load.
    from agents.learner import learner_of
    from agents.report import Trained, keep

    def trained(settings: Settings, home: Path, seconds: float = math.inf, **more: Any) -> Trained:
        learner = learner_of(settings, seconds)
        runs = learner.train(home)
        return Trained(settings, home, runs, [learner.agent(run) for run in runs], **more)

    with locked(folder):
        objective = learner_of(settings).objective(folder, settings.seed)
        lines = objective.lines_to_beat()
        done = trained(settings, folder, lines=lines)
        if beside:
            home, seconds = folder / "ppo", max(run.seconds for run in done.runs)
            home.mkdir(exist_ok=True)
            print(f"PPO on the same actions, for at most {seconds:.0f} s")
            done = replace(done, beside=trained(other_of(settings), home, seconds))
        keep(done, objective.report)


def other_of(settings: Settings) -> GuidedPPO:
    """PPO on guided actions, with the settings that evolution has too."""
    shared = ("environment", "validation_episodes", "name", "resume", "seeds", "seed")
    steps = min(settings.steps, GuidedPPO.steps)
    return GuidedPPO(steps=steps, **{name: getattr(settings, name) for name in shared})


def typed(words: Sequence[str]) -> None:
    """Do what was typed; a mistake ends in one line."""
    try:
        for k, word in enumerate(words):
            if word.startswith("--algo"):
                now = BEFORE.get(word.partition("=")[2] or "".join(words[k + 1 : k + 2]), "evolve")
                raise BufgymError(f"--algo is a command now: type python train.py {now}, then the other settings")
        app(words)
    except BufgymError as error:
        raise SystemExit(f"error: {error}") from None
    except OSError as error:
        raise SystemExit(f"error: {error.filename or 'runs'}: {error.strerror or error}") from None


if __name__ == "__main__":
    typed(sys.argv[1:])
