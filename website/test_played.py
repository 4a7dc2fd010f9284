"""The picture of a recording that was played is drawn from the file that bench writes."""

from pathlib import Path

import pytest
from cli_cases import shown
from needs import needs
from recording_cases import ODD_FILES

from bufgym.traces import read_workload
from website import played


def test_each_message_is_delivered_or_dropped_and_the_queue_never_holds_more_than_it_may(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for library in ("matplotlib", "mcap"):
        pytest.importorskip(library, reason=needs("extras", library))
    recording, file = ODD_FILES / "good.mcap", tmp_path / "played.mcap"
    link = ["--trace", "2kbit/s", "--policies", "afr,drop-oldest", "--capacity", "3", "--no-bound"]
    shown(["bench", "--workload", recording, *link, "--mcap", file], capsys)
    found = played.series(file)
    assert list(found) == ["afr", "drop-oldest"]
    for parts in found.values():
        assert min(len(parts["delivered"]), len(parts["dropped"])) > 0
        assert len(parts["delivered"]) + len(parts["dropped"]) == len(read_workload(recording))
        assert [value for _, value in parts["delivered"]] == [*range(1, len(parts["delivered"]) + 1)]
        assert max(length for _, length in parts["queue"]) == 3 and parts["queue"][-1][1] == 0
    played.draw(tmp_path / "drawn.png", found, 0, 5)
    assert (tmp_path / "drawn.png").read_bytes().startswith(b"\x89PNG")
