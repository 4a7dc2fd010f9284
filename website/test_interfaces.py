"""The picture of the two interfaces shows the candidates that the environment names."""

from pathlib import Path

import pytest
from needs import needs

from website import interfaces


def test_the_two_smallest_merged_gaps_and_the_head_are_the_actions(tmp_path: Path) -> None:
    """Slot 3 leaves 3.7 - 2.8 = 0.9 and slot 6 leaves 6.2 - 4.9 = 1.3; the head, slot 0, leaves 1.6."""
    pytest.importorskip("matplotlib", reason=needs("extras", "matplotlib"))
    assert interfaces.candidates().tolist() == [3, 6, 0]
    interfaces.draw(tmp_path / "drawn.svg")
    drawn = (tmp_path / "drawn.svg").read_text()
    assert [f"gap left {gap}" in drawn for gap in (0.9, 1.3, 1.6, 2)] == [True, True, True, False]
    # Three actions above, ten below.
    assert drawn.count(">evict<") == interfaces.L and drawn.count(">head<") == 1
