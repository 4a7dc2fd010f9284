"""Kernels as Python calls them: what they take and give, and where their code is kept."""

import copy
import os
import pickle
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from needs import needs
from numpy.typing import NDArray

from bufgym import jit
from bufgym.jit import JIT, Repeated, compile_signature, interruptible, kernel, records, way
from bufgym.kernels import compiler
from bufgym.kernels.kinds import FLOAT, INT, KernelError, Pointer, array_kind
from bufgym.utils.errors import BufgymError

TALE = """
import os
{before}
from bufgym.jit import kernel

@kernel
def double(k):
    return k + k

print(double(21))
"""


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


CELL = np.dtype([("near", np.int64), ("far", np.float64)], align=True)
needs_compilation = pytest.mark.skipif(
    not JIT or compiler.find() is None, reason=needs("compiler", "nothing is compiled here")
)


# ---------------------------------------------------------------- what a kernel takes and gives


@kernel
def told(whole: int, real: float, yes: bool, numbers: Numbers, cell: Any, nothing: Any = None) -> tuple[int, float]:
    """All kinds of arguments."""
    n = whole * len(numbers.of) + (1 if yes else 0)
    if numbers.several is not None:
        n += 100
    if nothing is not None:
        n += 1000
    cell.near, cell.far = n, real
    return n, real + numbers.of[0]


def test_arguments_of_all_kinds() -> None:
    cells, of = records(2, CELL), np.array([0.5, 2.0])
    assert told(3, 2, True, Numbers(of), cells[1]) == (7, 2.5)  # 2 for a float: as annotated
    assert cells["near"].tolist() == [0, 7] and cells["far"].tolist() == [0, 2]
    assert told(np.int64(3), np.float64(1), np.bool_(False), Numbers(of, True), cells[0], 5) == (1106, 1.5)
    assert told(cell=cells[0], whole=1, real=0.0, yes=False, numbers=Numbers(of)) == (2, 0.5)


@needs_compilation
def test_what_no_kernel_takes_is_named() -> None:
    with pytest.raises(KernelError, match=r"^a kernel takes no str: numbers, arrays, records, tuples and functions$"):
        told("3", 2.0, True, Numbers(np.zeros(1)), records(1, CELL)[0])
    with pytest.raises(KernelError, match=r"^an array is of complex128: kernels know whole numbers and floats$"):
        told(3, 2.0, True, Numbers(np.zeros(1, complex)), records(1, CELL)[0])


@kernel
def shift(numbers: NDArray[np.float64], by: float) -> None:
    """Add to every number."""
    for k in range(len(numbers)):
        numbers[k] += by


def test_numbers_that_do_not_lie_side_by_side_are_changed_too() -> None:
    table, cells = np.zeros((3, 2)), records(3, CELL)
    shift(table[:, 1], 2.0)
    shift(cells["far"], 1.0)
    assert table.tolist() == [[0, 2]] * 3
    assert cells["far"].tolist() == [1, 1, 1] and cells["near"].tolist() == [0, 0, 0]


def test_a_repeated_call_is_the_call_whichever_argument_changes() -> None:
    again, one, other = Repeated(), np.zeros(2), np.zeros(3)
    for _ in range(3):
        again(shift, one, 1.0)
    again(shift, other, 1.0)
    again(shift, one, 0.5)
    again(shift, np.zeros((2, 2))[:, 0], 7.0)
    copy.deepcopy(again)(shift, other, 2.0)
    pickle.loads(pickle.dumps(again))(shift, other, 2.0)
    again(told, 1, 2.0, True, Numbers(one), records(1, CELL)[0])
    with pytest.raises((KernelError, TypeError)):
        again(shift, "no array", 1.0)
    with pytest.raises((KernelError, TypeError)):  # and not the call before once more
        again(shift, "no array", 1.0)
    assert one.tolist() == [3.5, 3.5] and other.tolist() == [5, 5, 5]


@kernel
def sum_of(function: Any, numbers: NDArray[np.float64]) -> float:
    """Sum of a function's values."""
    total = 0.0
    for x in numbers:
        total += function(x)
    return total


def square(x: float) -> float:
    """x^2."""
    return x * x


def test_a_function_is_handed_over_at_run_time_or_is_part_of_the_code() -> None:
    numbers = np.array([1.0, 2.0, 3.0])
    assert sum_of(compile_signature(Pointer((FLOAT,), FLOAT), square), numbers) == 14
    assert sum_of(square, numbers) == 14


@needs_compilation
def test_a_function_of_other_kinds_is_refused() -> None:
    with pytest.raises(KernelError, match=r"kernel shift: must return a number"):
        compile_signature(Pointer((array_kind(float), FLOAT), INT), shift)


@needs_compilation
def test_a_checked_kernel_names_the_line_of_python(tmp_path: Path) -> None:
    source = TALE.replace("print(double(21))", "import numpy as np\n@kernel\ndef last(a):\n    return a[len(a)]\n"
                          "print(2 * double(10) + 2)\nlast(np.zeros(3))")  # fmt: skip
    file = tmp_path / "tale.py"
    file.write_text(source.format(before=""))
    environment = {**os.environ, "BUFGYM_KERNELS": "checked"}
    done = subprocess.run([sys.executable, str(file)], env=environment, capture_output=True, text=True, check=False)
    assert done.stdout == "42\n"
    assert f"{file}:13: index outside an array of so many (3, 3)" in done.stderr


def test_the_way_is_one_of_three() -> None:
    assert [way.way(asked) for asked in ("", "c", "checked", "python")] == ["c", "c", "checked", "python"]
    with pytest.raises(BufgymError, match=r"^BUFGYM_KERNELS: unknown way 'pyton'; did you mean 'python'\?$"):
        way.way("pyton")


# ---------------------------------------------------------------- where code is kept


def kept(folder: Path) -> list[Path]:
    """Files of code."""
    return [file for file in folder.rglob("*bufgym_double*") if file.suffix != ".sum"]


@needs_compilation
@pytest.mark.parametrize("left", [0.0, 0.5], ids=["empty", "half"])
def test_damaged_code_is_compiled_anew(tmp_path: Path, left: float) -> None:
    code = tmp_path / "code"
    run(tmp_path, BUFGYM_CACHE=str(code))
    (file,) = kept(code)
    whole = file.read_bytes()
    file.write_bytes(whole[: int(left * len(whole))])
    assert run(tmp_path, BUFGYM_CACHE=str(code)).stderr == ""
    assert len(file.read_bytes()) == len(whole)


@needs_compilation
def test_where_no_folder_can_be_written_a_temporary_one_serves(tmp_path: Path) -> None:
    nowhere = "import os; os.environ.pop('BUFGYM_CACHE', None); os.access = lambda path, mode, **_: mode != os.W_OK"
    done = run(tmp_path, before=nowhere, TMPDIR=str(tmp_path))
    assert done.stderr.startswith("bufgym: compiled code cannot be kept")
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.glob("bufgym-*"))  # removed at the end


@needs_compilation
def test_a_full_disk_keeps_no_code(tmp_path: Path) -> None:
    full = (
        "import os\nreal = os.replace\ndef full(one, other):\n    if 'code' in str(other): raise OSError(28, 'full')\n"
    )
    full += "    return real(one, other)\nos.replace = full\n"
    assert run(tmp_path, before=full, BUFGYM_CACHE=str(tmp_path / "code")).stderr == ""
    assert not kept(tmp_path / "code")


def test_without_a_compiler_a_kernel_runs_as_python_and_one_line_says_so(tmp_path: Path) -> None:
    """Others that it calls do too, and the line says what brings a compiler."""
    hidden = "from bufgym.kernels import compiler; compiler.on_path = compiler.zig = lambda: None"
    source = TALE.replace("print(double(21))", "@kernel\ndef twice(k):\n    return double(k) + 0\n\nprint(twice(21))")
    done = run(tmp_path, before=hidden, source=source, BUFGYM_CACHE=str(tmp_path / "code"), CC="")
    said = "bufgym: no C compiler: twice runs as plain Python, much slower; install a C compiler"
    assert done.stderr.startswith(said) if JIT else done.stderr == ""
    assert done.stderr.count("\n") == int(JIT)


OWN = """
from bufgym.kernels import compiler
compiler.on_path = compiler.zig = lambda: None
from bufgym import policies, scenario
from bufgym.policies import Policy
from bufgym.scenario.numbered import draw
from bufgym.sim import run

def mine(buffer, arrival, memory):
    return -2 if len(buffer.slots) < buffer.capacity else 0

on = scenario.get("lte", duration_s=3.0)
kept = []
for policy in (policies.get("drop-oldest"), Policy("mine", mine, compile=True), Policy("plain", mine)):
    kept.append(run(policy, [draw(on, 1)], 4, on.value).batch.order.tolist())
assert kept[0] == kept[1] == kept[2]
print(42)
"""


def test_a_policy_without_a_compiler_decides_as_ever_beside_one_that_is_compiled(tmp_path: Path) -> None:
    """The rollout has C for functions with an address, and this one has none."""
    said = run(tmp_path, source=OWN, BUFGYM_CACHE=str(tmp_path / "code"), CC="").stderr
    assert not JIT or "runs as plain Python" in said


@needs_compilation
def test_a_file_that_changed_since_it_was_imported_is_not_compiled(tmp_path: Path) -> None:
    """Its text would not be that of the function which Python runs."""
    change = "open(__file__, 'a').close(); text = open(__file__).read()\nopen(__file__, 'w').write({})\n"
    source = TALE.replace("print(double(21))", change.format("text.replace('k + k', 'k * k')") + "print(double(21))")
    file = tmp_path / "tale.py"
    file.write_text(source.format(before=""))
    done = subprocess.run([sys.executable, str(file)], capture_output=True, text=True, check=False,
                          env={**os.environ, "BUFGYM_CACHE": str(tmp_path)})  # fmt: skip
    assert "tale.py: has changed since double was imported; start again" in done.stderr


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
    with pytest.raises(KernelError, match="SetComp is not part of the kernel language"):
        outer(Numbers(np.zeros(3), True))


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
import math
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
        least += math.sin(memory[0] + k)
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
