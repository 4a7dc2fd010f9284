"""How Numba types calls in kernels: each case once, and its own functions as parts of the kernel.

To type a sum or an index, Numba tries dozens of templates, and writes an error for each that does not fit.
"""

import functools
from collections.abc import Callable
from typing import Any

from numba.core.targetconfig import ConfigStack
from numba.core.types.functions import BaseFunction
from numba.core.typing import templates

from bufgym.jit.pipeline import PART, KernelCompiler

# Numba has no types.
_Function: Any = BaseFunction
_Overload: Any = templates._OverloadFunctionTemplate
_Stack: Any = ConfigStack

_type_call: Callable[..., Any] = _Function.get_call_type
_jit_of: Callable[..., Any] = _Overload._get_jit_decorator
_typed: dict[Any, Any] = {}  # (function, types of its arguments) -> signature


def _type_call_once(function: Any, context: Any, arguments: Any, named: Any) -> Any:
    """Numba's ``get_call_type``, asked once for each case.

    A function that is written in Python is left out: it has a form for each set of options.
    """
    case = function.key, arguments, tuple(named.items())
    signature = _typed.get(case)
    if signature is None:
        signature = _type_call(function, context, arguments, named)
        if function._impl_keys.get(signature.args) is function.typing_key:
            _typed[case] = signature
    else:
        function._impl_keys[signature.args] = function.typing_key
    return signature


def _jit_as_part(template: Any) -> Any:
    """Numba's ``_get_jit_decorator`` of a function that is written in Python, such as ``min``; in kernels for a part.

    Numba compiles each with entries from Python and C, and so optimises it and makes machine code of it.
    """
    jit, flags = _jit_of(template), _Stack.top_or_none()
    # Only kernels have no reference counts. Their forms are kept apart from others, by the same flags.
    in_kernel = flags is not None and not flags.nrt
    return functools.partial(jit, pipeline_class=KernelCompiler, **PART) if in_kernel else jit


# Both are called with the compiler's lock held.
_Function.get_call_type = _type_call_once
_Overload._get_jit_decorator = _jit_as_part
