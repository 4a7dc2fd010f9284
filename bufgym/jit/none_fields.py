"""A pass of Numba's compiler that settles which arguments, and which of their fields, are None.

Numba itself does so for arguments alone, and not for fields of named tuples. It documents how to add a pass.
"""

import operator
from typing import Any, cast

from numba import types
from numba.core import ir, ir_utils
from numba.core.compiler_machinery import FunctionPass, register_pass

_Pass: Any = FunctionPass  # Numba has no types.


@cast(Any, register_pass)(mutates_CFG=True, analysis_only=False)
class NoneFields(_Pass):  # type: ignore[misc]
    """A pass that settles which arguments, and which of their fields, are None, so that Numba drops the other branch.

    It turns reads of fields that are None into None, and questions ``x is None`` of all others into their answer.
    """

    _name = "bufgym_none_fields"

    def __init__(self) -> None:
        super().__init__()

    def run_pass(self, state: Any) -> bool:
        """Change the code of one kernel in place; return whether it changed."""
        changed = False
        for block in state.func_ir.blocks.values():
            for statement in block.find_insts(ir.Assign):
                known = _known(state, statement.value)
                if known is not _UNKNOWN:
                    statement.value = cast(Any, ir).Const(known, statement.loc)
                    # Numba looks definitions up apart from the blocks: both must say the same.
                    state.func_ir._definitions[statement.target.name] = [statement.value]
                    changed = True
        return changed


_UNKNOWN = object()


def _known(state: Any, value: Any) -> Any:
    """What an expression is known to be before types are inferred: None, True or False; else ``_UNKNOWN``."""
    if isinstance(value, ir.Expr):
        read: Any = value
        if read.op == "getattr" and _kind(state, read) is types.none:
            return None
        if read.op == "binop" and read.fn in (operator.is_, operator.is_not):
            asked, other = (
                cast(Any, ir_utils).guard(ir_utils.get_definition, state.func_ir, x) for x in (read.lhs, read.rhs)
            )
            kind = _kind(state, asked)
            may_be_none = isinstance(kind, types.NoneType | types.Omitted | types.Optional)
            if kind is not None and not may_be_none and isinstance(other, ir.Const) and cast(Any, other).value is None:
                return read.fn is operator.is_not
    return _UNKNOWN


def _kind(state: Any, value: Any) -> Any:
    """The type of a definition that is an argument or a field of one; None for others."""
    if isinstance(value, ir.Arg):
        return state.args[cast(Any, value).index]
    if isinstance(value, ir.Expr) and cast(Any, value).op == "getattr":
        read: Any = value
        source = cast(Any, ir_utils).guard(ir_utils.get_definition, state.func_ir, read.value)
        kind = state.args[source.index] if isinstance(source, ir.Arg) else None
        fields = getattr(getattr(kind, "instance_class", None), "_fields", ())
        if read.attr in fields:
            return cast(Any, kind).types[fields.index(read.attr)]
    return None
