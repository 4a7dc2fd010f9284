"""Elements and stretches of arrays in kernels, without what Python's indexing asks: whether an index is negative.

The caller guarantees that indices are >= 0 and slices lie inside the array. To look at the sign of every index and at
the ends of every slice is a fifth of a rollout's instructions.
"""

from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from bufgym.jit.way import JIT

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


def records(shape: int | tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Zeroed records whose fields read as attributes (``a[i].field``) in kernels, compiled or not."""
    zeros = np.zeros(shape, dtype)
    return zeros if JIT else zeros.view(np.recarray)


Arrays = TypeVar("Arrays", bound=NamedTuple)


def named(arrays: Arrays) -> Arrays:
    """The same memory, as records whose fields read as attributes in plain Python too."""
    made: Arrays = cast(Any, type(arrays))(*map(readable, cast(Any, arrays)))
    return made


def readable(value: Any) -> Any:
    """A value whose records are read by attributes in plain Python, also within a tuple of arrays."""
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return named(cast(Any, value))
    if isinstance(value, np.ndarray) and value.dtype.names:
        return value.view(np.recarray)
    return value.view((np.record, value.dtype)) if type(value) is np.void else value


def unchecked_item(array: NDArray[Any], k: int) -> Any:
    """``array[k]``."""
    return array[k]


def unchecked_at(array: NDArray[Any], i: int, k: int) -> Any:
    """``array[i, k]``."""
    return array[i, k]


def unchecked_slice(array: NDArray[Any], i: int, first: int, length: int) -> Any:
    """``array[i, first : first + length]`` of an array in C order."""
    return array[i, first : first + length]


def unchecked_table(array: NDArray[Any], rows: int, columns: int) -> Any:
    """``array[: rows * columns]`` as rows x columns, of an array of one axis whose numbers lie side by side."""
    return array[: rows * columns].reshape(rows, columns)


def prefetch(array: NDArray[Any], i: int, k: int = 0) -> None:
    """Ask the processor to fetch ``array[i, k]``, or ``array[i]`` of one axis, into its cache, and do not wait for it.

    Plain Python does nothing.
    """
