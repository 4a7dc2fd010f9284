"""``bufgym relay robot``, ``demo`` and ``foxglove``: what they say of what is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli_cases import fails

pytest.importorskip("websockets", reason="no websockets here: the extra relay")


def test_the_commands_name_what_is_wrong(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    missing = str(tmp_path / "none")
    fails(["relay", "robot", "--config", missing], missing, capsys)
    fails(["relay", "robot", "--bag", missing], missing, capsys)
    fails(["relay", "robot", "--ros", "2"], "--ros needs --config", capsys)
    fails(["relay", "robot", "--to", "there:1"], "there:1: must be ws://HOST:PORT", capsys)
    fails(["relay", "robot", "--token-file", missing], missing, capsys)
    fails(["relay", "robot", "--policies", "oracle"], "oracle", capsys)
    fails(["relay", "demo", "--robots", "0"], "must be a whole number >= 1", capsys)
