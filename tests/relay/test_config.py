"""Configurations: the example is read, each fault is named."""

from pathlib import Path

import pytest
import relay_cases  # noqa: F401  (skips where the extra is missing)

from bufgym import cli
from bufgym.ground.errors import BufgymError
from bufgym.relay.config import Config, Foxglove, Rotation, Rule, load

REPO = Path(__file__).resolve().parents[2]
ANY_ADDRESS = '[[rules]]\naddress = "10.0.0.1"\n'
ANY_EMAIL = '[[rules]]\nemail = "a@x.org"\n'


def test_the_example_says_what_the_defaults_are(capsys: pytest.CaptureFixture[str]) -> None:
    example, default = load(REPO / "examples/relay.toml"), Config()
    names = ["host", "port", "no_drop", "policies", "robofleet", "origins", "limits", "store", "audit", "recording"]
    for name in names:
        assert getattr(example, name) == getattr(default, name), name
    assert example.folder == REPO / "examples" / "relay"
    assert len(example.rules) == 5 and default.rules == ()
    assert cli.main(["relay", "serve", "--config", str(REPO / "examples/relay.toml"), "--check"]) == 0
    assert "5 rules, 127.0.0.1:7420" in capsys.readouterr().out


def test_tables_and_files_beside_the_configuration(tmp_path: Path) -> None:
    path = tmp_path / "relay.toml"
    path.write_text(
        '[tls]\ncertificate = "a.pem"\nkey = "a.key"\n'
        '[tokens]\nissuer = "i"\naudience = "a"\nkeys = "k.json"\nalgorithms = ["ES256"]\n[audit]\nbytes = 5000\n'
        "[foxglove]\nport = 9000\n[[rules]]\nfoxglove = true\nreceive = true\n"
    )
    config = load(path)
    assert config.tls is not None and config.tokens is not None
    assert (config.tls.certificate, config.tls.key) == (str(tmp_path / "a.pem"), str(tmp_path / "a.key"))
    assert config.tls.clients == "" and config.tokens.keys == str(tmp_path / "k.json")
    assert config.audit == Rotation(bytes=5000)
    assert config.foxglove == Foxglove(port=9000) and config.rules == (Rule(foxglove=True, receive=True),)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("hots = 1", "unknown key 'hots'"),
        ("port = 70000", "port = 70000: must be a whole number from 0 to 65535"),
        ("rules = 3", "rules: must be [[rules]] tables"),
        ("rules = [3]", "rules = 3: must be a table"),
        ("[[rules]]\nsend = true", "rule: needs one identity"),
        (f'{ANY_ADDRESS}email = "a@x.org"\nsend = true', "rule: needs one identity"),
        ("[[rules]]\nrecorder = true\nfoxglove = true\nsend = true", "rule: needs one identity"),
        (ANY_ADDRESS, "rule: must allow send or receive"),
        ('[[rules]]\naddress = "10.0.0.1/8"\nsend = true', "has host bits set"),
        ('[[rules]]\naddress = "robot"\nsend = true', "does not appear to be"),
        (f"{ANY_EMAIL}send = 1", "rule: send = 1: must be true or false"),
        (f'{ANY_ADDRESS}send = true\ntopic = "("', "rules: pattern '(': missing )"),
        (f"{ANY_EMAIL}send = true\ntopic = '(a)\\1'", "invalid escape sequence"),
        ("[limits]\ntopics = 0", "limits: topics = 0: must be a whole number from 1"),
        ("[limits]\nhello_s = -1", "limits: hello_s = -1: must be a number > 0"),
        ("[store]\nwindow = 0", "store: window = 0: n_T must be a whole number from 1"),
        ("[audit]\nbytes = 3", "audit: bytes = 3: must be"),
        ('[tls]\nkey = "a"', "tls: missing 1 required positional argument: 'certificate'"),
        ('[tokens]\nissuer = "a"\naudience = "b"\nkeys = "c"\nalgorithms = ["HS256"]', "tokens: algorithms"),
        ("[foxglove]\nport = -1", "foxglove: port = -1: must be a whole number from 0"),
        ("[foxglove]\nhost = 3", "foxglove: host = 3: must be a text"),
        ('[mesh]\nlisten = "7421"', "mesh: address '7421': must be HOST:PORT"),
        ('[mesh]\nlisten = "a:1"\nconnect = ["b:x"]', "mesh: address 'b:x': must be HOST:PORT"),
        ('[mesh]\nlisten = "a:1"\nkey = "k"', "mesh: certificate, key and authority: must be given together"),
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
