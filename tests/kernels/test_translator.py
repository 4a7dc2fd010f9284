"""The translator from kernels to C: every policy's decisions and memory, arithmetic, and what is refused."""

import ctypes
import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any, get_type_hints

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from library_cases import Library
from needs import needs

from bufgym import policies, scenario
from bufgym.kernels import compiler
from bufgym.kernels.kinds import BOOL, FLOAT, INT, KernelError, Pointer, Tuple, array_kind, record_kind
from bufgym.kernels.program import Program
from bufgym.model.buffer import MESSAGE, TOPIC, Buffer
from bufgym.policies import registry
from bufgym.scenario.numbered import draw
from bufgym.sim import Senders

pytestmark = pytest.mark.skipif(compiler.find() is None, reason=needs("compiler"))


def view_kind() -> Tuple:
    """The kind of a ``Buffer``."""
    constants = array_kind(float, constant=True)
    own: dict[str, Any] = {"slots": array_kind(MESSAGE), "topics": array_kind(TOPIC), "past": array_kind(float)}
    own |= {"v": constants, "parameters": constants}
    own |= {name: FLOAT for name, kind in get_type_hints(Buffer).items() if kind is float}
    return Tuple(tuple(own.get(name, INT) for name in Buffer._fields), Buffer._fields, "Buffer")


MOST = 150  # calls of each function that are compared
VIEW, MEMORY, ARRIVAL = view_kind(), array_kind(float), record_kind(MESSAGE)
HOOKS = {
    "on_arrival": Pointer((VIEW, ARRIVAL, MEMORY), INT),
    "on_departure": Pointer((VIEW, MEMORY), None),
    "on_dequeue": Pointer((VIEW, MEMORY), BOOL),
    "on_send": Pointer((VIEW, MEMORY), INT),
}


def compiled_names() -> Iterator[str]:
    """Every registered policy that promises to be a kernel."""
    names = (*registry.names(), *registry.names(named_only=True))
    return (name for name in names if registry.get(name).compile and registry.get(name).built_in)


def symbol(name: str, hook: str) -> str:
    """A policy's function in C."""
    return f"{name.replace('-', '_')}_{hook}"


@functools.cache
def of_policies() -> Library:
    """All of them in one library."""
    program = Program()
    for name in compiled_names():
        for hook, pointer in HOOKS.items():
            program.hook(symbol(name, hook), getattr(policies.get(name), hook), pointer)
    found = compiler.find()
    assert found is not None
    return Library(program, found)


def in_both(name: str, hook: str) -> Callable[..., Any]:
    """The policy's function in Python, which checks each answer and all memory against C's."""
    function, pointer = getattr(policies.get(name), hook), HOOKS[hook]
    function = getattr(function, "py_func", function)

    seen = 0

    def asked(*arguments: Any) -> Any:
        nonlocal seen
        seen += 1
        if seen > MOST:
            return function(*arguments)
        memory = arguments[-1].copy()
        in_c = of_policies().call(symbol(name, hook), pointer, (*arguments[:-1], memory))
        answer = function(*arguments)
        assert answer == in_c
        np.testing.assert_array_equal(arguments[-1], memory)
        return answer

    return asked


@pytest.mark.parametrize("name", list(compiled_names()))
def test_every_policy_decides_and_remembers_the_same_in_c(name: str) -> None:
    policy = policies.get(name)
    # A function of five arguments takes any number, which ``Policy`` counts: so each has its own shape.
    arrival, departure, dequeue, send = (in_both(name, hook) for hook in HOOKS)
    spied = dataclasses.replace(policy, compile=False, on_arrival=lambda b, a, m: arrival(b, a, m))
    if policy.hears_departures:
        spied = dataclasses.replace(spied, on_departure=lambda b, m: departure(b, m))
    if policy.drops_at_dequeue:
        spied = dataclasses.replace(spied, on_dequeue=lambda b, m: dequeue(b, m))
    if policy.schedules:
        spied = dataclasses.replace(spied, on_send=lambda b, m: send(b, m))
    of = scenario.get("topics" if policy.for_topics else "interruption" if policy.privileged else "lte")
    episode = draw(of, 3)
    senders = Senders(1, 6, of.value, max_messages=of.max_messages, topics=of.topics)
    senders.load_all([(0, episode, None)])
    senders.run(spied)
    assert senders.batch.senders["next"][0] == len(episode.arrivals)


def arithmetic(a: int, b: int, x: float, y: float, out: Any) -> int:
    """Sums, divisions and roundings that C and Python do in different ways."""
    out[0], out[1], out[2] = a // b, a % b, x // y
    out[3], out[4], out[5] = x % y, math.floor(x), math.ceil(x)
    out[6], out[7], out[8] = min(x, y, a), max(a, b), a / b
    out[9], out[-1] = abs(a) + abs(x), int(y)
    n = 0
    for k in range(9, 0, -2):
        n += k if 0 < k < 7 or k == 9 else -k
    for value in out[2:4]:
        n += 1 if value > x else 0
    return n + len(out[1:-2])


@functools.cache
def in_c(function: Callable[..., Any], pointer: Pointer) -> Callable[..., Any]:
    """A function's C."""
    program, found = Program(), compiler.find()
    assert found is not None
    program.hook("made", function, pointer)
    library = Library(program, found)
    return lambda *arguments: library.call("made", pointer, arguments)


nonzero = st.integers(-(10**9), 10**9).filter(bool)
finite = st.floats(-1e9, 1e9).filter(lambda x: abs(x) > 1e-6)


@given(a=st.integers(-(10**12), 10**12), b=nonzero, x=finite, y=finite)
@settings(deadline=None)
def test_arithmetic_is_pythons(a: int, b: int, x: float, y: float) -> None:
    made = in_c(arithmetic, Pointer((INT, INT, FLOAT, FLOAT, MEMORY), INT))
    one, other = np.zeros(11), np.zeros(11)
    assert made(a, b, x, y, one) == arithmetic(a, b, x, y, other)
    np.testing.assert_array_equal(one[[0, 1, 3, 4, 5, 6, 7, 8, 9, 10]], other[[0, 1, 3, 4, 5, 6, 7, 8, 9, 10]])
    # Python's own // of floats takes the remainder away first.
    assert one[2] == math.floor(x / y)


def grow(numbers: Any) -> float:
    """Add one to the first number; return it."""
    numbers[0] += 1.0
    return float(numbers[0])


def ordered(numbers: Any) -> float:
    """Sums whose second part changes what the first has read."""
    total = numbers[0] + 10.0 * grow(numbers) + 100.0 * numbers[0]
    numbers[int(numbers[0])] = grow(numbers)
    numbers[0] += grow(numbers)
    return float(total + (1000.0 if numbers[0] < grow(numbers) <= numbers[0] else 0.0))


def names_of_c(x: float, bg_t1: int) -> float:
    """Variables with names that C or the translator has."""
    log, t1, i1, end1, double = math.log(x), 1.0, 2.0, 3.0, 4.0
    for k_x in range(bg_t1):
        t1 += k_x * max(log, i1) + end1 * double
    return math.log(x) + t1


def test_a_sum_is_read_from_left_to_right() -> None:
    made, one, other = in_c(ordered, Pointer((MEMORY,), FLOAT)), np.arange(9.0), np.arange(9.0)
    assert made(one) == ordered(other)
    np.testing.assert_array_equal(one, other)


def test_names_that_c_has_are_no_trouble() -> None:
    made = in_c(names_of_c, Pointer((FLOAT, INT), FLOAT))
    assert made(7.5, 4) == names_of_c(7.5, 4)


def makes_a_list(a: int) -> int:
    """It would allocate."""
    return len([a, a])


def calls_itself(a: int) -> int:
    """It has no end that a translator sees."""
    return calls_itself(a - 1) if a > 0 else 0


def writes_parameters(parameters: Any) -> None:
    """They are read-only."""
    parameters[0] = 1.0


def compares_by_is(a: int) -> bool:
    """Numbers have no identity."""
    return a is ARRIVAL


@pytest.mark.parametrize(
    ("function", "kind", "told"),
    [
        (makes_a_list, INT, "List is not part of the kernel language"),
        (calls_itself, INT, "calls_itself calls itself: write a loop"),
        (writes_parameters, array_kind(float, constant=True), "parameters is read-only"),
        (compares_by_is, INT, "``is`` asks for None only: compare numbers with =="),
    ],
)
def test_what_is_no_kernel_is_refused_with_its_file_and_line(function: Any, kind: Any, told: str) -> None:
    result = None if function is writes_parameters else INT
    with pytest.raises(KernelError) as error:
        Program().hook("made", function, Pointer((kind,), result))
    line = function.__code__.co_firstlineno + 2
    assert str(error.value).endswith(f"test_translator.py:{line}: kernel {function.__name__}: {told}")


def element(numbers: Any, k: int) -> float:
    """An index that may be anywhere."""
    return float(numbers[k + 1])


@pytest.mark.parametrize(("k", "told"), [(1, None), (2, "index outside"), (2**63 - 1, "too large for 64 bits")])
def test_a_checked_build_names_the_line_of_a_wrong_index_and_of_a_sum_too_large(
    k: int, told: str | None, tmp_path: Any
) -> None:
    program, found = Program(checked=True), compiler.find()
    assert found is not None
    program.entry("made", element, (MEMORY, INT))
    source = tmp_path / "checked.c"
    source.write_text(program.source())
    found.compile([source], tmp_path / "checked.so")
    call = ctypes.CDLL(str(tmp_path / "checked.so")).made
    call.restype = ctypes.c_char_p
    numbers = np.array([1.0, 2.0, 3.0])

    class Call(ctypes.Structure):
        _fields_ = [("p", ctypes.c_void_p), ("n", ctypes.c_int64), ("k", ctypes.c_int64), ("result", ctypes.c_double)]

    made = Call(numbers.ctypes.data, 3, k)
    fault = call(ctypes.byref(made))
    if told is None:
        assert fault is None
        assert made.result == 3.0
    else:
        line = element.__code__.co_firstlineno + 2
        assert f"test_translator.py:{line}: " in fault.decode()
        assert told in fault.decode()
