"""Short ways to call compiled functions, without Numba's look at them or at the types of their arguments."""

import functools
from typing import Any, cast

import numba
from numba.core import types


def entry_point_of(compiled: Any) -> Any:
    """The plain code of a ``compile_signature`` result, for callers that pass exactly the types of its signature.

    To find the code for its arguments, Numba looks at every array of every tuple at each call: 3 us, and ten times that
    with functions among them. Here nobody looks, so wrong types go unnoticed.
    """
    (overload,) = compiled.overloads.values()
    return overload.entry_point


def without_dispatch(compiled: Any) -> Any:
    """A ``kernel`` over a batch that Python calls for every step, without a look at the types of its arguments.

    It has two arguments or more. Calls with equal ``batch.several``, and None as the same of the last two arguments,
    have arguments of equal types.
    """
    entries: dict[tuple[bool | None, bool, bool], Any] = {}

    @functools.wraps(compiled.py_func)
    def call(*arguments: Any) -> Any:
        kind = arguments[0].several, arguments[-1] is None, arguments[-2] is None
        if kind not in entries:
            entries[kind] = compiled.compile(tuple(map(cast(Any, numba).typeof, arguments)))
        return entries[kind](*arguments)

    cast(Any, call).py_func = compiled.py_func
    return call


class _Located(types.WrapperAddressProtocol):
    """A compiled function together with the address of its machine code."""

    def __init__(self, signature: Any, compiled: Any) -> None:
        self._numba_type_ = types.FunctionType(signature)
        self._signature = signature
        self._compiled = compiled  # the address is valid only as long as this lives
        (overload,) = compiled.overloads.values()
        self._address = int(overload.library.get_pointer_to_function(overload.fndesc.llvm_cfunc_wrapper_name))

    def __wrapper_address__(self) -> int:
        return self._address

    def signature(self) -> Any:
        return self._signature


def with_address(signature: Any, compiled: Any) -> Any:
    """A ``compile_signature`` result for short calls: Numba looks up its address here, not at each call.

    That saves 0.1 ms a function; in return the kernel's calls of it are slower, by a few ns.
    """
    return _Located(signature, compiled)
