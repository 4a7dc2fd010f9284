"""Train an agent and compare it with the fixed policies: ``python train.py``, or ``--help`` for all settings.

Results are in runs/NAME/. After a kill, the same command with ``--resume`` goes on from the last checkpoint.
"""

from __future__ import annotations

from agents.runs import prepare
from agents.settings import Settings
from bufgym.ground.errors import BufgymError
from bufgym.ground.files import locked


def main(settings: Settings | None = None) -> None:
    """Train, evaluate, report."""
    if settings is None:
        import tyro

        settings = tyro.cli(Settings)
    try:
        folder = prepare(settings)
        # Only once the settings are known to be good: torch takes seconds to load.
        from agents import report, training

        with locked(folder):
            report.report(settings, folder, training.train_all(settings, folder))
    except BufgymError as error:
        raise SystemExit(f"error: {error}") from None
    except OSError as error:
        raise SystemExit(f"error: {error.filename or 'runs'}: {error.strerror or error}") from None


if __name__ == "__main__":
    main()
