"""A program of kernels, compiled and loaded, whose functions tests call by name."""

import ctypes
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bufgym.kernels.compiler import Compiler, library_suffix
from bufgym.kernels.kinds import BOOL, FLOAT, INT, NONE, Array, KernelError, Kind, Number, Pointer, Record, Tuple
from bufgym.kernels.program import Program

_C: dict[Any, Any] = {INT: ctypes.c_int64, FLOAT: ctypes.c_double, BOOL: ctypes.c_bool, None: None}


def _in_c(value: Any, kind: Kind) -> Any:
    """A Python value as C has it. Arrays and records are the same memory, so the caller keeps them alive."""
    if isinstance(kind, Number):
        return _C[kind](value)
    if isinstance(kind, Tuple):
        parts = [_in_c(part, item) for part, item in zip(value, kind.items, strict=True) if item is not NONE]
        fields = [(f"item{k}", type(part)) for k, part in enumerate(parts)]
        return type("Struct", (ctypes.Structure,), {"_fields_": fields})(*parts)
    if isinstance(kind, Record):
        return ctypes.c_void_p(np.asarray(value).__array_interface__["data"][0])
    assert isinstance(kind, Array)
    if value.ndim != kind.axes or not value.flags.c_contiguous:
        raise KernelError(f"an array has {value.ndim} axes: must have {kind.axes}, in C order")
    fields = [("p", ctypes.c_void_p), *((f"n{axis}", ctypes.c_int64) for axis in range(kind.axes))]
    made = type("Array", (ctypes.Structure,), {"_fields_": fields})
    return made(value.__array_interface__["data"][0], *value.shape)


class Library:
    """A program, compiled and loaded."""

    def __init__(self, program: Program, compiler: Compiler) -> None:
        with tempfile.TemporaryDirectory(prefix="bufgym-") as folder:
            source, library = Path(folder, "kernels.c"), Path(folder, f"kernels{library_suffix()}")
            source.write_text(program.source(), encoding="utf-8")
            compiler.compile([source], library)
            self._loaded = ctypes.CDLL(str(library))

    def call(self, symbol: str, pointer: Pointer, arguments: Sequence[Any]) -> Any:
        """Call the ``hook`` of that name; ``pointer`` is its kind."""
        function = getattr(self._loaded, symbol)
        function.restype = _C[pointer.result]
        made = [_in_c(value, kind) for value, kind in zip(arguments, pointer.arguments, strict=True)]
        handed = [ctypes.byref(x) if isinstance(k, Tuple) else x for x, k in zip(made, pointer.arguments, strict=True)]
        return function(*handed)
