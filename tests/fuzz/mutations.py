"""Sound files made unsound: how many, which, and how; and limits of time and memory for what reads them.

The Hypothesis profile decides: more each night, and others.
"""

import os
import random
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

NIGHTLY = os.environ.get("HYPOTHESIS_PROFILE") == "nightly"
COUNT = 10_000 if NIGHTLY else 100
SEED = time.strftime("%Y%m%d") if NIGHTLY else "0"

ABSURD = b"1e999 -1 nan Infinity 2019.12.16_13.40.04 , PK\x03\x04 \x1f\x8b\x08 null \x1b[31m".split(b" ")
ABSURD += [b"9" * 25, b"7" * 5000, b"1" * 4096 + b"x", b"\n" * 2000, b" " * 5000, b"\x00" * 50, b"\xff\xfe", b"\r"]
ABSURD += ["٣".encode(), b"[" * 3000, b'{"duration_ms": 1e308, "bandwidth_kbps": 1e308},', b"a" + b".a" * 2000]
ABSURD += [b"1000000000000000 1"]  # a gap of 10**15


def mutated(uniform: random.Random, data: bytes, others: list[bytes]) -> bytes:
    mutant = bytearray(data)
    for _ in range(uniform.choice([0, 0, 1, 1, 1, 2, 4, 16])):
        at, length = uniform.randrange(len(mutant) + 1), uniform.choice([1, 1, 3, 20, 200])
        match uniform.randrange(7):
            case 0 if mutant:
                mutant[at % len(mutant)] ^= 1 << uniform.randrange(8)
            case 1:
                del mutant[at : at + length]
            case 2:
                mutant[at:at] = uniform.choice(ABSURD)
            case 3:
                mutant[at:at] = mutant[at : at + length] * uniform.choice([1, 2, 50])
            case 4:
                other = uniform.choice(others)
                place = uniform.randrange(len(other))
                mutant[at : at + length] = other[place : place + length]
            case 5:
                del mutant[at:]
            case _:
                mutant[at : at + 1] = uniform.choice([b"0", b"9", b"-", b".", b" ", b"\n", b",", b"e", b'"', b"}"])
    return bytes(mutant)


MOST_BYTES = 2 * 10**9
"""More than the process has when it begins."""
MOST_S = 60
"""An input, so that no busy machine is late."""


def late(*_: object) -> None:
    raise TimeoutError(f"more than {MOST_S} s")


@contextmanager
def limited() -> Iterator[None]:
    """Fail what takes longer than MOST_S, and on Linux what takes more than MOST_BYTES."""
    statm, address_space = Path("/proc/self/statm"), None
    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(MOST_S)
    if statm.exists():
        import resource

        address_space = resource.getrlimit(resource.RLIMIT_AS)
        now = int(statm.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (now + MOST_BYTES, address_space[1]))
    try:
        yield
    finally:
        if address_space is not None:
            resource.setrlimit(resource.RLIMIT_AS, address_space)
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
