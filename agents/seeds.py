"""Several training seeds: a process each, and what becomes of them together."""

from __future__ import annotations

import concurrent.futures
import multiprocessing
import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from bufgym.benchmark.rows import Layout, Row, write_rows
from bufgym.errors import BufgymError

if TYPE_CHECKING:
    from train import Arguments

Found = TypeVar("Found")


def seeds_of(arguments: Arguments) -> range:
    """Those to be trained."""
    seeds = range(arguments.seed, arguments.seed + arguments.seeds)
    if not seeds:
        raise BufgymError(f"seeds = {arguments.seeds}: must be >= 1")
    return seeds


def each_seed(train: Callable[[Arguments, Path, int, int], Found], arguments: Arguments, folder: Path) -> list[Found]:
    """``train`` (arguments, the run's folder, seed, line of its progress bar) for every seed, side by side."""
    seeds = seeds_of(arguments)
    if len(seeds) == 1:
        return [train(arguments, folder, seeds[0], 0)]
    workers = min(len(seeds), os.cpu_count() or 1)
    # A fresh interpreter each: torch's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(workers, mp_context=context) as pool:
        jobs = [pool.submit(train, arguments, folder, seed, line) for line, seed in enumerate(seeds)]
        return [job.result() for job in jobs]


def conclude(
    folder: Path, model: str, best: int, seconds: Sequence[float], rows: Sequence[Row], layout: Layout, text: str
) -> None:
    """Keep the model of the seed ``best``, the rows of the test split and the table made of them; print the table."""
    shutil.copyfile(folder / f"seed-{best}" / model, folder / model)
    write_rows(rows, folder / "rows.csv", layout)
    (folder / "results.txt").write_text(text + "\n", encoding="utf-8")
    print(text)
    took = ", ".join(f"{s:.0f}" for s in seconds)
    print(f"\ntraining took {took} s; best on validation: seed {best}; model and rows are in {folder}")
