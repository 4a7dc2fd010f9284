"""Reader of the JSON of iperf3.

Checked on the WiFi measurements of an industrial robot in a shipyard,
github.com/minarady1/wifi_for_industrial_robotics.

A test in both directions (``--bidir``) has two sums an interval. Since version 3.11 the second one is named
``sum_bidir_reverse``; versions 3.7 to 3.10 write the name ``sum`` twice. ``sender`` says which one this side sent.
"""

from collections.abc import Iterator
from typing import Any, Final

from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.intervals import MAX_INTERVAL_BYTES, Intervals, Knots
from bufgym.traces.formats.logs import json_items, json_number, read_json_values
from bufgym.traces.formats.text import Line
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S

DIRECTIONS: Final = ("upload", "download")  # Values of `column`: from the client to the server, and back
_OTHER: Final = "_bidir_reverse"
# Of one interval to the next; both are the same clock, written with six decimals.
_MAX_STEP_S: Final = 1e-3


def read_iperf3(path: StrPath, column: str | None = None) -> Knots:
    """The JSON of `iperf3 --json`: `intervals[].sum` with `start`, `end`, `bytes`; or of `--json-stream`, where each
    interval is an event on a line of its own. Intervals that iperf3 omitted from its own result are left out. The note
    says on which side it was measured: the sender counts what went into its socket, the receiver what came out.

    ``column`` chooses one of `DIRECTIONS` in a test of both, by default the upload. Over UDP the sender counts what was
    lost, too. So its numbers are read only where nothing was, else those of the receiver if they are in the file.
    """
    report = _report(path)
    if not isinstance(report, dict) or not isinstance(report.get("intervals"), list):
        raise fault(path, "must be an object with a list of intervals, as iperf3 --json writes it")
    if report.get("error"):
        raise fault(path, "must be a run that succeeded", value=str(report["error"])[:60], field="error")
    both = any(isinstance(item, dict) and f"sum{_OTHER}" in item for item in report["intervals"])
    if column is not None and not both:
        raise fault(path, f"holds one direction only: {column} can be chosen in a test with --bidir")
    direction = (column or DIRECTIONS[0]) if both else ""
    name, sends = _sum(path, report, direction) if both else ("sum", None)
    if sends is None:
        sends = any(measured.get("sender") for _, measured in _measured(path, report, name))
    note = f", {direction} of a test in both directions" if both else ""
    if sends and _is_udp(report, name):
        lost_percent = _lost_percent(report, name.removeprefix("sum"))
        if lost_percent != 0:
            received = report.get("server_output_json")
            if not isinstance(received, dict) or not isinstance(received.get("intervals"), list) or both:
                how_much = "an unknown part" if lost_percent is None else f"{lost_percent:g} %"
                rule = "must be the receiver's JSON (iperf3 --server --json), or have it (--get-server-output)"
                raise fault(path, f"measured over UDP by the sender, which counts what was lost, {how_much}: {rule}")
            report, note = received, f", UDP, {lost_percent or 0:g} % lost"
    return _knots(path, report, name, note)


def _knots(path: StrPath, report: dict[str, Any], name: str, note: str) -> Knots:
    """The capacity by the sums of this name."""
    intervals, sides, previous_s = Intervals(), set[str](), None
    for line, measured in _measured(path, report, name):
        if measured.get("omitted"):
            continue
        start_s, end_s = (float(json_number(line, measured, edge, MAX_DURATION_S)) for edge in ("start", "end"))
        count = json_number(line, measured, "bytes", MAX_INTERVAL_BYTES)
        if not isinstance(count, int):
            raise line.error(count, "must be a whole number", "bytes")
        if previous_s is not None and abs(start_s - previous_s) > _MAX_STEP_S:
            raise line.error(start_s, f"must begin where the interval above ended ({previous_s:g} s)", "start")
        length_us = round(end_s * US_PER_S) - round((start_s if previous_s is None else previous_s) * US_PER_S)
        if length_us <= 0:
            raise line.error(end_s, f"must be after its start ({start_s:g} s)", "end")
        intervals.add(length_us, count)
        sides.add("sender" if measured.get("sender") else "receiver")
        previous_s = end_s
    return intervals.knots(path, f"measured by the {' and the '.join(sorted(sides)) or 'nobody'}{note}")


def _measured(path: StrPath, report: dict[str, Any], name: str) -> Iterator[tuple[Line, dict[str, Any]]]:
    """The sum of this name in each interval, with its place."""
    for line, item in json_items(path, report["intervals"]):
        measured = item.get(name) if isinstance(item, dict) else None
        if not isinstance(measured, dict):
            raise line.error(line.text, f"must hold {name}, an object")
        yield line, measured


def _sum(path: StrPath, report: dict[str, Any], direction: str) -> tuple[str, bool]:
    """Name of the sum of this direction in a test of both, and whether this side sent it."""
    begun = report.get("start")
    is_server = isinstance(begun, dict) and "accepted_connection" in begun
    sends = (direction == DIRECTIONS[0]) != is_server
    names = ("sum", f"sum{_OTHER}")
    senders = [{bool(measured.get("sender")) for _, measured in _measured(path, report, name)} for name in names]
    if senders not in ([{True}, {False}], [{False}, {True}]):
        raise fault(path, "holds two directions (--bidir): sender must say of each sum whether this side sent it")
    return names[senders.index({sends})], sends


def _is_udp(report: dict[str, Any], name: str) -> bool:
    """Whether the test ran over UDP, by what it says of itself or, where its start is missing, by its packets."""
    test = report["start"].get("test_start") if isinstance(report.get("start"), dict) else None
    if isinstance(test, dict) and "protocol" in test:
        return str(test["protocol"]).upper() == "UDP"
    return any(isinstance(item, dict) and "packets" in (item.get(name) or {}) for item in report["intervals"])


def _lost_percent(report: dict[str, Any], suffix: str) -> float | None:
    """Largest share of packets lost that the end tells of a direction; None where it tells none."""
    end = report.get("end")
    sums = [end.get(f"{name}{suffix}") for name in ("sum", "sum_received")] if isinstance(end, dict) else []
    lost_percent = [one.get("lost_percent") for one in sums if isinstance(one, dict)]
    return max((float(value) for value in lost_percent if isinstance(value, int | float)), default=None)


def _report(path: StrPath) -> Any:
    """The object that `iperf3 --json` writes, also from the events of `--json-stream`."""
    values = read_json_values(path, _members)
    if not any(isinstance(value, dict) and "event" in value for value in values):
        return values[0] if len(values) == 1 else values
    by_event: dict[Any, list[Any]] = {}
    for value in values:
        if isinstance(value, dict):
            by_event.setdefault(str(value.get("event")), []).append(value.get("data"))
    first = {event: (by_event.get(event) or [None])[0] for event in ("start", "end", "error", "server_output_json")}
    return {"intervals": by_event.get("interval", []), **first}


def _members(members: list[tuple[str, Any]]) -> dict[str, Any]:
    """The object with these members; the second one of a name is that of the other direction."""
    item: dict[str, Any] = {}
    for name, value in members:
        own = f"{name}{_OTHER}" if name in item else name
        if own in item:
            raise ValueError(f"an object holds {name!r} more than twice: must hold one for each direction")
        item[own] = value
    return item
