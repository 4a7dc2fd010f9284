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
        ("hots = 1", "unknown field `hots`"),
        ("port = 70000", "Expected `int` <= 65535 - at `$.port`"),
        ("rules = [3]", "Expected `object`, got `int` - at `$.rules[0]`"),
        ("[[rules]]\nsend = true", "rule: needs one identity"),
        ("[[rules]]\nrecorder = true\nfoxglove = true\nsend = true", "rule: needs one identity"),
        (ANY_ADDRESS, "rule: must allow send or receive"),
        ('[[rules]]\naddress = "10.0.0.1/8"\nsend = true', "has host bits set"),
        ('[[rules]]\naddress = "robot"\nsend = true', "does not appear to be"),
        (f"{ANY_EMAIL}send = 1", "Expected `bool`, got `int` - at `$.rules[0].send`"),
        (f'{ANY_ADDRESS}send = true\ntopic = "("', "pattern '(': missing ): ( - at `$.rules[0]`"),
        (f"{ANY_EMAIL}send = true\ntopic = '(a)\\1'", "invalid escape sequence"),
        ("[limits]\ntopics = 0", "Expected `int` >= 1 - at `$.limits.topics`"),
        ("[limits]\nhello_s = -1", "Expected `float` > 0.0 - at `$.limits.hello_s`"),
        ('[tls]\nkey = "a"', "missing required field `certificate` - at `$.tls`"),
        ('[tokens]\nissuer = "a"\naudience = "b"\nkeys = "c"\nalgorithms = ["HS256"]', "tokens: algorithms"),
        *(
            (f'[nats]\nurl = "{url}"\nname = "a.b"', f"$.nats.{key}")
            for url, key in (("a:1", "url"), ("nats://a:1", "name"))
        ),
        ("[limits]\nhello_s = nan", "hello_s"),
        ('no_drop = ["("]', "pattern '('"),
        ("folder = 3", "3: must be a text - at `$.folder`"),
        *((f"{name} = {empty}", f"$.{name}") for name, empty in (("host", '""'), ("policies", "[]"))),
        ("a = [", "relay.toml: "),
    ],
)
def test_each_fault_is_named(text: str, error: str, tmp_path: Path) -> None:
    path = tmp_path / "relay.toml"
    path.write_text(text)
    with pytest.raises(BufgymError) as raised:
        load(path)
    assert str(raised.value).startswith(f"{path}: ") and error in str(raised.value)
