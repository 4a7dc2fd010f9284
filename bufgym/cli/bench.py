"""``bufgym bench``: policies side by side on the same episodes."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter

from bufgym.cli.options import (
    RESULTS,
    WHO,
    Bytes,
    ByTopic,
    OutOptions,
    SuiteOptions,
    WhoOptions,
    command_line,
    given,
    load_policies,
    one_policy,
    policies_of,
    refuse,
)
from bufgym.cli.scenarios import (
    Described,
    InterruptionOptions,
    OwnOptions,
    ScenarioOptions,
    SharedOptions,
    StreamOptions,
    WorkloadOptions,
)
from bufgym.ground.errors import BufgymError
from bufgym.ground.files import replaced

if TYPE_CHECKING:
    from bufgym.benchmark.compare import Comparison
    from bufgym.benchmark.tasks import Task
    from bufgym.policies import Policy
    from bufgym.scenario import Scenario


@Parameter(name="*", group=Group.create_ordered("How the buffer decides"))
@dataclass(frozen=True)
class BufferOptions:
    max_bytes: Bytes | None = None
    """Also at most so many bytes queued, as in 9.2MB (default: no limit)."""
    decide_at: Literal["arrival", "overflow"] | None = None
    """Ask at every arrival (default), or when full."""
    no_bound: Annotated[bool, Parameter(negative="")] = False
    """Leave out the clairvoyant, whose time it saves; regret and score are measured against it."""


def bench(
    *,
    suite: SuiteOptions = SuiteOptions(),
    who: WhoOptions = WhoOptions(),
    stream: StreamOptions = StreamOptions(),
    workload: WorkloadOptions = WorkloadOptions(),
    interruption: InterruptionOptions = InterruptionOptions(),
    own: OwnOptions = OwnOptions(),
    shared: SharedOptions = SharedOptions(),
    buffer: BufferOptions = BufferOptions(),
    out: OutOptions = OutOptions(),
    against: Annotated[str | None, Parameter(group=WHO)] = None,
    drops: Annotated[str | None, Parameter(group=RESULTS)] = None,
    by_topic: ByTopic = None,
) -> None:
    """Run policies side by side on the same episodes.

    Args:
        against: Compare every policy with this one, by the paired difference of their shares of AFR's regret (of QoI
            over Robofleet's with topics, of the gain over AFR with a fleet).
        drops: With --workload: write each message that each policy dropped to this CSV file.
    """
    load_policies(who.policy_file)
    options = ScenarioOptions(stream, workload, interruption, own, shared)
    if suite.suite is not None:
        frozen = options.given() | given(buffer) | ({} if drops is None else {"drops": drops})
        refuse(frozen, "cannot go with --suite: a suite's episodes are frozen")
        _suite(suite, who, out, given(shared), against, by_topic)
        return
    refuse(given(suite), "needs --suite")
    if drops is not None and workload.workload is None:
        raise BufgymError("--drops needs --workload")
    said: dict[str, Any] = {"policies": tuple(who.policies or ()) or None, "capacity": who.capacity, "seeds": who.seeds}
    said |= {"against": against, **options.given(), **given(buffer), "policy_file": who.policy_file}
    command = command_line("bufgym bench", **said, report=out.report)
    _bench(options.scenario(who.seeds), who, buffer, out, drops, against, by_topic, command)


def _bench(
    made: Described,
    who: WhoOptions,
    buffer: BufferOptions,
    out: OutOptions,
    drops: str | None,
    against: str | None,
    by_topic: str | None,
    command: str,
) -> None:
    from bufgym.benchmark import table, tasks
    from bufgym.benchmark.compare import beside
    from bufgym.benchmark.rows import has_pyarrow, write_rows

    stream = made.scenario
    task = tasks.of(stream)
    if task.kind != "queue":
        refuse(given(buffer), "is for one queue")
    chosen = policies_of(who.policies or task.default_policies(""))
    if buffer.decide_at == "overflow" and not who.policies:
        chosen = [policy for policy in chosen if policy.privileged is None]  # see QueueTask.check
    rival = None if against is None else one_policy(against)
    by_name = _topic_policy(by_topic, task, chosen, rival)
    file, folder, page = out.file(), out.folder(), out.page()
    capacity = who.capacity or (task.capacity,)
    seeds = who.seeds or (1 if made.recorded else task.seeds)
    queue: dict[str, Any] = given(buffer, "max_bytes", "decide_at")
    bound: dict[str, Any] = {"bound": False} if buffer.no_bound else {}
    about = _about(made, task, None if made.recorded and who.seeds is None else seeds)
    if made.recorded:  # what was read is of use before the long work
        print(about, flush=True)
        plans = f"{len(stream.traces) * seeds * len(capacity)} x {stream.max_messages:,} messages"
        what = "" if buffer.no_bound else f"finding the clairvoyant's plans for {plans}, then "
        print(f"bufgym: {what}playing every policy", file=sys.stderr)
    done = beside(chosen, stream, capacity, seeds, label=made.label, about=about, rival=rival, **queue, **bound)
    bounded = made.recorded and not buffer.no_bound
    bounds = _bound_notes(done.rows, stream, buffer.decide_at or "arrival") if bounded else []
    print("\n".join([f"\n{done.plain}" if made.recorded else str(done), *bounds]))
    if made.recorded:
        order = list(dict.fromkeys(entry["policy"] for entry in table.means(done.rows, alone=done.unranked)))
        _dropped(chosen, stream, capacity, seeds, queue, order, drops)
    _print_topics(done, by_name)
    if folder is not None:
        form = out.format or ("parquet" if has_pyarrow() else "csv")
        written = write_rows(done.rows, folder / f"rows.{form}", task.layout)
        with replaced(folder / "table.md") as temporary:
            text = "\n".join([f"{done.about}\n\n{done.markdown}", *([""] if bounds else []), *bounds])
            temporary.write_text(text + "\n", encoding="utf-8")
        print(f"\n{len(done.rows)} rows in {written}, this table in {folder / 'table.md'}")
    _write(done, task, file, page, command)


def _suite(
    options: SuiteOptions,
    who: WhoOptions,
    out: OutOptions,
    changes: dict[str, Any],
    against: str | None,
    by_topic: str | None,
) -> None:
    """Run a suite and print its summary; ``changes`` are parameters of its scenarios that are not as they are."""
    from bufgym.benchmark.compare import on_suite
    from bufgym.benchmark.tasks import TASKS
    from bufgym.scenario import suites

    suite, file, page = suites.get(options.suite or ""), out.file(), out.page()
    task = TASKS[suite.kind]
    chosen = policies_of(who.policies or task.default_policies(suite.name))
    rival = None if against is None else one_policy(against)
    by_name = _topic_policy(by_topic, task, chosen, rival)
    folder = None if out.out is None or file is not None else Path(out.out)
    again = command_line(
        "bufgym bench",
        suite=suite.name,
        split=None if options.split == "test" else options.split,
        policies=tuple(who.policies or ()) or None,
        capacity=who.capacity,
        seeds=who.seeds,
        against=None if rival is None else rival.name,
        by_topic=by_topic,
        **changes,
        policy_file=who.policy_file,
        data=options.data,
        out=out.out,
    )
    try:
        done = on_suite(
            chosen,
            suite.name,
            rival,
            folder,
            split=options.split or "test",
            capacities=who.capacity or (),
            seeds=who.seeds,
            data=options.data,
            policy_file=who.policy_file,
            changes=changes,
            jobs=options.jobs,
            backend=options.backend or "loky",
            address=options.address,
            command=again,
            form=out.format,
        )
    except KeyboardInterrupt:
        raise KeyboardInterrupt(*["the same command resumes it"] * (folder is not None)) from None
    print(done.plain)
    _print_topics(done, by_name)
    if folder is not None:
        print(f"\n{len(done.rows)} rows in {folder}; bufgym report {folder} makes a page of them")
    _write(done, task, file, page, again)


def _topic_policy(by_topic: str | None, task: Task, chosen: Sequence[Policy], rival: Policy | None) -> str | None:
    """The policy of ``--by-topic``; an error if it does not run, or not on several topics."""
    from bufgym import policies

    if by_topic is None:
        return None
    if task.kind != "topics":
        raise BufgymError("--by-topic needs several topics")
    name = policies.get(by_topic).name
    if name not in {task.baseline, *(policy.name for policy in (*chosen, rival) if policy is not None)}:
        raise BufgymError(f"--by-topic {by_topic}: not among the policies that run")
    return name


def _print_topics(done: Comparison, policy: str | None) -> None:
    from bufgym.benchmark.tasks import topics

    if policy is not None:
        print(f"\n{policy}, topic by topic: means over episodes\n{topics.by_topic(done.rows, policy)}")


def _write(done: Comparison, task: Task, file: Path | None, page: Path | None, command: str) -> None:
    """Write rows to ``file`` and the page to ``page``, where these are asked for."""
    from bufgym.benchmark.rows import write_rows

    if file is not None:
        print(f"\n{len(done.rows)} rows in {write_rows(done.rows, file, task.layout)}")
    if page is not None:
        print(f"\nwrote {done.report(page, command)}")


def _about(made: Described, task: Task, seeds: int | None) -> str:
    """Lines about the scenario and its episodes; ``seeds`` is None for a recording that is played once."""
    from bufgym.scenario import about
    from bufgym.scenario.numbered import by_trace

    traces = len(by_trace(made.scenario))
    lines = [*made.lines, *([about(made.scenario)] if task.kind == "queue" else [])]
    if seeds is not None:
        met = "" if traces == 1 else f"{traces} traces x "
        means = f"Means over {met}{seeds} seeds; every policy meets the same episodes."
        lines.append(task.describe([made.scenario], seeds * traces) or means)
    return "\n".join(lines)


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
    capacity: Sequence[int],
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
