"""``bufgym live view``: what it says of a log, by hand."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from live_cases import Bench
from test_command import free_port

from bufgym.cli import main
from bufgym.live import LogFile
from bufgym.live.view import View
from bufgym.model import qoi


def story() -> Bench:
    """Six puts, a tenth of a second apart, into a queue of two behind a socket that one message leaves at 0.65 s."""
    bench = Bench("drop-oldest", 2, value=qoi.exponential(0.5))
    for k in range(6):
        bench.put(100_000 * (k + 1), 12_500)
        if k == 0:
            bench.take()
    bench.gone(650_000)
    return bench


def test_a_log_by_hand() -> None:
    """0 is sent; 1, 2 and 3 are dropped as the oldest of three; 4 goes to the socket, 5 stays: for 50 ms so far."""
    lines = View(story().records).text().splitlines()
    assert lines[0] == "drop-oldest, L = 2   0.7 s"  # 0.65 s
    assert lines[2] == "queue         1   [#.]   the oldest 0.05 s"
    assert lines[3] == "socket        1"
    assert lines[4] == "put           6       6 /s     0.6 Mbit/s"
    assert lines[5] == "left          1       1 /s     0.1 Mbit/s"
    assert lines[6] == "dropped       3       3 /s     0.3 Mbit/s   3 evicted"
    assert lines[7] == "QoI         1.0   of what has left   the longest gap 0"
    assert lines[-1].endswith("█|") and len(lines[-1]) == 62


def test_rates_fall_as_time_goes_on_and_bars_stay() -> None:
    view = View(story().records)
    assert view.text(1_250_001).splitlines()[4] == "put           6       4 /s     0.4 Mbit/s"  # those after 0.25 s
    last = view.text(3_000_000).splitlines()
    assert last[4] == "put           6       0 /s     0.0 Mbit/s"
    assert last[-1].endswith("█   |")  # 3 s later


@pytest.mark.parametrize("cut", range(1, 20))
def test_a_log_that_breaks_off(cut: int) -> None:
    View(story().records[:cut]).text()


def test_the_command_shows_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "log.mcap"
    with LogFile(log) as file:
        for record in story().records:
            file(record)
    assert main(["live", "view", str(log)]) == 0
    assert "dropped       3" in capsys.readouterr().out
    assert main(["live", "view", str(tmp_path / "none.mcap")]) == 2
    assert "none.mcap: No such file" in capsys.readouterr().err


def test_send_shows_it_as_it_happens(capsys: pytest.CaptureFixture[str]) -> None:
    port = str(free_port())
    receiving = threading.Thread(
        target=main, args=(["live", "receive", "--port", port, "--messages", "30"],), daemon=True
    )
    receiving.start()
    assert main(["live", "send", f"127.0.0.1:{port}", "--size", "1000", "--duration", "1", "--view"]) == 0
    receiving.join(30)
    out = capsys.readouterr().out
    assert out.count("afr, L = 8") >= 4 and "left         30" in out
