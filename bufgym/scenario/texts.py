"""Words that scenarios describe themselves with (``about``)."""

from collections.abc import Sequence
from typing import Any

from bufgym.traces import Motion, Trace
from bufgym.utils.errors import printable


def first_and_last(names: Sequence[str]) -> str:
    """Up to three names, or the first and the last."""
    return printable(", ".join(names) if len(names) <= 3 else f"{names[0]} .. {names[-1]}")


def links_by_name(traces: Sequence[Trace], scale: float = 1.0) -> str:
    """The links by name, and the factor on their capacity."""
    return first_and_last([trace.name for trace in traces]) + (f" x {scale:g}" if scale != 1 else "")


def motions_by_name(motions: Sequence[Motion]) -> str:
    """The recordings of motion by name, with the gaps in them."""
    gaps = [f" (gaps bridged: {len(m.gaps)}, the longest {m.longest_gap_s:.1f} s)" if m.gaps else "" for m in motions]
    return first_and_last([m.name + bridged for m, bridged in zip(motions, gaps, strict=True)])


def how_rated(scenario: Any) -> str:
    """How the episodes of one queue are rated."""
    return f"QoI = 1 + sum of V(step in x) over the messages received; V = {printable(scenario.value.name)}."


def doubts(scenario: Any) -> list[str]:
    """A line for each doubt about a recording that the scenario plays."""
    scenario = getattr(scenario, "uplink", scenario)
    played = [*getattr(scenario, "traces", ()), *getattr(scenario, "motion", ()), getattr(scenario, "workload", None)]
    return [f"warning: {doubt}" for one in played if one is not None for doubt in one.sheet.doubts]
