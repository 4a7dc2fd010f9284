"""Natural mistakes at the command line end in one sentence; natural inputs are understood."""

from pathlib import Path

import pytest
from cli_cases import Capsys, Patch, fails, shown

from bufgym.benchmark.rows import read_rows
from bufgym.ground.kernel import JIT
from bufgym.ground.units import bytes_of, rate_of
from bufgym.policies import registry

QUICK = ["bench", "--trace", "lte-synthetic-0", "--seconds", "1", "--fps", "10", "--seeds", "1", "--policies", "afr"]
"""A benchmark of ten messages."""


@pytest.mark.parametrize(
    ("command", "told"),
    [
        ("report", "report needs FOLDER"),
        ("trace convert lte-synthetic-0", "trace convert needs --out"),
        ("trace convert lte-synthetic-0 --out", "--out requires an argument"),
        ("leaderboard --suite outage", "unknown suite 'outage'; did you mean 'outage-v1'?"),
        ("leaderboard outage", "unknown suite 'outage'; did you mean 'outage-v1'?"),
        ("bench --capacity 4 4", "--capacity 4,4: must be whole numbers >= 1, no two alike"),
        ("bench --bytes 1.5", "1.5: must be a whole number of bytes >= 1, as in 230000, 1e6 or 4.6MB"),
        ("bench --bytes 4.6Mbit", "4.6Mbit: must be a whole number of bytes >= 1"),
        ("trace generate steady --rate 20Mbit --out x.csv", "20Mbit: must be bytes/s > 0, or as in 20Mbit/s"),
        (" ".join([*QUICK, "--bytes 4.6MB --max-bytes 1150000"]), "no message fits, the smallest has 4600000 bytes"),
    ],
)
def test_a_mistake_ends_in_a_sentence(command: str, told: str, capsys: Capsys) -> None:
    fails(command.split(), told, capsys)


RULE = """
from bufgym.policies import register
@register("mine"{})
def mine(buffer, arrival{}):
    return {}
"""


@pytest.mark.parametrize(
    ("compile", "memory", "answer", "told"),
    [
        ("", "", "0", "policy 'mine': on_arrival = mine(buffer, arrival): must take (buffer, arrival, memory)"),
        (", compile=True", ", memory, more", "0", "mine(buffer, arrival, memory, more): must take"),
        (", on_send=lambda buffer: 0", ", memory", "0", "on_send = <lambda>(buffer): must take (buffer, memory)"),
        (", compile=True", ", memory", "buffer.no", "attribute 'no' of type Buffer; File \"mine.py\", line 5\n"),
    ],
)
def test_a_rule_that_does_not_fit(
    compile: str, memory: str, answer: str, told: str, tmp_path: Path, monkeypatch: Patch, capsys: Capsys
) -> None:
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(RULE.format(compile, memory, answer), encoding="utf-8")
    if answer == "0" or JIT:
        fails([*QUICK, "--policy-file", "mine.py", "--policies", "mine"], told, capsys)


def test_natural_inputs(tmp_path: Path, capsys: Capsys) -> None:
    """Capacities as words, sizes with units; an earlier run's rows stay."""
    out = tmp_path / "out"
    shown([*QUICK, "--capacity", "2", "4", "--bytes", "4.6MB", "--format", "csv", "--out", out], capsys)
    assert [row["capacity"] for row in read_rows(out / "rows.csv")] == [2, 4]
    fails([*QUICK, "--out", out], "rows.csv: holds an earlier run's rows; choose another --out", capsys)
    shown(["trace", "generate", "steady", "--rate", "20Mbit/s", "--out", tmp_path / "s.csv"], capsys)
    assert "2,500" in shown(["trace", "info", tmp_path / "s.csv"], capsys)


def test_sizes_and_rates() -> None:
    sizes = {"7": 7, "1e6": 10**6, "4.6MB": 4_600_000, "4.6 kB": 4600, "2KiB": 2048, "1GB": 10**9, "3B": 3}
    assert {text: bytes_of(text) for text in sizes} == sizes
    rates = {"20Mbit/s": 2.5e6, "20 Mbps": 2.5e6, "2.5MB/s": 2.5e6, "8bit/s": 1.0, "8": None, "8MB": None, "x/s": None}
    assert {text: rate_of(text) for text in rates} == rates
