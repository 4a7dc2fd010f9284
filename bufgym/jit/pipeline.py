"""How Numba compiles kernels here: each is typed and translated once, and optimised only where Python calls it.

See docs/methods.md, "Kernels in parts".
"""

from types import CodeType
from typing import Any, cast

from numba import types
from numba.core import codegen, compiler, config, datamodel, untyped_passes

from bufgym.jit import announce
from bufgym.jit.none_fields import NoneFields

# Numba has no types.
_Compiler: Any = compiler.Compiler
_Library: Any = codegen.JITCodeLibrary
_Model: Any = datamodel.models.TupleModel

PART = {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""Numba's options for a part: only other kernels call it."""
_FOR_OTHERS = {
    "WithLifting",
    "InlineClosureLikes",
    "MakeFunctionToJitFunction",
    "InlineInlinables",
    "FindLiterallyCalls",
    "LiteralUnroll",
    "LiteralPropagationSubPipelinePass",
    "NopythonRewrites",
}
"""Numba's passes for what hardly any kernel has: see ``_is_plain``. The last is for arithmetic of whole arrays, which
would allocate."""
_MARKS = {"objmode", "parallel_chunksize", "literally", "literal_unroll"}


def _is_plain(code: CodeType) -> bool:
    """Whether a kernel has no function or comprehension inside it, and names nothing that needs a pass of its own."""
    return not (_MARKS.intersection(code.co_names) or any(isinstance(one, CodeType) for one in code.co_consts))


class KernelCompiler(_Compiler):  # type: ignore[misc]
    """Compiler of the kernels that Python calls, and of the parts that go into them, which are marked to be inlined."""

    def __init__(self, typing: Any, target: Any, library: Any, types: Any, result: Any, flags: Any, names: Any) -> None:
        library = (_PartLibrary if flags.forceinline else _WholeLibrary)(target.codegen(), "kernel")
        library.enable_object_caching()  # so that its machine code can be written to disk
        super().__init__(typing, target, library, types, result, flags, names)

    def define_pipelines(self) -> list[Any]:
        """Numba's own passes as far as a kernel needs them, and ``NoneFields`` before all that look at types."""
        (passes,) = super().define_pipelines()
        if _is_plain(self.state.func_id.code):
            passes.passes = [one for one in passes.passes if one[0].__name__ not in _FOR_OTHERS]
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


class _UnoptimisedLibrary(_Library):  # type: ignore[misc]
    """Code whose functions are not optimised one by one, as the whole is."""

    def _optimize_functions(self, module: Any) -> None:
        """Leave the functions as they are."""
        module.data_layout = self._codegen._data_layout


class _PartLibrary(_UnoptimisedLibrary):
    """Code of one part, neither optimised nor made into machine code."""

    def finalize(self) -> None:
        """Take no more code. What it calls is linked to the whole."""
        for library in self._linking_libraries:
            self._reload_init.update(library._reload_init)
        self._finalize_dynamic_globals()
        self._finalized = True

    @property
    def own_module(self) -> Any:
        """Its code alone; what it calls is elsewhere."""
        return super()._get_module_for_linking()

    def _get_module_for_linking(self) -> Any:
        """Its code and all that it calls, for a function in a kernel that Numba compiles in its own way."""
        module = self.own_module.clone()
        _link(module, self)
        return module

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


def _link(module: Any, caller: Any) -> None:
    """Add to ``module`` all that ``caller`` calls: each part once, by however many others it is called."""
    linked: set[Any] = set()
    waiting = list(caller._linking_libraries)
    while waiting:
        library = waiting.pop()
        if library not in linked:
            linked.add(library)
            is_part = isinstance(library, _PartLibrary)
            waiting += library._linking_libraries if is_part else ()
            module.link_in(library.own_module if is_part else library._get_module_for_linking(), preserve=True)


class _WholeLibrary(_UnoptimisedLibrary):
    """Code of a kernel that Python calls, with all its parts."""

    def finalize(self) -> None:
        """Link all parts, optimise, and make machine code."""
        for library in self._linking_libraries:
            self._reload_init.update(library._reload_init)
        _link(self._final_module, self)
        self._linking_libraries: list[Any] = []
        super().finalize()

    def _optimize_final_module(self) -> None:
        """Optimise once. Numba does so twice, before and after it prunes reference counts, and here are none."""
        passes, builder = self._codegen._module_pass_manager()
        passes.run(self._final_module, builder)


@cast(Any, datamodel).register_default(types.NamedTuple)
class _OneArgument(_Model):  # type: ignore[misc]
    """Hands a named tuple of this package on as one value; Numba hands a tuple of ten arrays on as seventy numbers."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind)
        if str(kind.instance_class.__module__).startswith("bufgym."):
            # Only ours: Numba's own code relies on its way for other tuples.
            self.get_argument_type = self.get_value_type
            self.as_argument = self.from_argument = lambda builder, value: value
