"""Code of the functions of ``arrays`` in kernels: without the checks that Numba adds to every index."""

from collections.abc import Callable
from typing import Any, cast

import numba
import numba.extending
from llvmlite import ir
from numba.core import cgutils
from numba.np import arrayobj

from bufgym.jit.arrays import prefetch, unchecked_at, unchecked_item, unchecked_slice, unchecked_table


def _place(context: Any, builder: Any, signature: Any, arguments: Any, indices: Any) -> Any:
    """LLVM's pointer to the element of the first argument, an array, at ``indices``."""
    kind = signature.args[0]
    view = context.make_array(kind)(context, builder, arguments[0])
    # wraparound: whether a negative index counts from the end, which costs a branch at each access.
    return cast(Any, cgutils).get_item_pointer(context, builder, kind, view, list(indices), wraparound=False)


def _read(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """LLVM's code of ``unchecked_item`` and ``unchecked_at``."""
    place = _place(context, builder, signature, arguments, arguments[1:])
    return cast(Any, arrayobj).load_item(context, builder, signature.args[0], place)


def _view(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """LLVM's code of ``unchecked_slice`` and ``unchecked_table``."""
    whole = context.make_array(signature.args[0])(context, builder, arguments[0])
    place = _place(context, builder, signature, arguments, arguments[1:3])
    view = context.make_array(signature.return_type)(context, builder)
    size, shape = whole.itemsize, list(arguments[3:])
    # Strides of an array in C order, bytes.
    steps = [*(builder.mul(columns, size) for columns in shape[1:]), size]
    cast(Any, arrayobj).populate_array(view, place, shape, steps, size, whole.meminfo, whole.parent)
    return view._getvalue()


def _hint(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """LLVM's code of ``prefetch``."""
    place = _place(context, builder, signature, arguments, arguments[1:])
    number, byte = ir.IntType(32), ir.IntType(8).as_pointer()
    hint = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
    function = cast(Any, cgutils).get_or_insert_function(builder.module, hint, "llvm.prefetch.p0")
    # 1: it will be written; 3: keep it near; 1: data, not code
    builder.call(function, [builder.bitcast(place, byte), number(1), number(3), number(1)])
    return context.get_dummy_value()


def _compile_as(function: Callable[..., Any], typer: Callable[..., Any], code: Callable[..., Any]) -> None:
    """Make Numba compile calls of ``function`` to ``code``; ``typer`` gives the type of the result."""
    numba_ = cast(Any, numba)
    numba_.extending.type_callable(function)(lambda context: typer)
    numba_.extending.lower_builtin(function, numba_.types.Array, numba_.types.VarArg(numba_.types.Any))(code)


_compile_as(unchecked_item, lambda array, k: array.dtype, _read)
_compile_as(unchecked_at, lambda array, i, k: array.dtype, _read)
_compile_as(unchecked_slice, lambda array, i, first, length: array.copy(ndim=1), _view)
_compile_as(unchecked_table, lambda array, i, first, rows, columns: array.copy(ndim=2), _view)
_compile_as(prefetch, lambda array, i, k: numba.types.void, _hint)
