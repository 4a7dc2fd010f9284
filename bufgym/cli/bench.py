"""``bufgym bench``: policies side by side on the same episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter

from bufgym.cli.options import (
    RESULTS,
    WHO,
    Count,
    OutOptions,
    SuiteOptions,
    WhoOptions,
    given,
    load_policies,
    loaded,
    refuse,
)
from bufgym.cli.scenarios import InterruptionOptions, OwnOptions, ScenarioOptions, StreamOptions, WorkloadOptions
from bufgym.cli.suite import run_suite
from bufgym.ground.errors import BufgymError
from bufgym.ground.files import replaced

if TYPE_CHECKING:
    from bufgym.policies import Policy
    from bufgym.scenario import Scenario


@Parameter(name="*", group=Group.create_ordered("How the buffer decides"))
@dataclass(frozen=True)
class BufferOptions:
    max_bytes: Count | None = None
    """Also at most so many bytes queued (default: no limit)."""
    decide_at: Literal["arrival", "overflow"] | None = None
    """Ask at every arrival (default), or when full."""


def bench(
    *,
    suite: SuiteOptions = SuiteOptions(),
    who: WhoOptions = WhoOptions(),
    stream: StreamOptions = StreamOptions(),
    workload: WorkloadOptions = WorkloadOptions(),
    interruption: InterruptionOptions = InterruptionOptions(),
    own: OwnOptions = OwnOptions(),
    buffer: BufferOptions = BufferOptions(),
    out: OutOptions = OutOptions(),
    against: Annotated[str | None, Parameter(group=WHO)] = None,
    drops: Annotated[str | None, Parameter(group=RESULTS)] = None,
) -> None:
    """Run policies side by side on the same episodes.

    Args:
        against: Compare every policy with this one, by the paired difference of their shares of AFR's regret.
        drops: With --workload: write each message that each policy dropped to this CSV file.
    """
    load_policies(who.policy_file)
    scenario = ScenarioOptions(stream, workload, interruption, own)
    if suite.suite is not None:
        frozen = scenario.given() | given(buffer) | ({} if drops is None else {"drops": drops})
        refuse(frozen, "cannot go with --suite: a suite's episodes are frozen")
        run_suite("bench", suite, who, out, against=against or "")
        return
    refuse(given(suite), "needs --suite")
    if out.file() is not None:
        raise BufgymError(f"--out {out.out}: without --suite it must be a folder")
    if drops is not None and workload.workload is None:
        raise BufgymError("--drops needs --workload")
    _bench(scenario, who, buffer, out, drops, against)


def _bench(
    options: ScenarioOptions,
    who: WhoOptions,
    buffer: BufferOptions,
    out: OutOptions,
    drops: str | None,
    against: str | None,
) -> None:
    """Run the scenario that the options describe."""
    from bufgym import policies
    from bufgym.benchmark import rows as files
    from bufgym.benchmark import table
    from bufgym.benchmark.compare import compare

    recorded = options.workload.workload is not None
    decide_at = buffer.decide_at or "arrival"
    specs = loaded(who.policies)[0]
    chosen = [policies.get(spec) for spec in specs or policies.names(for_topics=False)]
    if decide_at == "overflow" and not specs:
        chosen = [policy for policy in chosen if policy.privileged is None]  # see QueueTask.check
    stream, about = options.scenario(who.seeds)
    folder = None if out.out is None else Path(out.out)
    if folder is not None:
        # Before the long work, so that an impossible folder is reported at once.
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / "manifest.json").exists():
            raise BufgymError(
                f"{folder}: holds the run of a suite; choose another --out (its rows are never written over)"
            )
    capacity, seeds = list(who.capacity or (8,)), who.seeds or (1 if recorded else 10)
    settings: dict[str, Any] = {"max_bytes": buffer.max_bytes, "decide_at": decide_at}
    done = compare(chosen, stream, capacity=capacity, seeds=seeds, about=about, against=against, **settings)
    bounds = _bound_notes(done.rows, stream, decide_at) if recorded else []
    print("\n".join([str(done), *bounds]))
    if recorded:
        order = list(dict.fromkeys(entry["policy"] for entry in table.means(done.rows, alone=done.unranked)))
        _dropped(chosen, stream, capacity, seeds, settings, order, drops)
    if folder is not None:
        form = out.format or ("parquet" if files.has_pyarrow() else "csv")
        written = files.write_rows(done.rows, folder / f"rows.{form}")
        with replaced(folder / "table.md") as temporary:
            text = "\n".join([f"{about}\n\n{done.markdown}", *([""] if bounds else []), *bounds])
            temporary.write_text(text + "\n", encoding="utf-8")
        print(f"\n{len(done.rows)} rows in {written}, this table in {folder / 'table.md'}")


def _bound_notes(rows: Sequence[Mapping[str, Any]], stream: Scenario, decide_at: str) -> list[str]:
    """State the clairvoyant's result on a recording, and whether it is exact."""
    sizes = getattr(stream, "workload").size_bytes  # noqa: B009  (only an uplink has one)
    why = "message sizes differ" if sizes.min() < sizes.max() else f"decisions are asked at {decide_at}"
    notes = []
    for capacity in dict.fromkeys(row["capacity"] for row in rows):
        episodes = {(row["trace"], row["seed"]): row for row in rows if row["capacity"] == capacity}.values()
        most = sum(row["clairvoyant"] for row in episodes) / len(episodes)
        exact = all(row["certified"] for row in episodes)
        what = f"is {most:.3f}" if exact else f"is at most {most:.3f}, an upper bound, as {why}"
        notes.append(f"note: L = {capacity}: the clairvoyant's QoI {what}; regret is measured against it")
    if any(row["policy"] == "clairvoyant" and not row["certified"] for row in rows):
        notes.append("note: the row clairvoyant follows a plan for which there is not always room: less than its bound")
    return notes


def _dropped(
    chosen: Sequence[Policy],
    stream: Scenario,
    capacity: list[int],
    seeds: int,
    settings: dict[str, Any],
    order: Sequence[str],
    file: str | None,
) -> None:
    """Print drops by topic if there are several, with policies in ``order``, and write each drop to ``file``."""
    from bufgym.benchmark import drops
    from bufgym.scenario import Uplink

    assert isinstance(stream, Uplink) and stream.workload is not None
    several = len(stream.workload.summary()) > 1
    if not several and file is None:
        return
    messages = drops.drops(chosen, stream, capacity, seeds, **settings)
    counts = drops.write_drops(messages, None if file is None else Path(file))
    if several and counts:
        print("\n" + drops.by_topic(counts, stream, order, seeds * len(stream.traces)))
    if file is not None:
        print(f"\n{counts.total()} dropped messages in {file}")
