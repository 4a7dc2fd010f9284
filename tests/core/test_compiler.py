"""Plain Numba beside the pipeline: the same results, never stale, and taken with versions unknown to the pipeline."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from needs import needs

from bufgym.jit import JIT, way
from bufgym.utils.errors import BufgymError

REPO = Path(__file__).resolve().parents[2]
COMPILERS = way.PIPELINE, way.PLAIN
needs_compilation = pytest.mark.skipif(not JIT, reason=needs("compiled", "there is no compiler to choose"))


def python(folder: Path, source: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run ``source`` in a new process, whose code is cached in ``folder``."""
    program = folder / "program.py"
    program.write_text(source)
    settings = {**os.environ, "PYTHONPATH": str(REPO), "NUMBA_CACHE_DIR": str(folder / "code"), **environment}
    command = [sys.executable, "-B", str(program)]
    return subprocess.run(command, env=settings, cwd=folder, capture_output=True, text=True, check=False)


def printed(folder: Path, source: str, **environment: str) -> Any:
    """The JSON that ``source`` prints."""
    done = python(folder, source, **environment)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize(
    ("numba", "taken"),
    [
        ("0.62.1", "plain"),
        ("0.63.0", "pipeline"),
        ("0.68.1", "pipeline"),
        ("0.69.0rc1", "plain"),
        ("1.0.0", "plain"),
        ("0+untagged.1.gabc", "plain"),
        ("unknown", "plain"),
    ],
)
def test_a_version_that_the_pipeline_does_not_know_is_taken_plain(numba: str, taken: str) -> None:
    assert way.compiler("", numba) == taken
    assert [way.compiler(asked, numba) for asked in COMPILERS] == [*COMPILERS], "who asks for one gets it"


@needs_compilation
def test_a_process_with_an_unknown_version_compiles_plainly(tmp_path: Path) -> None:
    newer = """
import importlib.metadata, sys
version = importlib.metadata.version
importlib.metadata.version = lambda name: "0.70.0" if name == "numba" else version(name)
import bufgym.jit

@bufgym.jit.kernel
def double(k):
    return k + k

print(f'["{bufgym.jit.COMPILER}", {double(21)}, {int("bufgym.jit.pipeline" in sys.modules)}]')
"""
    assert printed(tmp_path, newer, BUFGYM_COMPILER="") == ["plain", 42, 0]


def test_an_unknown_compiler_is_told_in_one_sentence() -> None:
    with pytest.raises(BufgymError, match=r"^BUFGYM_COMPILER: unknown compiler 'plan'; did you mean 'plain'\?$"):
        way.compiler("plan", "0.68.1")


@needs_compilation
def test_a_command_tells_it_too(tmp_path: Path) -> None:
    done = python(tmp_path, "import bufgym.cli, sys\nsys.exit(bufgym.cli.main(['policies']))", BUFGYM_COMPILER="gcc")
    assert done.returncode and "BUFGYM_COMPILER: unknown compiler 'gcc'; known: pipeline, plain" in done.stderr


KERNELS = """
import json
from typing import NamedTuple
import numba, numpy as np
from bufgym import jit
from bufgym.jit import kernel, unchecked_at, unchecked_item, unchecked_slice, unchecked_table

class Numbers(NamedTuple):
    of: np.ndarray
    few: object = None
    several: object = None

@kernel
def third(array):
    return unchecked_item(array, 2)

@kernel
def corner(table, i):
    jit.prefetch(table, i, 0)
    rows = unchecked_table(unchecked_slice(table, i, 1, 6), 2, 3)  # rows 1..3 and 4..6 of the row's 7 numbers
    return 1000 * unchecked_at(table, i, 6) + 100 * rows[1, 2] + rows[0, 1] + unchecked_slice(table, i, 5, 2)[0]

@kernel
def total(numbers):
    if numbers.several is not None:
        return numbers.several[0]  # no code for a tuple without them
    return numbers.of[0]

@kernel
def outer(numbers, few, several):
    return total(numbers) + (1 if few is None else few)

def scaled(number):
    return 3.0 * number

@kernel
def applied(function, number):
    return function(number)

@numba.njit
def users_own(a, b):
    return max(min(a, b), 0) + abs(b)

@kernel
def mixed(a, b):
    def inner(c):
        return c + a
    return inner(users_own(a, b)) + max(a, b) + int(1.5)

table = np.arange(14.0).reshape(2, 7)
strided = np.arange(10.0)[::2]
real = numba.types.float64
function = jit.compile_signature(real(real), scaled)
directly = jit.without_dispatch(outer)
print(json.dumps([
    third(strided),
    corner(table, 1),
    outer(Numbers(np.array([7.0])), None, None),
    outer(Numbers(np.array([7.0]), None, np.array([8.0])), several=None, few=5),
    directly(Numbers(np.array([9.0])), None, None),
    jit.entry_point_of(function)(2.0),
    applied(jit.with_address(real(real), function), 4.0),
    mixed(3, -2),
    users_own(3, 2),
]))
"""


@needs_compilation
@pytest.mark.parametrize("compiler", [pytest.param(way.PIPELINE, marks=pytest.mark.nightly), way.PLAIN])
def test_all_that_kernels_do_works_in_each_way(compiler: str, tmp_path: Path) -> None:
    """Row 1 is 7, 8, ... 13: its last number 13 a thousandfold, 13 a hundredfold, then 9 and 12.

    A user's own function in a kernel is compiled by Numba in its own way, and the same function apart from it too.
    """
    results = [4, 13_000 + 1_300 + 9 + 12, 7 + 1, 8 + 5, 9 + 1, 6, 12, (0 + 2) + 3 + 3 + 1, 2 + 2]
    assert printed(tmp_path, KERNELS, BUFGYM_COMPILER=compiler) == results
    cached = KERNELS.replace("print(", "with jit.cached_only(): print(").replace(
        "function = jit.comp", "with jit.cached_only(): function = jit.comp"
    )
    assert printed(tmp_path, cached, BUFGYM_COMPILER=compiler) == results
    (tmp_path / "elsewhere").mkdir()
    assert "NotCachedError" in python(tmp_path / "elsewhere", cached, BUFGYM_COMPILER=compiler).stderr


STEPS = """
import hashlib, json
import gymnasium, bufgym

batch = gymnasium.make_vec(
    "bufgym/Uplink-v0", 4, vectorization_mode="vector_entry_point", capacity=8, observation="flat"
)
seen, (observation, info) = hashlib.sha256(), batch.reset(seed=1)
for step in range(300):
    seen.update(observation.tobytes())
    # The first action that is valid, or the last.
    actions = info["action_mask"].argmax(axis=1) if step % 3 else 2 - info["action_mask"][:, ::-1].argmax(axis=1)
    observation, reward, *_, info = batch.step(actions)
    seen.update(reward.tobytes())
print(json.dumps([seen.hexdigest(), float(observation.sum(dtype=float))]))
"""


@needs_compilation
@pytest.mark.nightly
def test_both_ways_step_alike_to_the_bit(tmp_path: Path) -> None:
    one, other = (printed(tmp_path, STEPS, BUFGYM_COMPILER=compiler) for compiler in COMPILERS)
    assert one == other


LEAF = """
from typing import NamedTuple
from bufgym.jit import kernel

FACTOR = 2

class Pair(NamedTuple):
    first: int
    second: int

@kernel
def leaf(k):
    return k * FACTOR
"""
ROOT = """
from branch import branch
from leaf import Pair, kernel

@kernel
def root(k, pair):
    return branch(k) + pair.first

print(root(10, Pair(1, 3)))
"""


@needs_compilation
@pytest.mark.parametrize(
    ("before", "after", "result"),
    [
        ("return k * FACTOR", "return k - FACTOR", 10 - 2 + 1),
        pytest.param("FACTOR = 2", "FACTOR = 4", 10 * 4 + 1, marks=pytest.mark.nightly),
        pytest.param(
            "first: int\n    second: int", "second: int\n    first: int", 10 * 2 + 3, marks=pytest.mark.nightly
        ),
    ],
    ids=["callee two levels down", "constant", "fields of a tuple"],
)
def test_plain_numba_never_runs_code_of_an_edited_source(before: str, after: str, result: int, tmp_path: Path) -> None:
    """Numba's own cache looks at the file of ``root`` alone, and none of these edits is there."""
    (tmp_path / "branch.py").write_text(
        "from leaf import kernel, leaf\n\n@kernel\ndef branch(k):\n    return leaf(k)\n"
    )

    def edited(leaf: str) -> Any:
        (tmp_path / "leaf.py").write_text(leaf)
        return printed(tmp_path, ROOT, BUFGYM_COMPILER="plain")

    assert LEAF.count(before) == 1
    assert [edited(LEAF), edited(LEAF.replace(before, after)), edited(LEAF)] == [21, result, 21]
    assert len(list((tmp_path / "code").rglob("*root*.nbc"))) == 2, "the third run found the first one's code"
