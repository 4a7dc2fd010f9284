"""Code of the functions of ``arrays`` in kernels: without the checks that Numba adds to every index.

It keeps to what Numba's documentation of extensions shows, and so serves versions that the pipeline does not know.
"""

from collections.abc import Callable
from typing import Any, cast

import numba
import numba.extending
from llvmlite import ir
from numba.core import cgutils

from bufgym.jit.arrays import prefetch, unchecked_at, unchecked_item, unchecked_slice, unchecked_table

_BYTE = ir.IntType(8).as_pointer()


def _opened(context: Any, builder: Any, kind: Any, *value: Any) -> Any:
    """Fields of an array of this kind: of ``value``, or of a new one."""
    return cast(Any, cgutils).create_struct_proxy(kind)(context, builder, *value)


def _place(context: Any, builder: Any, kind: Any, array: Any, indices: Any) -> Any:
    """LLVM's pointer to the element of ``array`` at ``indices``."""
    whole = _opened(context, builder, kind, array)
    lengths = [builder.extract_value(whole.shape, axis) for axis in range(kind.ndim)]
    if kind.layout == "C":
        number = indices[0]
        for index, length in zip(indices[1:], lengths[1:], strict=True):
            number = builder.add(builder.mul(number, length), index)
        return builder.gep(whole.data, [number])
    place = builder.bitcast(whole.data, _BYTE)
    for axis, index in enumerate(indices):
        place = builder.gep(place, [builder.mul(index, builder.extract_value(whole.strides, axis))])
    return builder.bitcast(place, whole.data.type)


def _read(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """LLVM's code of ``unchecked_item`` and ``unchecked_at``."""
    kind, (array, *indices) = signature.args[0], arguments
    return context.unpack_value(builder, kind.dtype, _place(context, builder, kind, array, indices))


def _view(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """LLVM's code of ``unchecked_slice`` and ``unchecked_table``."""
    kind, array = signature.args[0], arguments[0]
    # The first one's arguments are array, i, first and length, the other's are array, rows and columns.
    start, shape = ((*arguments[1:3],), arguments[3:]) if kind.ndim == 2 else ((), arguments[1:])
    whole, view = _opened(context, builder, kind, array), _opened(context, builder, signature.return_type)
    # Strides of an array in C order, bytes.
    strides = [*(builder.mul(columns, whole.itemsize) for columns in shape[1:]), whole.itemsize]
    view.data = _place(context, builder, kind, array, start) if start else whole.data
    view.shape, view.strides = (cast(Any, cgutils).pack_array(builder, numbers) for numbers in (shape, strides))
    view.nitems = shape[0] if len(shape) == 1 else builder.mul(*shape)
    view.itemsize, view.meminfo, view.parent = whole.itemsize, whole.meminfo, whole.parent
    return view._getvalue()


def _hint(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """LLVM's code of ``prefetch``."""
    place = _place(context, builder, signature.args[0], arguments[0], arguments[1:])
    number = ir.IntType(32)
    hint = ir.FunctionType(ir.VoidType(), [_BYTE, number, number, number])
    function = builder.module.declare_intrinsic("llvm.prefetch.p0", fnty=hint)
    # 1: it will be written; 3: keep it near; 1: data, not code
    builder.call(function, [builder.bitcast(place, _BYTE), number(1), number(3), number(1)])
    return context.get_dummy_value()


def _compile_as(function: Callable[..., Any], typer: Callable[..., Any], code: Callable[..., Any]) -> None:
    """Make Numba compile calls of ``function`` to ``code``; ``typer`` gives the type of the result."""
    numba_ = cast(Any, numba)
    numba_.extending.type_callable(function)(lambda context: typer)
    numba_.extending.lower_builtin(function, numba_.types.Array, numba_.types.VarArg(numba_.types.Any))(code)


_compile_as(unchecked_item, lambda array, k: array.dtype, _read)
_compile_as(unchecked_at, lambda array, i, k: array.dtype, _read)
_compile_as(unchecked_slice, lambda array, i, first, length: array.copy(ndim=1), _view)
_compile_as(unchecked_table, lambda array, rows, columns: array.copy(ndim=2, layout="C"), _view)
_compile_as(prefetch, lambda array, i, k: numba.types.void, _hint)
