"""Train an agent and compare it with the fixed policies: ``python train.py``, or ``--help`` for all settings.

Results are in runs/NAME/. After a kill, the same command with ``--resume`` goes on from the last checkpoint.
"""

import sys
from collections.abc import Sequence
from typing import Annotated

from cyclopts import App

from agents.runs import prepare
from agents.settings import DQN, FLAT, PPO, Evolve, GuidedPPO, Settings
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


@app.command
def evolve(*, settings: Annotated[Evolve, FLAT] = Evolve()) -> None:  # noqa: B008
    """CMA-ES over whole episodes, on the numbers of a rule (gap-price for one queue)."""
    main(settings)


@app.command
def ppo(*, settings: Annotated[PPO, FLAT] = PPO()) -> None:  # noqa: B008
    """PPO on the slots of the buffer, with action masks."""
    main(settings)


@app.command
def dqn(*, settings: Annotated[DQN, FLAT] = DQN()) -> None:  # noqa: B008
    """Double DQN on the slots of the buffer, with action masks: PPO's learning rate and batch divided by four."""
    main(settings)


@app.command
def guided_ppo(*, settings: Annotated[GuidedPPO, FLAT] = GuidedPPO()) -> None:  # noqa: B008
    """PPO on the numbers of the rule gap-price, in an environment."""
    main(settings)


def main(settings: Settings, beside: bool = False) -> None:
    """Train, evaluate, report; with ``beside`` PPO on the same actions too, to compare."""
    folder = prepare(settings)
    # Only once the settings are known to be good: torch takes seconds to load.
    from agents import report, training

    with locked(folder):
        lines = report.lines_to_beat(settings)
        runs = training.train_all(settings, folder)
        others = training.train_beside(settings, folder, runs) if beside else []
        report.report(report.Trained(settings, folder, runs, others, lines))


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
