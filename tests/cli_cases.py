"""What the tests of commands share."""

from collections.abc import Sequence

import pytest

from bufgym.cli import main

Capsys = pytest.CaptureFixture[str]
Patch = pytest.MonkeyPatch

FAR_OFF = """
from bufgym.policies import make_room, register
@register("far-off", on_send=lambda buffer, memory: 999, for_topics={})
def far_off(buffer, arrival, memory):
    return make_room(buffer, arrival)
"""
"""A policy file whose decisions at a free socket cannot be carried out; ``format`` says whether it is for topics."""


def shown(command: Sequence[object], capsys: pytest.CaptureFixture[str]) -> str:
    """What the command prints, which ends with code 0."""
    capsys.readouterr()
    assert main([str(word) for word in command]) == 0
    return capsys.readouterr().out


def fails(command: Sequence[object], naming: str, capsys: pytest.CaptureFixture[str]) -> str:
    """The command ends with code 2 and one printable line that names the culprit; the line."""
    capsys.readouterr()
    assert main([str(word) for word in command]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and err[:-1].isprintable()
    assert err.startswith("bufgym: error: ") and naming in err
    return err
