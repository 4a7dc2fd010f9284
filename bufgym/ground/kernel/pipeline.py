"""How Numba compiles kernels here: each is typed and translated once, and optimised only where Python calls it.

See docs/methods.md, "Kernels in parts".
"""

from typing import Any, cast

from llvmlite import binding
from numba import types
from numba.core import codegen, compiler, datamodel

from bufgym.ground.kernel.none_fields import with_none_fields

PART = "part"  # Marks a part among the code that is kept on disk

# Numba has no types.
_Library: Any = codegen.JITCodeLibrary
_Compiler: Any = compiler.Compiler
_Model: Any = datamodel.models.TupleModel


class PartLibrary(_Library):  # type: ignore[misc]
    """Code of one part and of the parts that it calls, neither optimised nor made into machine code."""

    def finalize(self) -> None:
        """Link the parts that it calls. After this call nothing can be added."""
        self._raise_if_finalized()
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
        """Ignore the environment: ``set_environments`` sets it in the kernel that the part is linked into."""

    def get_pointer_to_function(self, name: str) -> int:
        """Address of the function ``name``: 0, as a part has no machine code."""
        self._ensure_finalized()
        return 0

    def serialize_using_object_code(self) -> tuple[str, str, bytes]:
        """(name, ``PART``, bitcode), the form stored on disk."""
        self._ensure_finalized()
        return self.name, PART, self._final_module.as_bitcode()

    @classmethod
    def read(cls, target: Any, kept: tuple[str, str, bytes]) -> Any:
        """Restore the part from ``kept``, the output of ``serialize_using_object_code``."""
        name, _, bitcode = kept
        library = cls(target.codegen(), name)
        library._final_module = binding.parse_bitcode(bitcode)
        library._finalized = True
        return library


def set_environments(result: Any) -> None:
    """Tell the machine code of ``result`` where the Python objects are that its parts use, such as texts to print."""
    for environment in result._find_referenced_environments():
        result.codegen.set_env(environment.env_name, environment)


@cast(Any, datamodel).register_default(cast(Any, types).NamedTuple)
class _OneArgument(_Model):  # type: ignore[misc]
    """Hands a named tuple of this package on as one value; Numba hands a tuple of ten arrays on as seventy numbers."""

    def _is_ours(self) -> bool:
        return str(self.fe_type.instance_class.__module__).startswith("bufgym.")

    def get_argument_type(self) -> Any:
        return self.get_value_type() if self._is_ours() else super().get_argument_type()

    def as_argument(self, builder: Any, value: Any) -> Any:
        return value if self._is_ours() else super().as_argument(builder, value)

    def from_argument(self, builder: Any, value: Any) -> Any:
        return value if self._is_ours() else super().from_argument(builder, value)


class WholeCompiler(_Compiler):  # type: ignore[misc]
    """Compiler of the kernels that Python calls."""

    library: Any = _Library

    def __init__(
        self, typing: Any, target: Any, library: Any, arguments: Any, result: Any, flags: Any, names: Any
    ) -> None:
        super().__init__(typing, target, library, arguments, result, flags, names)
        self.state.library = self.library(target.codegen(), type(self).__name__)
        self.state.library.enable_object_caching()

    def define_pipelines(self) -> list[Any]:
        """Numba's own passes and this package's."""
        (passes,) = super().define_pipelines()
        return [with_none_fields(passes)]


class PartCompiler(WholeCompiler):
    """Compiler of the kernels that go into others."""

    library = PartLibrary
