"""``bufgym warmup``: compiles everything beforehand, so that nothing waits for it later."""

from __future__ import annotations

import argparse

from bufgym.cli.options import Commands, command


def add(commands: Commands) -> None:
    command(commands, "warmup", _warmup, "compile beforehand what environments and benchmarks need")


def _warmup(options: argparse.Namespace) -> None:
    import time
    from concurrent.futures import ProcessPoolExecutor, as_completed
    from multiprocessing import get_context

    from bufgym.benchmark import warmup
    from bufgym.ground import kernel

    if not kernel.JIT:
        print("compilation is off (NUMBA_DISABLE_JIT): nothing to do")
        return
    began_s = time.perf_counter()
    print(f"compiling {len(warmup.PARTS)} parts: {', '.join(warmup.PARTS)}", flush=True)
    # A process for each core. Code that two of them need is compiled twice, with equal results.
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as processes:
        parts = {processes.submit(warmup.compile_part, what): what for what in warmup.PARTS}
        for number, part in enumerate(as_completed(parts), 1):
            print(f"{number}/{len(parts)} {parts[part]}: {part.result():.1f} s", flush=True)
    print(f"ready after {time.perf_counter() - began_s:.0f} s; compiled code is in {kernel.FOLDER}")
