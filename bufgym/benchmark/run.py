"""The experiment of ``bufgym bench``: every policy meets the same episodes, and each run becomes one flat row.

Seed s stands for one episode and one sequence of luck, whatever the policy, the capacity and the order in which they
run (common random numbers): two rows with the same trace and seed differ by their policy and capacity alone, so their
difference carries no noise of the draw. Several traces are several cells, each with the full set of seeds.
"""

from __future__ import annotations

import csv
import os
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from bufgym import oracle
from bufgym.errors import BufgymError
from bufgym.metrics import METRICS, outcome
from bufgym.policies import Policy
from bufgym.scenario import Episode, Interruption, Scenario, Streams, Uplink
from bufgym.sender import Senders

Row = dict[str, Any]

COLUMNS = ("policy", "capacity", "trace", "seed", *METRICS, "oracle", "regret")
"""What a row has, in this order. ``oracle`` and ``regret`` are None where no oracle exists."""

_TEXT = ("policy", "trace")
_WHOLE = ("capacity", "seed", "arrived", "delivered", "dropped", "in_transmission", "buffered", "impossible")

# Messages held at a time (88 bytes each): many seeds run in several batches.
_BATCH_MESSAGES = 1_000_000


def cells(scenario: Scenario) -> list[tuple[str, Scenario]]:
    """The scenario split into one cell a trace: (label, scenario). Traces of one name are told apart by a number."""
    if isinstance(scenario, Interruption):
        return [("interruption", scenario)]
    if not isinstance(scenario, Uplink):
        return [(type(scenario).__name__.lower(), scenario)]
    labels: list[str] = []
    for trace in scenario.traces:
        same = sum(other.name == trace.name for other in scenario.traces[: len(labels)])
        labels.append(f"{trace.name}#{same + 1}" if same else trace.name)
    return [(label, replace(scenario, traces=(t,))) for label, t in zip(labels, scenario.traces, strict=True)]


def draw(scenario: Scenario, seed: int) -> Episode:
    """The episode of this seed, with the luck of randomised policies."""
    streams = Streams.seeded(seed)
    return scenario.draw(streams).with_luck(streams.policy)


def run(
    policies: Sequence[Policy],
    scenario: Scenario,
    capacities: Sequence[int],
    seeds: int | Sequence[int],
    *,
    max_bytes: int | None = None,
    decide_at: str = "arrival",
    progress: bool = False,
) -> list[Row]:
    """Every policy at every capacity on every trace and seed; one row each, with the entries of ``COLUMNS``.

    Args:
        policies: see ``bufgym.policies.get``.
        scenario: an ``Uplink`` (each of its traces is a cell of its own) or an ``Interruption`` (rows get the best
            whole-numbered solution as ``oracle`` and ``regret = 1 - (H - 1) / oracle``, unless ``max_bytes`` is set:
            the oracle counts messages).
        capacities: L, messages.
        seeds: so many (0, 1, ...), or these.
        max_bytes: B, bytes; None for no limit.
        decide_at: "arrival" or "overflow" (ask only when full).
        progress: show a bar on stderr, where that is a terminal and tqdm is installed.
    """
    chosen = list(range(seeds)) if isinstance(seeds, int) else list(seeds)
    for what, given in (("policies", policies), ("capacities", capacities), ("seeds", chosen)):
        if not given:
            raise BufgymError(f"{what} = {seeds if what == 'seeds' else list(given)}: need at least one")
    names = [policy.name for policy in policies]
    for name in names:
        if names.count(name) > 1:
            raise BufgymError(f"policies: {name!r} is given more than once")
    at_once = max(1, _BATCH_MESSAGES // scenario.max_messages)
    batches = [chosen[k : k + at_once] for k in range(0, len(chosen), at_once)]
    parts = cells(scenario)
    rows: list[Row] = []
    runs = len(parts) * len(batches) * len(capacities) * len(policies)
    with _bar(runs, progress) as advance:
        for trace, cell in parts:
            for batch in batches:
                episodes = [draw(cell, seed) for seed in batch]
                for capacity in capacities:
                    senders = Senders(
                        len(batch),
                        capacity,
                        cell.value,
                        max_messages=cell.max_messages,
                        max_bytes=max_bytes,
                        decide_at=decide_at,
                    )
                    for policy in policies:
                        for i, episode in enumerate(episodes):
                            senders.load(i, episode)
                        senders.run(policy)
                        for i, (seed, episode) in enumerate(zip(batch, episodes, strict=True)):
                            best = None
                            if isinstance(cell, Interruption) and max_bytes is None:
                                # The arrivals that meet the policy are 1..T.
                                best = oracle.integer(capacity, episode.last_decision, cell.value)
                            rows.append(_row(policy.name, capacity, trace, seed, senders, i, best))
                        advance()
    return rows


def _row(policy: str, capacity: int, trace: str, seed: int, senders: Senders, i: int, best: float | None) -> Row:
    result = outcome(senders, i)
    return {
        "policy": policy,
        "capacity": capacity,
        "trace": trace,
        "seed": seed,
        **asdict(result),
        "oracle": best,
        "regret": None if best is None else 1 - (result.qoi - 1) / best,
    }


@contextmanager
def _bar(total: int, wanted: bool) -> Iterator[Any]:
    """A function to call after each run."""
    if wanted and sys.stderr.isatty():
        try:
            from tqdm import tqdm
        except ImportError:
            pass
        else:
            # What is done within a second needs no bar.
            with tqdm(total=total, unit="run", delay=1.0, leave=False, file=sys.stderr) as bar:
                yield bar.update
                return
    yield lambda: None


# --- rows in files ---------------------------------------------------------------------------------------------------


def write_rows(rows: Sequence[Mapping[str, Any]], path: str | os.PathLike[str]) -> Path:
    """Write rows to a ``.csv`` or ``.parquet`` file, whole or not at all; None is an empty cell (CSV) or null."""
    target = Path(path)
    if target.suffix not in (".csv", ".parquet"):
        raise BufgymError(f"{target}: rows are written to .csv or .parquet files")
    if target.suffix == ".parquet":
        pyarrow, parquet = _pyarrow()
        columns = list(rows[0]) if rows else list(COLUMNS)
        schema = pyarrow.schema([(name, _arrow_type(pyarrow, name)) for name in columns])
        made = pyarrow.Table.from_pylist([dict(row) for row in rows], schema=schema)
        with replaced(target) as temporary:
            parquet.write_table(made, temporary)
        return target
    with replaced(target) as temporary, open(temporary, "w", encoding="utf-8", newline="") as file:
        # Floats are written so that they read back to the last bit.
        writer = csv.DictWriter(file, list(rows[0]) if rows else list(COLUMNS), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return target


def read_rows(path: str | os.PathLike[str]) -> list[Row]:
    """The rows that ``write_rows`` wrote."""
    source = Path(path)
    if source.suffix == ".parquet":
        _, parquet = _pyarrow()
        try:
            rows: list[Row] = parquet.read_table(source).to_pylist()
        except OSError:
            raise
        except Exception as error:  # pyarrow's own errors are ValueErrors of many kinds
            raise BufgymError(f"{source}: no rows that can be read: {str(error).splitlines()[0]}") from None
        return rows
    with open(source, encoding="utf-8", newline="") as file:
        reader = csv.DictReader(file)
        return [{name: _parsed(source, reader.line_num, name, text) for name, text in line.items()} for line in reader]


def _parsed(path: Path, line: int, name: str, text: str | None) -> Any:
    if name in _TEXT:
        return text
    if text is None or text == "":
        return None
    try:
        return int(text) if name in _WHOLE else float(text)
    except ValueError:
        raise BufgymError(f"{path}, line {line}: {name} = {text!r}: must be a number") from None


@contextmanager
def replaced(target: Path) -> Iterator[Path]:
    """A temporary file beside ``target`` to write to; it takes the target's place when all went well."""
    handle, name = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        # mkstemp makes a file that only its owner may read; a result is as readable as any other new file.
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def has_pyarrow() -> bool:
    """Whether Parquet files can be written here."""
    try:
        _pyarrow()
    except BufgymError:
        return False
    return True


def _pyarrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise BufgymError('Parquet files need pyarrow: pip install "bufgym[bench]" (or write .csv)') from None
    return pyarrow, pyarrow.parquet


def _arrow_type(pyarrow: Any, name: str) -> Any:
    if name in _TEXT:
        return pyarrow.string()
    return pyarrow.int64() if name in _WHOLE else pyarrow.float64()
