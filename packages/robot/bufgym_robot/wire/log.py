"""Log of a live queue's events, with enough detail to repeat every decision in the simulator.

A record is a small dictionary with its time, ``us``. In a file it is a JSON message of an MCAP recording, on the
channel of its event:

    settings  policy, parameters, capacity, max_bytes, v, decide_at, topics, window, ends_us
    put       seq, size_bytes, x, topic, uniform, carried: bytes that the link had carried by then
    dequeued  seq: the socket took it
    gone      seq, carried: the link has carried it
    dropped   seq, why: rejected, evicted for another, limited, dropped at the head
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np

from bufgym.model.qoi import Value
from bufgym.model.topics import Topic
from bufgym.policies.registry import Policy
from bufgym.utils.errors import BufgymError
from bufgym_robot.wire.mcap_file import McapFile

Record = dict[str, Any]

EVENTS: Final = ("settings", "put", "dequeued", "gone", "dropped")
MAX_RECORD_BYTES: Final = 2**20


def settings(policy: Policy, capacity: int, value: Value, *, topics: Sequence[Topic], **rules: Any) -> Record:
    """Make the first record of a log, with all settings of the queue; V is stored as its exact numbers.

    ``rules`` are ``max_bytes``, ``decide_at``, ``window`` and ``ends_us``.
    """
    values = [None if topic.value is None else _numbers(topic.value) for topic in topics]
    described = [{**asdict(topic), "value": v} for topic, v in zip(topics, values, strict=True)]
    ruling = {"policy": policy.name, "parameters": dict(policy.parameters), "capacity": int(capacity)}
    return {"event": "settings", "us": 0, **ruling, "v": _numbers(value), "topics": described, **rules}


def _numbers(value: Value) -> Record:
    return {"name": value.name, "numbers": value.array.tolist()}


def value_of(v: Record) -> Value:
    """Restore V from the record that ``settings`` made."""
    return Value(v["name"], np.array(v["numbers"], np.float64))


class LogFile(McapFile):
    """A log in an MCAP file; call it with each record, then close it. A log that was not closed can also be read."""

    def __call__(self, record: Record) -> None:
        """Write one record."""
        now_ns = record["us"] * 1000
        self.write(f"/{record['event']}", json.dumps(record).encode(), now_ns, now_ns, schema="bufgym.live.Record")


def read_log(path: str | Path) -> list[Record]:
    """Read the records of a log file, which may be cut short: MCAP, or a record of JSON in each line (``.jsonl``).

    Raises:
        BufgymError: there is no such file, it is not MCAP, or a record is not one of ``EVENTS``.
    """
    from mcap.records import Message
    from mcap.stream_reader import StreamReader

    records: list[Record] = []
    try:
        if Path(path).suffix == ".jsonl":
            lines = Path(path).read_bytes().split(b"\n")
            return _begun(path, [_record(path, k, line) for k, line in enumerate(lines[:-1])])
        with Path(path).open("rb") as file:
            for entry in StreamReader(file, record_size_limit=MAX_RECORD_BYTES).records:
                if isinstance(entry, Message):
                    records.append(_record(path, len(records), entry.data))
    except OSError as error:
        raise BufgymError(f"{path}: {error.strerror or error}") from None
    except BufgymError:
        raise
    except Exception as error:  # mcap raises many kinds of errors at the end of a cut file
        if not records:
            raise BufgymError(f"{path}: no log of a live queue: {type(error).__name__}") from None
    return _begun(path, records)


def _begun(path: str | Path, records: list[Record]) -> list[Record]:
    if not records or records[0]["event"] != "settings":
        raise BufgymError(f"{path}: must begin with the settings of a live queue")
    return records


def _record(path: str | Path, k: int, data: bytes) -> Record:
    try:
        record = json.loads(data)
    except ValueError:
        record = None
    if not isinstance(record, dict) or record.get("event") not in EVENTS or not isinstance(record.get("us"), int):
        raise BufgymError(f"{path}, record {k}: must be an event of a live queue at a time")
    return record


def of(records: Sequence[Record], event: str) -> Iterator[Record]:
    """Select the records of one event."""
    return (record for record in records if record["event"] == event)
