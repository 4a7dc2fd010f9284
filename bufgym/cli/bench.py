"""``bufgym bench``: policies side by side on the same episodes."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bufgym.cli.options import Commands, command, count, load_policies, loaded, refuse
from bufgym.cli.scenarios import OWN, scenario, scenario_options
from bufgym.cli.suite import SUITE_OPTIONS, out_options, run_suite, suite_options, target, who_options
from bufgym.cli.trace_bags import WORKLOAD_OPTIONS
from bufgym.ground.errors import BufgymError
from bufgym.ground.files import replaced

if TYPE_CHECKING:
    from bufgym.policies import Policy
    from bufgym.scenario import Scenario


def add(commands: Commands) -> None:
    bench = command(commands, "bench", _bench, "run policies side by side on the same episodes")
    suite_options(bench)
    who_options(bench, "all", "default: 8, or the suite's", "default: 10, or the suite's; a recording: 1")
    scenario_options(bench)
    option = bench.add_argument_group("how the buffer decides").add_argument
    option("--max-bytes", type=count, metavar="B", help="also at most B bytes queued (default: no limit)")
    option("--decide-at", choices=("arrival", "overflow"), help="ask at every arrival (default), or when full")
    out = out_options(bench)
    out.add_argument("--drops", metavar="OUT.csv", help="with --workload: write each message that each policy dropped")


_FROZEN = (
    *("max_bytes", "decide_at", "interruption", "trace", "motion", "fps", "bytes", "size_cv", "seconds", "jitter"),
    *("scale", "value", "law", "t_min", "t_max", "t_mean", "workload", "drops", *WORKLOAD_OPTIONS, *OWN),
)
"""Options that a suite sets itself."""


def _bench(options: argparse.Namespace) -> None:
    load_policies(options.policy_file)
    if options.suite is not None:
        refuse(options, _FROZEN, "cannot go with --suite: a suite's episodes are frozen")
        run_suite(options, "bench")
        return
    refuse(options, SUITE_OPTIONS, "needs --suite")
    _scenario(options)


def _scenario(options: argparse.Namespace) -> None:
    """Run the scenario that the options describe."""
    from bufgym import policies
    from bufgym.benchmark import rows as files
    from bufgym.benchmark import table
    from bufgym.benchmark.compare import compare

    if target(options) is not None:
        raise BufgymError(f"--out {options.out}: without --suite it must be a folder")
    if options.workload is None:
        options.seeds = options.seeds or 10
        if options.drops is not None:
            raise BufgymError("--drops needs --workload")
    options.capacity = options.capacity or [8]
    options.decide_at = options.decide_at or "arrival"
    specs = loaded(options.policies)[0] or policies.names(for_topics=False)
    chosen = [policies.get(spec) for spec in specs]
    if options.decide_at == "overflow" and not options.policies:
        chosen = [policy for policy in chosen if policy.privileged is None]  # see QueueTask.check
    form = options.format or ("parquet" if files.has_pyarrow() else "csv")
    stream, about = scenario(options)
    if options.out is not None:
        # Before the long work, so that an impossible folder is reported at once.
        out = Path(options.out)
        out.mkdir(parents=True, exist_ok=True)
        if (out / "manifest.json").exists():
            raise BufgymError(
                f"{out}: holds the run of a suite; choose another --out (its rows are never written over)"
            )
    settings = {"max_bytes": options.max_bytes, "decide_at": options.decide_at}
    done = compare(chosen, stream, capacity=options.capacity, seeds=options.seeds, about=about, **settings)
    rows = done.rows
    bounds = _bound_notes(rows, stream, options.decide_at) if options.workload is not None else []
    print("\n".join([str(done), *bounds]))
    if options.workload is not None:
        order = dict.fromkeys(entry["policy"] for entry in table.means(rows))
        _dropped(options, chosen, stream, list(order))
    if options.out is not None:
        written = files.write_rows(rows, Path(options.out) / f"rows.{form}")
        page = Path(options.out) / "table.md"
        with replaced(page) as temporary:
            text = "\n".join([f"{about}\n\n{done.markdown}", *([""] if bounds else []), *bounds])
            temporary.write_text(text + "\n", encoding="utf-8")
        print(f"\n{len(rows)} rows in {written}, this table in {page}")


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


def _dropped(options: argparse.Namespace, chosen: Sequence[Policy], stream: Scenario, order: Sequence[str]) -> None:
    """Print drops by topic if there are several, with policies in ``order``, and write each drop to --drops."""
    from bufgym.benchmark import drops
    from bufgym.scenario import Uplink

    assert isinstance(stream, Uplink) and stream.workload is not None
    several = len(stream.workload.summary()) > 1
    if not several and options.drops is None:
        return
    messages = drops.drops(
        chosen, stream, options.capacity, options.seeds, max_bytes=options.max_bytes, decide_at=options.decide_at
    )
    counts = drops.write_drops(messages, None if options.drops is None else Path(options.drops))
    if several and counts:
        print("\n" + drops.by_topic(counts, stream, order, options.seeds * len(stream.traces)))
    if options.drops is not None:
        print(f"\n{counts.total()} dropped messages in {options.drops}")
