"""A pass of the compiler: fields of named tuples that are None are known to be None at compile time."""

from typing import Any, cast

from numba import types
from numba.core import ir, ir_utils, untyped_passes
from numba.core.compiler_machinery import FunctionPass, register_pass

_Pass: Any = FunctionPass


@cast(Any, register_pass)(mutates_CFG=True, analysis_only=False)
class NoneFields(_Pass):  # type: ignore[misc]  # Numba has no types
    """Turns reads of arguments' fields that are None into None."""

    _name = "bufgym_none_fields"

    def __init__(self) -> None:
        super().__init__()

    def run_pass(self, state: Any) -> bool:
        """Change the code of one kernel in place; return whether it changed."""
        changed = False
        for block in state.func_ir.blocks.values():
            for statement in block.find_insts(ir.Assign):
                read = statement.value
                if not (isinstance(read, ir.Expr) and cast(Any, read).op == "getattr"):
                    continue
                source = cast(Any, ir_utils).guard(ir_utils.get_definition, state.func_ir, read.value)
                kind = state.args[source.index] if isinstance(source, ir.Arg) else None
                fields = getattr(getattr(kind, "instance_class", None), "_fields", ())
                if read.attr in fields and cast(Any, kind).types[fields.index(read.attr)] is types.none:
                    statement.value = cast(Any, ir).Const(None, statement.loc)
                    state.func_ir._definitions[statement.target.name] = [statement.value]
                    changed = True
        return changed


def with_none_fields(passes: Any) -> Any:
    """``passes``, with ``NoneFields`` before all that look at types."""
    passes.add_pass_after(NoneFields, untyped_passes.IRProcessing)
    passes.finalize()
    return passes
