"""``bufgym bench``: policies side by side on the same episodes."""

from __future__ import annotations

import argparse
import shlex
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bufgym.cli.options import Commands, capacities, command, count, load_policies, policy_file, split_policies
from bufgym.cli.scenarios import scenario, scenario_options
from bufgym.cli.trace_bags import WORKLOAD_OPTIONS
from bufgym.errors import BufgymError
from bufgym.files import replaced

if TYPE_CHECKING:
    from bufgym.policies import Policy
    from bufgym.scenario import Scenario


def add(commands: Commands) -> None:
    bench = command(commands, "bench", _bench, "run policies side by side on the same episodes")
    option = bench.add_argument_group("a suite: frozen episodes, scored, with a report").add_argument
    option("--suite", metavar="NAME", help="which ('bufgym list suites'); --out DIR keeps it, a second call resumes it")
    option("--split", default="test", metavar="S", help="train, validation or test (default: test)")
    option("--data", metavar="DIR", help="folder of recordings, for suites over real links")
    option("--jobs", type=int, default=-1, metavar="N", help="processes side by side (default: one a core)")
    option("--backend", default="loky", metavar="B", help="loky (default), threading, sequential, ray or dask")
    option("--address", metavar="A", help="head of the Ray or Dask cluster (default: one on this machine)")
    who = bench.add_argument_group("who runs")
    option = who.add_argument
    option(
        "--policies",
        metavar="A,B:x=1,C",
        help="policies, with settings as in decimate:every=2 (default: all)",
    )
    option("--capacity", type=capacities, metavar="L,...", help="capacities L, messages (default: 8, or the suite's)")
    option("--max-bytes", type=count, metavar="B", help="also at most B bytes queued (default: no limit)")
    option("--decide-at", choices=("arrival", "overflow"), default="arrival", help="ask at every arrival, or when full")
    option("--seeds", type=count, metavar="N", help="episodes a trace (default: 10, or the suite's; a recording: 1)")
    policy_file(who)
    scenario_options(bench)
    option = bench.add_argument_group("where results go").add_argument
    option("--out", metavar="DIR", help="write rows.parquet (rows.csv without pyarrow) and table.md there")
    option("--format", choices=("csv", "parquet"), help="format of the rows")
    option("--drops", metavar="OUT.csv", help="with --workload: write each message that each policy dropped")


def _bench(options: argparse.Namespace) -> None:
    from bufgym import policies
    from bufgym.benchmark import rows as files
    from bufgym.benchmark import run, table, tune
    from bufgym.scenario import suites

    load_policies(options.policy_file)
    if options.policies is not None:
        specs = split_policies(options.policies)
    elif options.suite is not None:
        specs = tune.specs(suites.get(options.suite).name)
    else:
        specs = list(policies.names(for_topics=False))
    if options.format == "parquet" and options.out is not None and not files.has_pyarrow():
        raise BufgymError('--format parquet needs pyarrow: pip install "bufgym[bench]" (or --format csv)')
    if options.suite is not None:
        _suite(options, specs)
        return
    for name, default in (("split", "test"), ("data", None), ("jobs", -1), ("backend", "loky"), ("address", None)):
        if getattr(options, name) != default:
            raise BufgymError(f"--{name} needs --suite")
    if options.workload is None:
        options.seeds = options.seeds or 10
        if options.drops is not None:
            raise BufgymError("--drops needs --workload")
    options.capacity = options.capacity or [8]
    chosen = [policies.get(spec) for spec in specs]
    form = options.format or ("parquet" if files.has_pyarrow() else "csv")
    meets, about = scenario(options)
    if options.out is not None:
        # Before the long work, so that a folder that cannot be made is known at once.
        Path(options.out).mkdir(parents=True, exist_ok=True)
    rows = run.run(
        chosen,
        meets,
        options.capacity,
        options.seeds,
        max_bytes=options.max_bytes,
        decide_at=options.decide_at,
        progress=True,
    )
    bound = _bound_notes(rows, meets, options.decide_at) if options.workload is not None else []
    print("\n".join([f"{about}\n\n{table.plain(rows)}", *bound]))
    if options.workload is not None:
        order = dict.fromkeys(entry["policy"] for entry in table.means(rows))
        _dropped(options, chosen, meets, list(order))
    if options.out is not None:
        written = files.write_rows(rows, Path(options.out) / f"rows.{form}")
        target = Path(options.out) / "table.md"
        with replaced(target) as temporary:
            text = "\n".join([f"{about}\n\n{table.markdown(rows)}", *([""] if bound else []), *bound])
            temporary.write_text(text + "\n", encoding="utf-8")
        print(f"\n{len(rows)} rows in {written}, this table in {target}")


def _bound_notes(rows: Sequence[Mapping[str, Any]], meets: Scenario, decide_at: str) -> list[str]:
    """What the clairvoyant could have had of a recording, and whether that is exact."""
    sizes = getattr(meets, "workload").size_bytes  # noqa: B009  (only an uplink has one)
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


def _dropped(options: argparse.Namespace, chosen: Sequence[Policy], meets: Scenario, order: Sequence[str]) -> None:
    """The messages that were dropped: by topic where there are several (policies in ``order``), each into --drops."""
    from bufgym.benchmark import drops
    from bufgym.scenario import Uplink

    assert isinstance(meets, Uplink) and meets.workload is not None
    several = len(meets.workload.summary()) > 1
    if not several and options.drops is None:
        return
    found = drops.drops(
        chosen, meets, options.capacity, options.seeds, max_bytes=options.max_bytes, decide_at=options.decide_at
    )
    counts = drops.write_drops(found, None if options.drops is None else Path(options.drops))
    if several and counts:
        print("\n" + drops.by_topic(counts, meets, order, options.seeds * len(meets.traces)))
    if options.drops is not None:
        print(f"\n{counts.total()} dropped messages in {options.drops}")


_NOT_WITH_SUITE = (
    "max_bytes", "trace", "motion", "fps", "bytes", "size_cv", "seconds", "jitter", "scale", "value", "law", "t_min",
    "t_max", "t_mean", "workload", "drops", *WORKLOAD_OPTIONS,
)  # fmt: skip
"""A suite is frozen: these are its own."""


def _suite(options: argparse.Namespace, specs: list[str]) -> None:
    from bufgym.benchmark import report, sweep

    for name in _NOT_WITH_SUITE:
        if getattr(options, name) is not None:
            raise BufgymError(f"--{name.replace('_', '-')} cannot go with --suite: a suite's episodes are frozen")
    if options.interruption or options.decide_at != "arrival":
        raise BufgymError("--interruption and --decide-at cannot go with --suite: a suite's episodes are frozen")
    plan = sweep.Plan(
        options.suite,
        tuple(specs),
        options.split,
        tuple(options.capacity or ()),
        options.seeds,
        options.data,
        options.policy_file,
    )
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "run" if options.out is None else Path(options.out)
        rows = sweep.run_sweep(
            plan,
            out,
            jobs=options.jobs,
            backend=options.backend,
            address=options.address,
            command=_command(options),
            form=options.format,
            load=load_policies,
        )
        print(report.plain(out))
    if options.out is not None:
        print(f"\n{len(rows)} rows in {out}; bufgym report {out} makes a page of them")


def _command(options: argparse.Namespace) -> str:
    """The command that runs this again."""
    words = ["bufgym bench --suite", options.suite]
    for name, default in (
        ("split", "test"),
        ("policies", None),
        ("capacity", None),
        ("seeds", None),
        ("policy_file", None),
        ("data", None),
        ("out", None),
    ):
        given = getattr(options, name)
        if given != default:
            text = ",".join(map(str, given)) if isinstance(given, list) else str(given)
            words.append(f"--{name.replace('_', '-')} {shlex.quote(text)}")
    return " ".join(words)
