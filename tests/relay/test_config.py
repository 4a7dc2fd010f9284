"""Configurations: the example is read, each fault is named."""

from __future__ import annotations

from pathlib import Path

import pytest
import relay_cases  # noqa: F401  (skips where the extra is missing)

from bufgym import cli
from bufgym.errors import BufgymError
from bufgym.relay.config import Config, Rotation, load

REPO = Path(__file__).resolve().parents[2]


def test_the_example_says_what_the_defaults_are() -> None:
    example, default = load(REPO / "examples/relay.toml"), Config()
    for name in (
        "host",
        "port",
        "no_drop",
        "policies",
        "robofleet",
        "origins",
        "limits",
        "store",
        "audit",
        "recording",
    ):
        assert getattr(example, name) == getattr(default, name), name
    assert example.folder == REPO / "examples" / "relay"
    assert len(example.rules) == 5 and default.rules == ()


def test_the_command_checks_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["relay", "serve", "--config", str(REPO / "examples/relay.toml"), "--check"]) == 0
    assert "5 rules, 127.0.0.1:7420" in capsys.readouterr().out


def test_its_files_lie_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "relay.toml"
    path.write_text(
        '[tls]\ncertificate = "a.pem"\nkey = "a.key"\n'
        '[tokens]\nissuer = "i"\naudience = "a"\nkeys = "k.json"\nalgorithms = ["ES256"]\n[audit]\nbytes = 5000\n'
    )
    config = load(path)
    assert config.tls is not None and config.tokens is not None
    assert (config.tls.certificate, config.tls.key) == (str(tmp_path / "a.pem"), str(tmp_path / "a.key"))
    assert config.tls.clients == "" and config.tokens.keys == str(tmp_path / "k.json")
    assert config.audit == Rotation(bytes=5000)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("hots = 1", "unknown key 'hots'"),
        ("port = 70000", "port = 70000: must be a whole number from 0 to 65535"),
        ("rules = 3", "rules: must be [[rules]] tables"),
        ("rules = [3]", "rules = 3: must be a table"),
        ("[[rules]]\nsend = true", "rule: needs one identity"),
        ('[[rules]]\naddress = "10.0.0.1"\nsend = true\ntopic = "("', "rules: pattern '(': missing )"),
        ("[limits]\ntopics = 0", "limits: topics = 0: must be a whole number from 1"),
        ("[limits]\nhello_s = -1", "limits: hello_s = -1: must be a number > 0"),
        ("[store]\nwindow = 0", "store: window = 0: n_T must be a whole number from 1"),
        ("[audit]\nbytes = 3", "audit: bytes = 3: must be"),
        ('[tls]\nkey = "a"', "tls: missing 1 required positional argument: 'certificate'"),
        ('[tokens]\nissuer = "a"\naudience = "b"\nkeys = "c"\nalgorithms = ["HS256"]', "tokens: algorithms"),
        ("[foxglove]\nport = -1", "foxglove: port = -1: must be a whole number from 0"),
        ("[foxglove]\nhost = 3", "foxglove: host = 3: must be a text"),
        ('no_drop = ["("]', "pattern '('"),
        ("folder = 3", "folder = 3: must be a text"),
        ("policies = []", "policies: needs at least one"),
        ("a = [", "relay.toml: "),
    ],
)
def test_each_fault_is_named(text: str, error: str, tmp_path: Path) -> None:
    path = tmp_path / "relay.toml"
    path.write_text(text)
    with pytest.raises(BufgymError) as raised:
        load(path)
    assert str(raised.value).startswith(f"{path}: ") and error in str(raised.value)
