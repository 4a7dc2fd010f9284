"""``bufgym warmup``: compile beforehand, so that nothing waits for it later."""

from __future__ import annotations

import argparse

from bufgym.cli.options import Commands, command


def add(commands: Commands) -> None:
    command(commands, "warmup", _warmup, "compile beforehand what environments and benchmarks need")


def _warmup(options: argparse.Namespace) -> None:
    import time

    from bufgym import kernel
    from bufgym.benchmark import warmup

    if not kernel.JIT:
        print("compilation is off (NUMBA_DISABLE_JIT): nothing to do")
        return
    kernel.compile_silently()
    began_s = time.perf_counter()
    for number, (what, work) in enumerate(warmup.PARTS.items(), 1):
        print(f"{number}/{len(warmup.PARTS)} {what} ...", end=" ", flush=True)
        part_began_s = time.perf_counter()
        work()
        print(f"{time.perf_counter() - part_began_s:.1f} s", flush=True)
    print(f"ready after {time.perf_counter() - began_s:.0f} s; compiled code is in {kernel.FOLDER}")
