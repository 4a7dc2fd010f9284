"""Clients from configurations: Robofleet's example client, and TOML files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from bufgym.ground.errors import BufgymError
from bufgym.ground.files import check_keys, read_toml
from bufgym.model import qoi
from bufgym.model.topics import Topic
from bufgym.scenario.client import Client, Stream
from bufgym.scenario.draws import shipped


def robofleet_example() -> tuple[Stream, ...]:
    """The topics of Robofleet's example client configuration.

    Priorities and rate limits are the example's: localization 10 Hz, priority 20; odometry 15 Hz, 20; laser scans 15
    Hz, 2; point cloud and images 10 Hz, 1; visualization 10 Hz, 2; status 1 Hz; subscriptions no_drop. The rest is
    assumed. Publish rates are common drivers' rates. Sizes come from the paper's Table I or from encoding such
    messages. Deadlines and the meaning of x are our choice.
    """
    fast = qoi.exponential(0.618)
    view = qoi.exponential(math.exp(-1))

    def stream(
        name: str, hz: float, size: int, ros: int, json: int, *, moves: bool = False, cv: float = 0.0, **topic: Any
    ) -> Stream:
        rules = Topic(name, value=view if moves else fast, **topic)
        return Stream(rules, hz, size, size_cv=cv, moves=moves, encodings={"ros": ros, "json": json})

    return (
        stream("localization", 20, 240, 75, 318, priority=20, rate_limit_hz=10, deadline_s=0.25),
        stream("odometry", 40, 960, 713, 1_084, priority=20, rate_limit_hz=15, deadline_s=0.25),
        stream("scan", 15, 7_328, 7_260, 28_000, priority=2, rate_limit_hz=15, deadline_s=0.5),
        stream("visualization", 10, 15_000, 14_800, 53_000, priority=2, rate_limit_hz=10, cv=0.5, deadline_s=1.0),
        stream("pointcloud", 10, 160_344, 160_111, 562_376, moves=True, rate_limit_hz=10, deadline_s=1.0),
        stream("image", 30, 75_224, 75_188, 267_650, moves=True, rate_limit_hz=10, cv=0.2, deadline_s=1.0),
        stream("status", 1, 156, 42, 162),
        stream("subscriptions", 1, 600, 500, 1_200, no_drop=True),
    )


def client_over_lte() -> Client:
    """The example client over the shipped synthetic LTE links at a quarter of their capacity."""
    return Client(robofleet_example(), **shipped(), scale=0.25)


_TOPIC_KEYS = {f.name for f in fields(Topic)} - {"value"}
_STREAM_KEYS = {"rate_hz", "size_bytes", "jitter", "size_cv", "moves"}
_CLIENT_KEYS = {"window", "propagation_us", "round_trip_us", "consumers", "duration_s"}


def read_client(path: str | Path, **parameters: Any) -> Client:
    """Read a client from a TOML file with ``[[topic]]`` tables for ``Topic`` and ``Stream``, ``window`` and the like.

    A topic's ``value`` has the form of the command line (``"exponential:0.618"``). Its sizes in other encodings look
    like ``encodings = {json = 28000}``. ``parameters`` add settings that the file lacks, such as ``traces`` and
    ``motion``. Without ``traces`` the client gets the shipped LTE links and motions, as in ``bufgym topics --config``.

    Raises BufgymError, one line that names the file, for a file that can't be read or breaks a rule.
    """
    try:
        settings = read_toml(path)
        tables = settings.pop("topic", [])
        check_keys(settings, _CLIENT_KEYS, "topic, ")
        if not isinstance(tables, list) or not tables:
            raise BufgymError("needs at least one [[topic]]")
        recordings = {} if "traces" in parameters else shipped()
        return Client(tuple(map(_stream, tables)), **{**settings, **recordings, **parameters})
    except BufgymError as error:
        raise error if str(error).startswith(f"{path}") else BufgymError(f"{path}: {error}") from None


def _stream(table: Any) -> Stream:
    if not isinstance(table, Mapping):
        raise BufgymError(f"topic = {table!r}: must be a [[topic]] table")
    topic = {key: table[key] for key in table if key in _TOPIC_KEYS}
    encodings = table.get("encodings", {})
    try:
        check_keys(table, _TOPIC_KEYS | _STREAM_KEYS | {"value", "encodings"})
        for key in ("name", "rate_hz", "size_bytes"):
            if key not in table:
                raise BufgymError(f"{key} is missing")
        if "value" in table:
            topic["value"] = qoi.parse(str(table["value"]))
        if not isinstance(encodings, Mapping):
            raise BufgymError(f"encodings = {encodings!r}: must be a table of bytes by encoding")
    except BufgymError as error:
        raise BufgymError(f"topic {table.get('name', 'without a name')!r}: {error}") from None
    return Stream(Topic(**topic), encodings=encodings, **{key: table[key] for key in table if key in _STREAM_KEYS})
