"""Train an agent and compare it with the fixed policies: ``python train.py``, or ``--help`` for all settings.

Results are in runs/NAME/. After a kill, the same command with ``--resume`` goes on from the last checkpoint.
"""

from typing import Annotated

from cyclopts import App, Parameter

from agents.runs import prepare
from agents.settings import Settings
from bufgym.cli.options import OPTIONS
from bufgym.ground.errors import BufgymError
from bufgym.ground.files import locked

app = App("train.py", help_format="plaintext", default_parameter=OPTIONS, error_formatter=lambda said: f"error: {said}")


@app.default
def _typed(*, settings: Annotated[Settings, Parameter(name="*")] = Settings()) -> None:  # noqa: B008
    """Train an agent on a bufgym environment, or on a whole suite, and evaluate it on held-out episodes."""
    main(settings)


def main(settings: Settings) -> None:
    """Train, evaluate, report."""
    settings = settings.resolved()
    try:
        folder = prepare(settings)
        # Only once the settings are known to be good: torch takes seconds to load.
        from agents import report, training

        with locked(folder):
            lines = report.lines_to_beat(settings)
            runs = training.train_all(settings, folder)
            report.report(settings, folder, runs, training.train_beside(settings, folder, runs), lines)
    except BufgymError as error:
        raise SystemExit(f"error: {error}") from None
    except OSError as error:
        raise SystemExit(f"error: {error.filename or 'runs'}: {error.strerror or error}") from None


if __name__ == "__main__":
    app()
