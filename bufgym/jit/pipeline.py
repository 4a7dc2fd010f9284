"""How Numba compiles kernels here: each is typed and translated once, and optimised only where Python calls it.

See docs/methods.md, "Kernels in parts".
"""

from typing import Any, cast

from numba import types
from numba.core import codegen, compiler, config, datamodel, untyped_passes

from bufgym.jit import announce
from bufgym.jit.none_fields import NoneFields

# Numba has no types.
_Compiler: Any = compiler.Compiler
_Library: Any = codegen.JITCodeLibrary
_Model: Any = datamodel.models.TupleModel


class KernelCompiler(_Compiler):  # type: ignore[misc]
    """Compiler of the kernels that Python calls, and of the parts that go into them, which are marked to be inlined."""

    def __init__(self, typing: Any, target: Any, library: Any, types: Any, result: Any, flags: Any, names: Any) -> None:
        if flags.forceinline:
            library = _PartLibrary(target.codegen(), "part")
        super().__init__(typing, target, library, types, result, flags, names)

    def define_pipelines(self) -> list[Any]:
        """Numba's own passes, and ``NoneFields`` before all that look at types."""
        (passes,) = super().define_pipelines()
        passes.add_pass_after(NoneFields, untyped_passes.IRProcessing)
        passes.finalize()
        return [passes]

    def compile_extra(self, function: Any) -> Any:
        """Compile ``function``; Numba calls it with its compiler's lock held."""
        if self.state.flags.forceinline:
            return super().compile_extra(function)
        numbas = cast(Any, config)
        level = numbas.OPT
        with announce.compiling():
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
