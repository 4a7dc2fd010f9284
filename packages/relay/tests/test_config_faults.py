"""Faults of a configuration: each answer names file, line, key, value and rule."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from needs import needs

pytest.importorskip("re2", reason=needs("extras", "re2"))
pytest.importorskip("websockets", reason=needs("extras", "websockets"))

from bufgym.utils.errors import BufgymError
from bufgym_relay import commands
from bufgym_relay.config import Config, Foxglove, Nats, Rule, Tls, load
from bufgym_relay.faults import doubts

ANY_ADDRESS = '[[rules]]\naddress = "10.0.0.1"\n'
ANY_EMAIL = '[[rules]]\nemail = "a@x.org"\n'


def refused(text: str, folder: Path, read: Callable[[str], Any]) -> tuple[str, str]:
    """The path of a file with this text, and the error that reading it raises."""
    path = folder / "relay.toml"
    path.write_text(text)
    with pytest.raises(BufgymError) as raised:
        read(str(path))
    return str(path), str(raised.value)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("hots = 1", ", line 1: unknown key 'hots'; did you mean 'host'?"),
        ("port = 70000", ", line 1: port = 70000: must be a whole number <= 65535"),
        ("\nport = '7420'", ', line 2: port = "7420": must be a whole number'),
        ("rules = [3]", ", rule 1: each rule must begin with [[rules]]"),
        ("[rules]\nsend = true", ", line 1: each rule must begin with [[rules]]"),
        ("[[rules]]\nsend = true", ", line 1, rule 1: needs one identity"),
        ("[[rules]]\nrecorder = true\nfoxglove = true\nsend = true", "rule 1: needs one identity"),
        (ANY_ADDRESS, "rule 1: must allow send or receive"),
        (
            f"{ANY_EMAIL}send = true\n{ANY_EMAIL}send = true\ntopics = ''",
            "rule 2: unknown key 'topics'; did you mean 'topic'",
        ),
        (f"{ANY_EMAIL}send = true\nhost = '::'", "rule 1: unknown key 'host' here; it must stand above the first ["),
        (
            '[[rules]]\naddress = "10.0.0.1/8"\nsend = true',
            ", line 2, rule 1: address = '10.0.0.1/8': is within a range; did you mean the range '10.0.0.0/8' or the "
            "address '10.0.0.1'?",
        ),
        ('[[rules]]\naddress = "robot"\nsend = true', "address = 'robot': must be an IP address or a range as"),
        (f"{ANY_EMAIL}send = 1", "rule 1: send = 1: must be true or false"),
        (
            f'{ANY_ADDRESS}send = true\ntopic = "("',
            "rule 1: topic: pattern '(': missing ), unterminated subpattern at position 0",
        ),
        (f"{ANY_EMAIL}send = true\ntopic = '(a)\\1'", "invalid escape sequence"),
        (f"{ANY_EMAIL}send = true\ntopic = ['a']", "rule 1: topic = ['a']: must be a text in quotes"),
        ("[limits]\ntopics = 0", ", line 2, [limits]: topics = 0: must be a whole number >= 1"),
        ("[limits]\nhello_s = -1", ", line 2, [limits]: hello_s = -1: must be a number > 0.0"),
        ('[tls]\nkey = "a"', ", line 1, [tls]: needs the key 'certificate'"),
        ('[tokens]\nissuer = "a"\naudience = "b"\nkeys = "c"\nalgorithms = ["HS256"]', "[tokens]: algorithms"),
        (
            '[nats]\nurl = "a:1"\nname = "b"',
            ", line 2, [nats]: url = 'a:1': must be nats://HOST:PORT or tls://HOST:PORT",
        ),
        ('[nats]\nurl = "ann:secret@a:1"\nname = "b"', "[nats]: url = 'a:1': must be"),
        ('[nats]\nurl = "nats://a:1"\nname = "a.b"', "[nats]: name = 'a.b': must be 1 to 32 letters, digits, _ or -"),
        ("[limits]\nhello_s = nan", "hello_s"),
        ('no_drop = ["("]', ", line 1: no_drop: pattern '('"),
        ('latched = "/map"', ', line 1: latched = "/map": must be a list, as [...]'),
        ('origins = ["https://a.org/"]', "origins = 'https://a.org/': must be as https://example.org, without a path"),
        ("folder = 3", ", line 1: folder = 3: must be a text in quotes"),
        ('host = ""', 'host = "": must not be empty'),
        ('host = "a\\u0007"', "must be one line of text"),
        ("policies = []", "policies = []: must not be empty"),
        ("a = [", ": "),
    ],
)
def test_each_fault_is_named(text: str, error: str, tmp_path: Path) -> None:
    path, said = refused(text, tmp_path, load)
    assert said.startswith(f"{path}{error[:1]}" if error[:1] in ",:" else path)
    assert error in said and "`" not in said


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ('policies = ["robofleat"]', "unknown policy 'robofleat'; did you mean 'robofleet'?"),
        ('[tls]\ncertificate = "a.pem"\nkey = "b.pem"', "a.pem': no such file"),
        ('[tokens]\nissuer = "a"\naudience = "b"\nkeys = "c.json"', "c.json': no such file"),
    ],
)
def test_check_opens_what_the_file_names(text: str, error: str, tmp_path: Path) -> None:
    path, said = refused(text, tmp_path, lambda path: asyncio.run(commands.serve(config=path, check=True)))
    assert said.startswith(f"{path}: ") and error in said


def test_a_rule_that_does_nothing_is_doubted() -> None:
    email, recorder = Rule(email="a@b.c", send=True), Rule(recorder=True, receive=True)
    nats, foxglove = Rule(nats=True, send=True), Rule(foxglove=True, receive=True)
    rules = (email, recorder, nats, foxglove)
    starts = [doubt.partition(": without")[0] for doubt in doubts(Config(rules=rules))]
    assert starts == ["rule 1: email", "rule 2: recorder", "rule 3: nats", "rule 4: foxglove"]
    served = Config(
        rules=rules,
        tls=Tls("a", "b", clients="c"),
        folder=Path("held"),
        nats=Nats("nats://a:1", "west"),
        foxglove=Foxglove(),
    )
    assert doubts(served) == [] and doubts(Config()) == ["no [[rules]]: nobody may connect"]
