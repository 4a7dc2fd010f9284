"""Kernels that go into other kernels: typed and translated once, optimised only inside the kernel that Python calls.

Numba by default optimises every kernel together with all that it calls, and makes machine code of it: of a hundred
kernels that call one another the innermost is optimised a hundred times. The code of a *part* is kept as it comes out
of the translation. The kernel that Python calls links its parts, inlines them and optimises the whole, once.
"""

from __future__ import annotations

from typing import Any

from llvmlite import binding
from numba.core import codegen, compiler

PART = "part"
"""Marks a part among the code that is kept on disk."""
_Library: Any = codegen.JITCodeLibrary
_Compiler: Any = compiler.Compiler


class PartLibrary(_Library):  # type: ignore[misc]  # Numba has no types
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
        """(name, ``PART``, bitcode): the form in which it is kept on disk."""
        self._ensure_finalized()
        return self.name, PART, self._final_module.as_bitcode()

    @classmethod
    def read(cls, target: Any, kept: tuple[str, str, bytes]) -> Any:
        """The part that ``serialize_using_object_code`` gave as ``kept``."""
        name, _, bitcode = kept
        library = cls(target.codegen(), name)
        library._final_module = binding.parse_bitcode(bitcode)
        library._finalized = True
        return library


class PartCompiler(_Compiler):  # type: ignore[misc]  # Numba has no types
    """Numba's compiler with a ``PartLibrary`` for its code."""

    def __init__(
        self, typing: Any, target: Any, library: Any, arguments: Any, result: Any, flags: Any, names: Any
    ) -> None:
        super().__init__(typing, target, library, arguments, result, flags, names)
        self.state.library = PartLibrary(target.codegen(), PART)


def set_environments(result: Any) -> None:
    """Tell the machine code of ``result`` where the Python objects are that its parts use, such as texts to print."""
    for environment in result._find_referenced_environments():
        result.codegen.set_env(environment.env_name, environment)
