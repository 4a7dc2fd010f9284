"""Where compiled code is cached: it rests on the sources as they are, and survives damage and a lack of room."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from needs import needs
from numpy.typing import NDArray

from bufgym import jit
from bufgym.jit import JIT, announce, interruptible, kernel, way, without_dispatch

TALE = """
import os
{before}
from bufgym.jit import kernel

@kernel
def double(k):
    return k + k

print(double(21))
"""

PATIENT = "from bufgym.jit import announce as k; k.PATIENCE_S = 1e6"
"""Beforehand: no notice, however long a busy machine takes to compile."""


def run(tmp_path: Path, before: str = "", source: str = TALE, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run ``source``, a module whose kernels print 42."""
    file = tmp_path / "tale.py"
    file.write_text(source.format(before=before))
    environment = {"PYTHONPATH": str(Path(jit.__file__).parents[3]), **os.environ, **environment}
    done = subprocess.run([sys.executable, str(file)], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "42\n"
    return done


class Numbers(NamedTuple):
    """An array, which may be marked."""

    of: NDArray[np.float64]
    several: bool | None = None


needs_compilation = pytest.mark.skipif(not JIT, reason=needs("compiled", "nothing is cached without compilation"))


@pytest.fixture(params=[way.PIPELINE, way.PLAIN])
def each_compiler(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes of the test compile in each of the two ways."""
    monkeypatch.setenv(way.VARIABLE, request.param)


@needs_compilation
@pytest.mark.usefixtures("each_compiler")
@pytest.mark.parametrize("left", [0.0, 0.5], ids=["empty", "half"])
def test_damaged_code_is_compiled_anew(tmp_path: Path, left: float) -> None:
    run(tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "code"))
    (file,) = (tmp_path / "code").rglob("*.nbc")
    whole = file.read_bytes()
    file.write_bytes(whole[: int(left * len(whole))])
    assert run(tmp_path, before=PATIENT, NUMBA_CACHE_DIR=str(tmp_path / "code")).stderr == ""
    assert len(file.read_bytes()) >= len(whole) - 8


@needs_compilation
@pytest.mark.usefixtures("each_compiler")
def test_long_compiling_is_announced_once_and_code_from_the_cache_never(tmp_path: Path) -> None:
    impatient = "from bufgym.jit import announce as k; k.PATIENCE_S = 0.0"
    assert run(tmp_path, before=impatient, NUMBA_CACHE_DIR=str(tmp_path / "code")).stderr == announce.NOTICE + "\n"
    assert run(tmp_path, before=impatient, NUMBA_CACHE_DIR=str(tmp_path / "code")).stderr == ""


@needs_compilation
@pytest.mark.usefixtures("each_compiler")
@pytest.mark.parametrize(
    "before",
    [PATIENT, "from bufgym.jit import announce as k; k.PATIENCE_S = 0.0; k.compile_silently()"],
    ids=["quick", "silent"],
)
def test_what_is_not_announced(tmp_path: Path, before: str) -> None:
    assert run(tmp_path, before=before, NUMBA_CACHE_DIR=str(tmp_path / "code")).stderr == ""


@needs_compilation
@pytest.mark.usefixtures("each_compiler")
def test_who_wants_only_what_is_kept_compiles_nothing(tmp_path: Path) -> None:
    asked = """
import sys
from bufgym.jit import NotCachedError, cached_only
try:
    with cached_only():
        print(double(21))
except NotCachedError:
    print(double(21))
    print("compiled", file=sys.stderr)
"""
    source = TALE.replace("print(double(21))", asked)
    assert run(tmp_path, before=PATIENT, source=source, NUMBA_CACHE_DIR=str(tmp_path / "code")).stderr == "compiled\n"
    assert run(tmp_path, before=PATIENT, source=source, NUMBA_CACHE_DIR=str(tmp_path / "code")).stderr == ""


@needs_compilation
def test_where_no_folder_can_be_written_a_temporary_one_serves(tmp_path: Path) -> None:
    nowhere = f"import os; os.environ.pop('NUMBA_CACHE_DIR', None); os.access = lambda *_: False; {PATIENT}"
    done = run(tmp_path, before=nowhere, TMPDIR=str(tmp_path))
    assert done.stderr.startswith("bufgym: compiled code cannot be cached")
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.glob("bufgym-*"))  # removed at the end


@needs_compilation
@pytest.mark.usefixtures("each_compiler")
def test_a_full_disk_keeps_no_code(tmp_path: Path) -> None:
    """Python's own way to replace a file fails, as both compilers write whole files or none."""
    full = "import os\ndef full(*_): raise OSError(28, 'no space left')\nos.replace = full\n"
    run(tmp_path, before=full + PATIENT, NUMBA_CACHE_DIR=str(tmp_path / "code"))
    assert not list((tmp_path / "code").rglob("*.nbc"))


@needs_compilation
def test_a_direct_call_is_the_call() -> None:
    """Rows are stepped without a look at the types of their arrays: by the code that Numba would have found."""

    @kernel
    def double(numbers: Numbers, factor: Any, more: Any) -> None:
        for k in range(len(numbers.of)):
            numbers.of[k] *= 2 * factor + more
            if numbers.several is not None:
                numbers.of[k] += 1

    one, directly = np.arange(12.0), without_dispatch(double)
    several = one.copy()
    for _ in range(3):
        directly(Numbers(one), 0.5, 1)
        directly(Numbers(several, True), 0.5, 1)
    assert one[:4].tolist() == [0, 8, 16, 24] and several[:4].tolist() == [7, 15, 23, 31]
    assert len(double.overloads) == 2  # type: ignore[attr-defined]


@needs_compilation
def test_a_branch_that_needs_a_missing_field_is_not_compiled() -> None:
    @kernel
    def inner(numbers: Numbers) -> int:
        if numbers.several is not None:
            return len({str(number) for number in numbers.of})
        return len(numbers.of)

    @kernel
    def outer(numbers: Numbers) -> int:
        return inner(numbers)

    assert outer(Numbers(np.zeros(3))) == 3
    with pytest.raises(numba.core.errors.TypingError):
        outer(Numbers(np.zeros(3), True))


@needs_compilation
def test_a_named_tuple_made_in_a_kernel_is_handed_on() -> None:
    """Its fields stay as they were when it was made, the arrays that they name do not."""

    @kernel
    def doubled(numbers: Numbers) -> float:
        numbers.of[0] *= 2
        return float(numbers.of[0])

    @kernel
    def twice(numbers: NDArray[np.float64]) -> float:
        made = Numbers(numbers[1:], None)
        numbers = numbers[:1]
        return doubled(made) + doubled(made) + numbers[0]

    assert twice(np.array([100.0, 3.0])) == 6 + 12 + 100


# Ctrl-C is answered within a second while a kernel works, and what a kernel's thread raises arrives.

LONG = """
import signal

import numpy as np
from bufgym import policies
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.oracle import clairvoyant
from bufgym.scenario import Episode, messages
from bufgym.sim import run
from bufgym.traces import Trace

V = qoi.exponential()
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it


def episode(n, bytes_per_s):
    return Episode(messages(np.arange(n) * 33_333, 230_000), Link(Trace.constant(bytes_per_s, 100)))


def far(buffer, arrival, memory):
    least = 0.0
    for k in range(20_000_000):
        least += np.sin(memory[0] + k)
    return -1 if least < 0 else -2


far = policies.Policy("far", far, compile=True)
tasks = {
    "rollout": lambda n: run(far, [episode(n, 1e6)], 5, V),
    "clairvoyant": lambda n: clairvoyant(episode(n, 1e4), 50, V),
}
"""


@pytest.mark.skipif(not JIT, reason=needs("compiled", "Python's own loops are interrupted anyway"))
@pytest.mark.parametrize(("task", "warm", "n"), [("rollout", 1, 10**6), ("clairvoyant", 2_000, 65_000)])
def test_ctrl_c_is_answered_within_a_second(task: str, warm: int, n: int, tmp_path: Path) -> None:
    """After a short run (so that nothing is left to compile) each would take minutes."""
    program = tmp_path / "long.py"
    program.write_text(f"{LONG}\ntasks[{task!r}]({warm})\nprint('begins', flush=True)\ntasks[{task!r}]({n})\n")
    process = subprocess.Popen([sys.executable, program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None and process.stdout.readline() == "begins\n"
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(2)  # it is at work
        os.kill(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=30)  # minutes without it; a busy machine may take more than a second
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == -signal.SIGINT
    assert said.rstrip().endswith("KeyboardInterrupt")


def test_the_result_and_the_error_arrive() -> None:
    assert interruptible(lambda: threading.current_thread()) is not threading.main_thread()
    with pytest.raises(ZeroDivisionError):
        interruptible(lambda: 1 // (len(np.zeros(1)) - 1))
