"""``bufgym bench``: policies side by side on the same episodes."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from cyclopts import Group, Parameter

from bufgym.cli.options import (
    RESULTS,
    Bytes,
    OutOptions,
    SuiteOptions,
    WhoOptions,
    command_line,
    given,
    load_policies,
    refuse,
)
from bufgym.cli.scenarios import Described, StreamOptions, WorkloadOptions, described
from bufgym.utils.errors import BufgymError
from bufgym.utils.progress import bar

if TYPE_CHECKING:
    from bufgym.benchmark.compare import Comparison
    from bufgym.benchmark.tasks import Task
    from bufgym.policies import Policy


@Parameter(name="*", group=Group.create_ordered("The buffer"))
@dataclass(frozen=True)
class BufferOptions:
    max_bytes: Bytes | None = None
    """Also at most so many bytes queued, as in 9.2MB (default: no limit)."""
    no_bound: Annotated[bool, Parameter(negative="")] = False
    """Leave out the clairvoyant, whose time it saves; regret and score are measured against it."""


class Experiment(NamedTuple):
    """What the policies meet, and the settings that go with it."""

    on: Any  # the scenario, or a suite's name
    task: Task
    arguments: dict[str, Any]  # further arguments of ``compare``
    recorded: bool = False  # whether it plays a recording of a robot


def bench(
    *,
    suite: SuiteOptions = SuiteOptions(),
    who: WhoOptions = WhoOptions(),
    stream: StreamOptions = StreamOptions(),
    workload: WorkloadOptions = WorkloadOptions(),
    buffer: BufferOptions = BufferOptions(),
    out: OutOptions = OutOptions(),
    drops: Annotated[str | None, Parameter(group=RESULTS)] = None,
    mcap: Annotated[Path | None, Parameter(group=RESULTS)] = None,
) -> None:
    """Run policies side by side on the same episodes.

    Args:
        drops: With --workload: write each message that each policy dropped to this CSV file.
        mcap: With --workload RECORDING: write what each policy delivers and drops, and its queue, to this MCAP file
            (of the first trace, L and seed), for Foxglove and rerun.
    """
    from bufgym.benchmark.compare import compare
    from bufgym.benchmark.tasks import topics
    from bufgym.traces.formats.splits import is_recording

    load_policies(who.policy_file)
    command = _command(suite, who, stream, workload, buffer, out)
    if suite.suite is not None:
        frozen = given(stream) | given(workload) | given(buffer)
        frozen |= {name: value for name, value in (("drops", drops), ("mcap", mcap)) if value is not None}
        refuse(frozen, "cannot go with --suite: a suite's episodes are frozen")
        experiment = _on_suite(suite, who, command)
    else:
        refuse(given(suite, "split", "data"), "needs --suite")
        if drops is not None and workload.workload is None:
            raise BufgymError("--drops needs --workload")
        if mcap is not None and (workload.workload is None or mcap.suffix != ".mcap"):
            raise BufgymError(f"--mcap {mcap}: must be FILE.mcap, and needs --workload")
        if mcap is not None and not all(map(is_recording, workload.workload or [])):
            raise BufgymError(f"--mcap {mcap}: needs a recording that holds the messages themselves (MCAP, ROS bag)")
        experiment = _on_scenario(described(stream, workload, who.seeds), buffer, who.seeds)
        processes = given(suite, "jobs", "backend")
        experiment.arguments.update(processes, **({"policy_file": who.policy_file} if who.policy_file else {}))
    entrants, rival = who.entrants(experiment.task), who.rival()
    topic_policy = out.topic_policy(experiment.task, [*entrants, *([] if rival is None else [rival])])
    file, folder, page = out.file(), out.folder(), out.page()
    capacity = who.capacity or (() if suite.suite else (experiment.task.capacity,))
    if experiment.recorded:
        _announce(experiment, len(capacity))

    try:
        kept: dict[str, Any] = {"out": folder, "form": out.format}
        done = compare(entrants, experiment.on, capacity=capacity, against=rival, **kept, **experiment.arguments)
    except KeyboardInterrupt:
        resumable = suite.suite is not None and folder is not None
        raise KeyboardInterrupt(*["the same command resumes it"] * resumable) from None

    if suite.suite is not None:
        print(done.plain)
    else:
        print(
            done.about.removeprefix(experiment.arguments["about"]) + f"\n{done.plain}" if experiment.recorded else done
        )
    if experiment.recorded:
        _print_drops(done, entrants, experiment, capacity, drops)
    if mcap is not None:
        _write_playback(mcap, workload.workload or [], entrants, experiment, capacity[0])
    if topic_policy is not None:
        by_topic = topics.by_topic(done.rows, topic_policy)
        print(f"\n{topic_policy}, topic by topic: means over episodes\n{by_topic}")
    if folder is not None:
        what = f"bufgym report {folder} makes a page of them" if suite.suite else "the table is in table.md beside them"
        print(f"\n{len(done.rows)} rows in {folder}; {what}")
    if file is not None:
        print(f"\n{len(done.rows)} rows in {done.write_rows(file)}")
    if page is not None:
        print(f"\nwrote {done.report(page, command)}")


def _command(
    suite: SuiteOptions,
    who: WhoOptions,
    stream: StreamOptions,
    workload: WorkloadOptions,
    buffer: BufferOptions,
    out: OutOptions,
) -> str:
    """The command that runs this again: a suite's keeps its folder, any other makes its page."""
    kept = {"report": out.report} if suite.suite is None else {"by_topic": out.by_topic, "out": out.out}
    return command_line(
        "bufgym bench",
        suite=suite.suite,
        split=None if suite.split == "test" else suite.split,
        policies=tuple(who.policies or ()) or None,
        capacity=who.capacity,
        seeds=who.seeds,
        against=who.against,
        **given(stream),
        **given(workload),
        **given(buffer),
        policy_file=who.policy_file,
        data=suite.data,
        **kept,
    )


def _on_suite(suite: SuiteOptions, who: WhoOptions, command: str) -> Experiment:
    from bufgym.benchmark.tasks import task_of
    from bufgym.scenario import suites

    name = suites.named(suite.suite or "")
    arguments = {name: value for name, value in given(suite).items() if name != "suite"}
    arguments |= {"seeds": who.seeds, "policy_file": who.policy_file, "command": command}
    return Experiment(name, task_of(name), arguments)


def _on_scenario(what: Described, buffer: BufferOptions, asked_seeds: int | None) -> Experiment:
    from bufgym.benchmark.tasks import task_for

    scenario, lines, label, recorded, facts = what
    if task_for(scenario).kind != "queue":
        refuse(given(buffer), "is for one queue")
    of_a_queue = given(buffer, "max_bytes") | ({"bound": False} if buffer.no_bound else {})
    task = task_for(scenario, **of_a_queue)
    seeds = asked_seeds or (1 if recorded else task.seeds)
    about = [*lines, *_about(scenario, task, None if recorded and asked_seeds is None else seeds), *facts]
    arguments = {"seeds": seeds, "label": label, "about": "\n".join(about)}
    return Experiment(scenario, task, {**arguments, **of_a_queue}, recorded)


def _about(scenario: Any, task: Task, seeds: int | None) -> list[str]:
    """Lines about the scenario and its episodes; ``seeds`` is None for a recording that is played once."""
    from bufgym.scenario import about
    from bufgym.scenario.numbered import by_trace

    lines = [about(scenario)] if task.kind == "queue" else []
    if seeds is None:
        return lines
    traces = len(by_trace(scenario))
    met = "" if traces == 1 else f"{traces} traces x "
    means = f"Means over {met}{seeds} seeds; every policy meets the same episodes."
    return [*lines, task.describe([scenario], seeds * traces) or means]


def _announce(experiment: Experiment, capacities: int) -> None:
    """Print what was read of a recording, which is of use before the long work, and how much work there is."""
    arguments, scenario = experiment.arguments, experiment.on
    print(arguments["about"], flush=True)
    episodes = len(scenario.traces) * arguments["seeds"] * capacities
    plans = f"finding the clairvoyant's plans for {episodes} x {scenario.max_messages:,} messages, then "
    print(f"bufgym: {plans if arguments.get('bound', True) else ''}playing every policy", file=sys.stderr)


def _print_drops(
    done: Comparison, players: Sequence[Policy], experiment: Experiment, capacity: Sequence[int], file: str | None
) -> None:
    """Print the drops of a recording's messages by topic if it has several, and write each drop to ``file``."""
    from bufgym.benchmark import drops, table

    scenario, seeds = experiment.on, experiment.arguments["seeds"]
    several = len(scenario.workload.summary()) > 1
    if not several and file is None:
        return
    settings = {name: value for name, value in experiment.arguments.items() if name == "max_bytes"}
    messages = drops.drops(players, scenario, capacity, seeds, **settings)
    counts = drops.write_drops(messages, None if file is None else Path(file))
    if several and counts:
        best_first = dict.fromkeys(entry["policy"] for entry in table.means(done.rows, done.unranked))
        print("\n" + drops.by_topic(counts, scenario, list(best_first), seeds * len(scenario.traces)))
    if file is not None:
        print(f"\n{counts.total()} dropped messages in {file}")


def _write_playback(
    file: Path, recording: Sequence[str], players: Sequence[Policy], experiment: Experiment, capacity: int
) -> None:
    """Write an episode of a recording as the policies would have sent it."""
    from bufgym.benchmark.playback import write_playback

    settings = {name: value for name, value in experiment.arguments.items() if name == "max_bytes"}
    with bar(None, True, "message") as advance:
        counts = write_playback(file, recording, players, experiment.on, capacity, advance=advance, **settings)
    print(f"\nwrote {file}, L = {capacity}:")
    for name, (delivered, dropped) in counts.items():
        print(f"  /{name}/delivered/...: {delivered:,}, /{name}/dropped/...: {dropped:,}, /{name}/queue")
