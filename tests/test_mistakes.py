"""Natural mistakes at the command line end in one sentence; natural inputs are understood."""

import json
import math
import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import pytest
from cli_cases import Capsys, Patch, fails, shown
from refusal_cases import refuse

import bufgym
from agents.report import Trained, agent_name
from bufgym import policies, scenario, traces
from bufgym.benchmark.rows import read_rows
from bufgym.jit import JIT
from bufgym.scenario import suites
from bufgym.utils.errors import BufgymError
from bufgym.utils.units import bytes_of, rate_of

QUICK = ["bench", "--trace", "lte-synthetic-0", "--seconds", "1", "--fps", "10", "--seeds", "1", "--policies", "afr"]
"""A benchmark of ten messages."""


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("report", "report needs FOLDER"),
        ("trace convert lte-synthetic-0", "trace convert needs --out"),
        ("trace convert lte-synthetic-0 --out", "--out requires an argument"),
        ("leaderboard --suite outage", "unknown suite 'outage'; did you mean 'outage-v1'?"),
        ("--verison", "unknown option '--verison'; did you mean '--version'?"),
        ("bench --scenario LTE", "unknown scenario 'LTE'; did you mean 'lte'?"),
        ("list rewards x", "error: x: one word too many; --help says what the command takes"),
        ("bench --trace 4Mbits --policies afr", "a steady link is as in 4Mbit/s"),
        ("bench --policies afr --out table.tex", 'for LaTeX bufgym.compare(...).table("latex")'),
        ("play --speed 0", "--speed: 0: must be a number from 0.01 to 1000"),
        ("leaderboard outage", "unknown suite 'outage'; did you mean 'outage-v1'?"),
        ("bench --capacity 4 4", "--capacity 4,4: must be whole numbers >= 1, no two alike"),
        ("bench --bytes 1.5", "1.5: must be a whole number of bytes >= 1, as in 230000, 1e6 or 4.6MB"),
        ("bench --bytes 4.6Mbit", "4.6Mbit: must be a whole number of bytes >= 1"),
        ("trace generate ramp --start 20Mbit --out x.csv", "20Mbit: must be bytes/s > 0, or as in 20Mbit/s"),
        (" ".join([*QUICK, "--bytes 4.6MB --max-bytes 1150000"]), "no message fits, the smallest has 4600000 bytes"),
        ("benc", 'Did you mean "bench"?'),
        ("trace convert lte-synthetic-0 --out x.csv --time t", "--time and --rate go together"),
        ("trace inf", 'Did you mean "info"?'),
        ("trace info missing.csv", "missing.csv"),
        ("trace plot lte-synthetic-0 --out x.doc", "x.doc"),
        ("play --env Moon-v0", "'Moon-v0'"),
        ("play --out film.mp4", "film.mp4: must end in .gif"),
        ("bench --policies decimate:every=0", "every = 0"),
        ("bench --policies mine.py", "--policy-file mine.py registers its policies"),
        ("bench --policies afr --against no-such", "no-such"),
        ("bench --capacity 0", "0: must be"),
        ("bench --fps nan", "nan: must be"),
        ("bench --scenario interruption --trace x.csv", "--trace cannot go with interruption, which has no such"),
        ("bench --scenario interruption:t_maxx=5", "unknown parameter 't_maxx'; did you mean 't_max'"),
        ("bench --nonsense", "--nonsense"),
        ("bench --size 3", "--size. Did you mean --sizes?"),
        ("bench --scenario topics --policies clairvoyant", "policy clairvoyant: it plans with a queue of its own"),
        ("bench --scenario topics --by-topic afr", "--by-topic afr: not among the policies that run"),
        ("bench --report page.txt", "--report page.txt: must be FILE.html in a folder that there is"),
        ("bench --scenario topics --out rows.txt", "rows.txt: rows are written to .csv or .parquet files"),
        ("bench --scenario no-such.toml", "error: no-such.toml: no such file\n"),
        ("bench --scenario x.toml --suite topics-v1", "--scenario cannot go with --suite"),
        ("topics --suite topics-v1", 'Unknown command "topics"'),
        ("bench --by-topic afr", "--by-topic needs several topics"),
        ("bench --scenario topics --max-bytes 9", "--max-bytes is for one queue"),
        (
            "bench --suite fleet-v1 --policies clairvoyant",
            "it plans with a link of its own, which no robot in a cell has",
        ),
    ],
)
def test_a_mistake_ends_in_a_sentence(command: str, message: str, capsys: Capsys) -> None:
    fails(command.split(), message, capsys)


@pytest.mark.parametrize(
    ("argument", "says"),
    [
        ({"L": 8}, "unknown argument 'L'; did you mean 'capacity'"),
        ({"fps": 30}, "did you mean 'rate_hz'"),
        ({"size": 460_800}, "did you mean 'size_bytes'"),
        ({"seed": 0}, r"a seed goes to reset\(seed=...\)"),
        ({"suite": "lte-v1"}, "bufgym/Suite-v1 takes it"),
    ],
)
def test_an_argument_by_another_name_is_understood(argument: dict[str, Any], says: str) -> None:
    with pytest.raises(TypeError, match=says):
        gym.make("bufgym/Uplink-v1", **argument)


def test_no_argument_is_meant_that_the_environment_lacks() -> None:
    with pytest.raises(TypeError, match=r"'fps'; known: (?!.*rate_hz)"):
        gym.make("bufgym/Suite-v1", suite="lte-v1", fps=30)


RULE = """
from bufgym.policies import register
@register("mine"{})
def mine(buffer, arrival{}):
    return {}
"""


TAKES = "(buffer, arrival, memory)"
UNCOMPILED = "mine.py:5: kernel mine: buffer has no 'no' in kernels\n" if JIT else "line 5: AttributeError"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("def broken(:\n", "line 1"),
        ("import a_module_that_is_not_there\n", "line 1: ModuleNotFoundError"),
        (RULE.format("", ", memory", "1 // 0"), "line 5: ZeroDivisionError"),
        (RULE.format("", "", "0"), "policy 'mine': on_arrival = mine(buffer, arrival): must take " + TAKES),
        (RULE.format(", compile=True", ", memory, more", "0"), "mine(buffer, arrival, memory, more): must take"),
        (RULE.format(", on_send=lambda b: 0", ", memory", "0"), "on_send = <lambda>(b): must take (buffer, memory)"),
        (RULE.format(", compile=True", ", memory", "buffer.no"), UNCOMPILED),
    ],
)
def test_a_rule_that_does_not_fit(text: str, message: str, tmp_path: Path, monkeypatch: Patch, capsys: Capsys) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(text, encoding="utf-8")
    only = ["--policies", "mine"] if "mine" in text else []
    fails([*QUICK, "--policy-file", "mine.py", *only], message, capsys)


def test_natural_inputs(tmp_path: Path, capsys: Capsys) -> None:
    """Capacities as words, sizes with units; an earlier run's rows stay."""
    out = tmp_path / "out"
    shown([*QUICK, "--capacity", "2", "4", "--bytes", "4.6MB", "--format", "csv", "--out", out], capsys)
    assert [row["capacity"] for row in read_rows(out / "rows.csv")] == [2, 4]
    fails([*QUICK, "--out", out], "rows.csv: holds an earlier run's rows; choose another --out", capsys)
    shown(
        ["trace", "generate", "ramp", "--start", "20Mbit/s", "--end", "20Mbit/s", "--out", tmp_path / "s.csv"], capsys
    )
    assert "2,500" in shown(["trace", "info", tmp_path / "s.csv"], capsys)


def test_a_link_as_a_spreadsheet_has_it(tmp_path: Path) -> None:
    """8 and 4 Mbit/s for a second each, then nothing for as long; times in seconds, of any clock, or as dates."""
    clock = "1790000000.5", "1790000001.5", "1790000002.5"
    day = "2026-10-25T02:59:59+02:00", "2026-10-25T02:00:00+01:00", "2026-10-25 01:00:01"
    for header, times in (("time,mbps", ("0", "1", "2")), ("Time, Mbps", clock), ("timestamp,mbit/s", day)):
        file = tmp_path / "link.csv"
        rows = [f"{time},{rate}" for time, rate in zip(times, (8, 4, 0), strict=True)]
        file.write_text("\n".join([header, *rows]), encoding="utf-8")
        trace = traces.load(file)
        assert trace.time_us.tolist() == [0, 10**6, 2 * 10**6, 3 * 10**6]
        assert trace.cumulative_bytes.tolist() == [0, 10**6, 1_500_000, 1_500_000]
    file.write_text("time,mbps\n2026-13-01,8\n", encoding="utf-8")
    refuse(r"link.csv, line 2: time in s = 2026-13-01: must be a finite number", traces.load, file)


def uplink(text: str, **changes: Any) -> scenario.Uplink:
    """The scenario of that text."""
    made = scenario.get(text, **changes)
    assert isinstance(made, scenario.Uplink)
    return made


def test_paths_rates_and_parameters_wherever_text_is_taken(tmp_path: Path) -> None:
    link, client = tmp_path / "link.csv", tmp_path / "client.toml"
    traces.write_csv(traces.steady(1e6, 2), link)
    client.write_text('[[topic]]\nname = "a"\nrate_hz = 5\nsize_bytes = 9\n', encoding="utf-8")
    for path in (link, str(link)):
        assert [trace.name for trace in uplink("lte", traces=path).traces] == ["link"]
    assert [topic.name for topic in scenario.get(client).topics] == ["a"]
    assert traces.load("20Mbit/s").mean_bytes_per_s == 2.5e6
    given = uplink("lte:rate_hz=5,duration_s=2,motion=none,value=saturating:0.5,traces=8Mbps")
    assert (given.rate_hz, given.max_messages, given.motion, given.value.name) == (5, 10, (), "saturating:0.5")
    assert [trace.name for trace in given.traces] == ["8Mbps"]
    (row,) = bufgym.compare("afr", "lte:duration_s=1,traces=8Mbps", seeds=1, progress=False).rows
    assert row["arrived"] == 30
    refuse(r"unknown parameter 'rate'; did you mean 'rate_hz'", scenario.get, "lte:rate=5")


def test_results_without_bare_nan(tmp_path: Path) -> None:
    """JSON has no NaN: no regret is null."""
    run: Any = SimpleNamespace(seed=0, seconds=1.0, merit=1.0)
    settings: Any = SimpleNamespace(algo="ppo", values={})
    trained = Trained(settings, tmp_path, [run], [])
    scores = [{"policy": name, "qoi": 1.0, "regret": math.nan} for name in [agent_name(run), "drop-oldest"]]
    trained.save(tmp_path, scores=scores, held_out="")
    text = (tmp_path / "results.json").read_text(encoding="utf-8")
    assert [row["regret"] for row in json.loads(text, parse_constant=pytest.fail)["scores"]] == [None, None]


def test_help_tells_the_defaults_and_wraps_evenly(capsys: Capsys) -> None:
    """The numbers are those of the scenario; a box's second column begins at one place in every line."""
    text = shown(["bench", "--help"], capsys)
    lte = uplink("lte")
    for option, default in (("fps", lte.rate_hz), ("bytes", lte.size_bytes), ("seconds", lte.duration_s)):
        message = re.search(rf"--{option} .*?\(default:[ │\n]+([0-9]+)", text, re.DOTALL)
        assert message and float(message[1]) == default, option
    box = text[text.index("─ Who runs ─") : text.index("─ The scenario, its stream")].splitlines()[1:-1]
    assert {len(line) - len(line[1:].lstrip()) for line in box if not line.startswith(("│ --", "╰"))} == {21}
    assert "▌" not in shown(["trace", "generate", "link", "--help"], capsys)


def test_sizes_and_rates() -> None:
    sizes = {"7": 7, "1e6": 10**6, "4.6MB": 4_600_000, "4.6 kB": 4600, "2KiB": 2048, "1GB": 10**9, "3B": 3}
    assert {text: bytes_of(text) for text in sizes} == sizes
    rates = {"20Mbit/s": 2.5e6, "20 Mbps": 2.5e6, "2.5MB/s": 2.5e6, "8bit/s": 1.0, "8": None, "8MB": None, "x/s": None}
    assert {text: rate_of(text) for text in rates} == rates


# A wrong name of any kind ends in one sentence that says which was meant.

LTE = ("duration_s", "rate_hz", "size_bytes", "propagation_us", "random_offset", "traces", "motion")
TOPIC = ("priority", "deadline_s", "no_drop", "rate_limit_hz", "size_bytes")


def without_one(name: str) -> str:
    """The name without a letter near its end."""
    return name[:-2] + name[-1:] if len(name) < 4 else name[:-4] + name[-3:]


def of_topic(wrong: str) -> Any:
    """Read a client whose only topic has this setting."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "client.toml")
        file.write_text(f'[[topic]]\nname = "a"\n{wrong} = 1\n', encoding="utf-8")
        return scenario.read_client(file)


def mistakes() -> Iterator[tuple[str, Callable[[str], Any]]]:
    """The right name, and what is called with the wrong one."""
    for name in [*policies.names()][::4]:
        yield name, policies.get
    for name in policies.get("codel").parameters:
        yield name, lambda wrong: policies.get(f"codel:{wrong}=2")
    for name in scenario.SCENARIOS:
        yield name, scenario.get
        yield name, lambda wrong: bufgym.compare("afr", wrong)
    for name in suites.SUITES:
        yield name, suites.get
        yield name, lambda wrong: bufgym.compare("afr", wrong)
    for name in LTE:
        yield name, lambda wrong: scenario.get("lte", **{wrong: 1})
        yield name, lambda wrong: bufgym.compare("afr", "lte", **{wrong: 1})
    for name in TOPIC:
        yield name, of_topic
    for name in ("capacity", "progress", "against", "max_bytes", "decide_at"):
        yield name, lambda wrong: bufgym.compare("afr", "lte", **{wrong: 1})
    for name in ("reward", "decide_at", "observation", "fields", "capacity", "max_bytes", "duration_s", "rate_hz"):
        yield name, lambda wrong: gym.make("bufgym/Uplink-v1", **{wrong: 1}, actions="slots")
        yield (
            name,
            lambda wrong: gym.make_vec("bufgym/Uplink-v1", 2, "vector_entry_point", **{wrong: 1}, actions="slots"),
        )
    for name in ("retained", "delivered", "delay"):
        yield name, lambda wrong: gym.make("bufgym/Uplink-v1", reward={wrong: 1}, actions="slots")
    for name in ("time_before", "relative_loss", "backlog", "service_ratio"):
        yield name, lambda wrong: gym.make("bufgym/Uplink-v1", fields=["rank", wrong], actions="slots")
    for name in ("episode", "trace", "scenario"):
        yield name, lambda wrong: gym.make("bufgym/Uplink-v1", actions="slots").reset(options={wrong: 1})


CASES = list(mistakes())


@pytest.mark.parametrize(("name", "call"), CASES)
def test_the_right_name_is_suggested(name: str, call: Callable[[str], Any]) -> None:
    with pytest.raises(BufgymError) as caught:
        call(without_one(name))
    message = str(caught.value)
    assert "unknown " in message and f"{without_one(name)!r}; did you mean {name!r}?" in message and "\n" not in message
