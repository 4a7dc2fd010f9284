"""``bufgym live``, as a user types it."""

import json
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from cli_cases import fails
from live_cases import Bench

from bufgym.cli import main
from bufgym.model import qoi
from bufgym.traces.formats import bags
from bufgym_robot import LogFile
from bufgym_robot.commands import address
from bufgym_robot.view import View
from bufgym_robot.wire.sockets import free_port, host_port

FAST = ["--size", "1000", "--rate", "300", "--duration", "0.1", "--capacity", "64"]
"""30 messages in 0.1 s, and room for all of them, however slow the machine is."""


@contextmanager
def receiver(capsys: pytest.CaptureFixture[str], *words: str, host: str = "127.0.0.1") -> Iterator[str]:
    """Where ``bufgym live receive`` listens, in a thread, for 30 messages."""
    port = str(free_port(host.strip("[]")))
    arguments = ["live", "receive", f"{host}:{port}", "--messages", "30", *words]
    thread = threading.Thread(target=main, args=(arguments,), daemon=True)
    thread.start()
    while "listening" not in capsys.readouterr().out:
        assert thread.is_alive()
        time.sleep(0.005)
    yield f"{host}:{port}"
    thread.join()


def test_send_receive_and_replay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    came, log = tmp_path / "came.mcap", tmp_path / "log.mcap"
    with receiver(capsys, "--out", str(came)) as place:
        assert main(["live", "send", place, *FAST, "--log", str(log)]) == 0
    assert main(["live", "replay", str(log)]) == 0
    out = capsys.readouterr().out
    assert "30 received" in out and "30 put, 30 delivered, 0 dropped" in out
    bag = bags.read_bag(came)
    assert bag.size_bytes[bag.topic == list(bag.topics).index("/topic_0")].tolist() == [1000] * 30


def test_send_shows_what_the_queue_does(capsys: pytest.CaptureFixture[str]) -> None:
    with receiver(capsys) as place:
        assert main(["live", "send", place, *FAST, "--view"]) == 0
    out = capsys.readouterr().out
    assert out.count("afr, L = 64") == 2 and "left         30" in out


def test_send_to_nobody_says_so() -> None:
    """And why, every second once it has asked; at the end it waits for a receiver until it is stopped."""
    place = f"127.0.0.1:{free_port('127.0.0.1')}"
    code = f"from bufgym.cli import main; main(['live', 'send', '{place}', '--size', '10', '--duration', '0.5'])"
    with subprocess.Popen([sys.executable, "-uc", code], stdout=subprocess.PIPE, text=True) as sending:
        assert sending.stdout is not None
        lines = [sending.stdout.readline(), sending.stdout.readline()]
        sending.kill()
    assert lines[0] == "   0 s: 1 put, 0 dropped, 0 queued\n"  # it is still being asked
    assert lines[1].startswith("9 messages wait for the receiver") and "ConnectionRefusedError" in lines[1]


def test_validate_keeps_its_runs(tmp_path: Path) -> None:
    arguments = ["--trace", "lte-synthetic-0", "--policies", "afr", "--duration", "0.5", "--size", "5000"]
    arguments += ["--speed", "4", "--transport", "tcp", "websocket", "--out", str(tmp_path)]
    assert main(["live", "validate", *arguments]) == 0
    kept = json.loads((tmp_path / "runs.json").read_text(encoding="utf-8"))
    assert len(kept["runs"]) == 2 and "--transport tcp websocket" in kept["command"]
    assert all(len(one["live_s"]) == one["live_delivered"] > 0 for one in kept["runs"])


def test_an_address_of_ipv6_stands_in_brackets(capsys: pytest.CaptureFixture[str]) -> None:
    """As browsers and ``ss`` write it; a message crosses."""
    assert address("[::1]:7999") == address("::1:7999") == ("::1", 7999)
    assert address("base:7410") == ("base", 7410) and host_port("::1", 7) == "[::1]:7" and host_port("a", 7) == "a:7"
    with receiver(capsys, host="[::1]") as place:
        assert place.startswith("[::1]:") and main(["live", "send", place, *FAST]) == 0
    assert "30 received" in capsys.readouterr().out
    for wrong in ("[::1]", "[base]:1", "[::1:7999", "[::1]:", "base:७"):
        fails(["live", "send", wrong], f"{wrong if wrong.isascii() else 'base:'}", capsys)


def test_mistakes_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    fails(["live", "send", "robot"], "robot: must be HOST:PORT", capsys)
    link = ["live", "link", "--trace", "lte-synthetic-0"]
    fails([*link, "--to", "robot:99999"], "robot:99999: must be HOST:PORT", capsys)
    fails(["live", "view", "none.mcap"], "none.mcap: No such file", capsys)


def story() -> Bench:
    """Six puts, a tenth of a second apart, into a queue of two behind a socket that one message leaves at 0.65 s."""
    bench = Bench("drop-oldest", 2, value=qoi.exponential(0.5))
    for k in range(6):
        bench.put(100_000 * (k + 1), 12_500)
        if k == 0:
            bench.take()
    bench.gone(650_000)
    return bench


def numbers(text: str) -> dict[str, list[float]]:
    """The numbers of each line, by its first word."""
    lines = [line.split(maxsplit=1) for line in text.splitlines() if line[:1].isalpha()]
    return {first: [float(n) for n in re.findall(r"\d+(?:\.\d+)?", rest)] for first, rest in lines}


def test_a_log_by_hand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """0 is sent; 1, 2 and 3 are dropped as the oldest of three; 4 goes to the socket, 5 stays: for 50 ms so far.

    How many, in a second, Mbit/s; of the queue how old its oldest is. Rates fall as time goes on, and bars stay.
    """
    records = story().records
    text = View(records).text()
    found = numbers(text)
    assert (
        found["socket"] == [1] and found["put"] == [6, 6, 0.6] and found["left"][-1] == 0.1 and found["QoI"] == [1, 0]
    )
    assert found["dropped"] == [3, 3, 0.3, 3] and "[#.]   the oldest 0.05 s" in text
    for cut in range(1, len(records)):  # wherever a log breaks off
        View(records[:cut]).text()
    with LogFile(tmp_path / "log.mcap") as file:
        for record in records:
            file(record)
    assert main(["live", "view", str(tmp_path / "log.mcap")]) == 0
    assert text in capsys.readouterr().out
    view = View(records)
    assert numbers(view.text(1_250_001))["put"] == [6, 4, 0.4]  # those after 0.25 s
    last = view.text(3_000_000)
    assert numbers(last)["put"] == [6, 0, 0] and last.endswith("█   |")  # 3 s later
