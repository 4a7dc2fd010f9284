"""How Numba compiles kernels here: each is typed and translated once, and optimised only where Python calls it.

See docs/methods.md, "Kernels in parts".
"""

import operator
from typing import Any, cast

from numba import types
from numba.core import codegen, compiler, config, datamodel, ir, ir_utils, untyped_passes
from numba.core.compiler_machinery import FunctionPass, register_pass

from bufgym.jit import announce

# Numba has no types.
_Compiler: Any = compiler.Compiler
_Library: Any = codegen.JITCodeLibrary
_Model: Any = datamodel.models.TupleModel
_Pass: Any = FunctionPass


class KernelCompiler(_Compiler):  # type: ignore[misc]
    """Compiler of the kernels that Python calls, and of the parts that go into them, which are marked to be inlined."""

    def __init__(self, typing: Any, target: Any, library: Any, types: Any, result: Any, flags: Any, names: Any) -> None:
        if flags.forceinline:
            library = _PartLibrary(target.codegen(), "part")
        super().__init__(typing, target, library, types, result, flags, names)

    def define_pipelines(self) -> list[Any]:
        """Numba's own passes, and ``_NoneFields`` before all that look at types."""
        (passes,) = super().define_pipelines()
        passes.add_pass_after(_NoneFields, untyped_passes.IRProcessing)
        passes.finalize()
        return [passes]

    def compile_extra(self, function: Any) -> Any:
        """Compile ``function``; Numba calls it with its compiler's lock held."""
        if self.state.flags.forceinline:
            return super().compile_extra(function)
        numbas = cast(Any, config)
        level = numbas.OPT
        with announce.if_long():
            try:
                # A global of Numba's, safe to set while the compiler's lock is held.
                numbas.OPT = 2  # LLVM's level; 3 takes longer, and the code is no faster
                result = super().compile_extra(function)
            finally:
                numbas.OPT = level
        for environment in result._find_referenced_environments():  # of Python objects that parts use, such as texts
            result.codegen.set_env(environment.env_name, environment)
        return result


class _PartLibrary(_Library):  # type: ignore[misc]
    """Code of one part and of the parts that it calls, neither optimised as a whole nor made into machine code."""

    def finalize(self) -> None:
        """Link the parts that it calls. After this call nothing can be added."""
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalize_dynamic_globals()
        self._finalized = True

    @property
    def codegen(self) -> Any:
        """Where Numba sets the environments of functions: here, to no effect, as a part has no machine code."""
        return self

    def set_env(self, name: str, environment: Any) -> None:
        """Ignore the environment: the kernel that the part is linked into sets it."""

    def get_pointer_to_function(self, name: str) -> int:
        """Address of the function ``name``: 0, as a part has no machine code."""
        self._ensure_finalized()
        return 0


@cast(Any, datamodel).register_default(types.NamedTuple)
class _OneArgument(_Model):  # type: ignore[misc]
    """Hands a named tuple of this package on as one value; Numba hands a tuple of ten arrays on as seventy numbers."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind)
        if str(kind.instance_class.__module__).startswith("bufgym."):
            # Only ours: Numba's own code relies on its way for other tuples.
            self.get_argument_type = self.get_value_type
            self.as_argument = self.from_argument = lambda builder, value: value


@cast(Any, register_pass)(mutates_CFG=True, analysis_only=False)
class _NoneFields(_Pass):  # type: ignore[misc]
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
