"""A relay's counts as OpenMetrics text, for Prometheus and what reads its format."""

from collections.abc import Mapping
from types import SimpleNamespace

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.openmetrics.exposition import CONTENT_TYPE_LATEST as CONTENT_TYPE
from prometheus_client.openmetrics.exposition import generate_latest

__all__ = ["CONTENT_TYPE", "text"]
_NOW = {"connections": "Connections that have said hello.", "held": "No_drop messages that receivers have not acked."}
_SO_FAR = {
    "received": "Messages taken from clients.",
    "sent": "Messages sent to clients.",
    "dropped": "Messages that a receiver's policy dropped.",
}


def text(status: Mapping[str, int], refusals: Mapping[str, int]) -> bytes:
    """Write the counts of ``Hub.status``, and how often each code was refused."""
    refused = CounterMetricFamily("bufgym_relay_refused", "Refusals, also those beyond a quota.", labels=["code"])
    for code, times in sorted(refusals.items()):
        refused.add_metric([code], times)
    now = [GaugeMetricFamily(f"bufgym_relay_{name}", about, status[name]) for name, about in _NOW.items()]
    so_far = [CounterMetricFamily(f"bufgym_relay_{name}", about, status[name]) for name, about in _SO_FAR.items()]
    counts = SimpleNamespace(collect=lambda: [*now, *so_far, refused])
    return bytes(generate_latest(counts))  # type: ignore[no-untyped-call]
