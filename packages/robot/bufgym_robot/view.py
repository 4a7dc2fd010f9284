"""Text view of a live queue, made from its log's records as they happen or from a log file."""

from collections import Counter, deque
from collections.abc import Iterable
from typing import Final

from bufgym_robot.wire.log import Record, value_of

RATE_US: Final = 1_000_000  # Time before now over which rates are computed
HISTORY_S: Final = 60
_BARS: Final = " ▁▂▃▄▅▆▇█"


class View:
    """View of a queue. Call it with each record, as a queue calls its log; ``text`` shows the state."""

    def __init__(self, records: Iterable[Record] = ()) -> None:
        self.now_us = 0
        """Time of the latest record."""
        self._settings: Record = {"policy": "?", "capacity": 1, "topics": []}
        self._held: dict[int, Record] = {}  # put records of queued messages, the oldest first
        self._away: dict[int, Record] = {}  # put records of messages in the socket
        self._counts: Counter[str] = Counter()
        self._why: Counter[str] = Counter()
        self._lately: deque[tuple[int, str, int]] = deque()  # (time, event, bytes)
        self._xs: list[float] = []  # x of departed messages
        self._longest: deque[int] = deque([0], HISTORY_S)  # most messages queued, in each second
        self._left_bytes: deque[int] = deque([0], HISTORY_S)  # in each second
        self._second = 0
        for record in records:
            self(record)

    def __call__(self, record: Record) -> None:
        """Take one record."""
        event, seq = record["event"], record.get("seq", -1)
        if event == "settings":
            self._settings = record
            return
        self._reach(record["us"])
        put = record
        if event == "put":
            self._held[seq] = record
        elif event == "dequeued":
            put = self._away[seq] = self._held.pop(seq)
        elif event == "gone":
            put = self._away.pop(seq)
            self._xs.append(put["x"])
            self._left_bytes[-1] += put["size_bytes"]
        else:
            put = self._held.pop(seq)
            self._why["evicted" if record["why"].startswith("evicted") else record["why"]] += 1
        self._counts[event] += 1
        self._lately.append((self.now_us, event, put["size_bytes"]))
        # Between two records a newcomer may stand beside the dropped message that it replaces.
        self._longest[-1] = max(self._longest[-1], min(len(self._held), self._settings["capacity"]))

    def _reach(self, now_us: int) -> None:
        """Advance the time."""
        self.now_us = max(self.now_us, now_us)
        while self._second < self.now_us // 10**6:
            self._second += 1
            self._longest.append(len(self._held))
            self._left_bytes.append(0)

    def text(self, now_us: int | None = None) -> str:
        """Show the state at ``now_us`` of the queue's clock, by default the time of the last record."""
        if now_us is not None:
            self._reach(now_us)
        while self._lately and self._lately[0][0] <= self.now_us - RATE_US:
            self._lately.popleft()
        made, capacity = self._settings, self._settings["capacity"]
        queued = min(len(self._held), capacity)
        oldest = next(iter(self._held.values()), None)
        age = "" if oldest is None else f"   the oldest {(self.now_us - oldest['us']) / 1e6:.2f} s"
        why = ", ".join(f"{count} {word}" for word, count in sorted(self._why.items()))
        lines = [
            f"{made['policy']}, L = {capacity}{f', {n} topics' if (n := len(made['topics'])) else ''}"
            f"   {self.now_us / 1e6:.1f} s",
            "",
            f"queue    {queued:6d}   [{'#' * queued}{'.' * (capacity - queued)}]{age}",
            f"socket   {len(self._away):6d}",
            f"put      {self._counts['put']:6d}   {self._rates('put')}",
            f"left     {self._counts['gone']:6d}   {self._rates('gone')}",
            f"dropped  {self._counts['dropped']:6d}   {self._rates('dropped')}{f'   {why}' if why else ''}",
        ]
        if self._xs and not made["topics"]:
            gap = max((after - before for before, after in zip(self._xs, self._xs[1:], strict=False)), default=0.0)
            qoi = value_of(made["v"]).information(self._xs)
            lines.append(f"QoI      {qoi:6.1f}   of what has left   the longest gap {gap:.3g}")
        peak = max(self._left_bytes)
        lines += ["", f"queue, 0 to {capacity}, a second a bar, now on the right", _bars(self._longest, capacity)]
        return "\n".join([*lines, f"left, 0 to {peak * 8e-6:.1f} Mbit/s", _bars(self._left_bytes, peak)])

    def _rates(self, event: str) -> str:
        sizes = [size for _, other, size in self._lately if other == event]
        return f"{len(sizes) * 1e6 / RATE_US:5.0f} /s {sum(sizes) * 8 / RATE_US:7.1f} Mbit/s"


def _bars(numbers: Iterable[int], most: int) -> str:
    """Draw a character for each number, between two lines; any number above 0 is visible."""
    steps = len(_BARS) - 1
    drawn = "".join(_BARS[min(steps, -(-number * steps // most)) if most else 0] for number in numbers)
    return f"|{drawn:>{HISTORY_S}}|"
