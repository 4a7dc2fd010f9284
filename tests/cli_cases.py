"""What the tests of commands share."""

from __future__ import annotations

import pytest

from bufgym.cli import main


def fails(command: list[str], naming: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The command ends with code 2 and one line that names the culprit."""
    assert main(command) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    assert shown.err.startswith("bufgym: error: ")
    assert naming in shown.err
    assert "Traceback" not in shown.err
