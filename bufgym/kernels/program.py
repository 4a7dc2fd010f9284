"""A C program: some kernels with all that they call, each once for each set of kinds of its arguments."""

import ast
from pathlib import Path
from typing import Any

import numpy as np

from bufgym.kernels.expressions import literal
from bufgym.kernels.kinds import NONE, Array, Given, Kind, Number, Pointer, Record, Tuple, array_kind
from bufgym.kernels.scope import Scope, Value, name_in_c
from bufgym.kernels.source import plain
from bufgym.kernels.statements import Function

PRELUDE = (Path(__file__).parent / "prelude.h").read_text(encoding="utf-8")
"""Python's arithmetic in C."""


def _maker(title: str, name: str, fields: list[str]) -> str:
    """A function that makes a struct: C++ has no compound literals."""
    parts = [field.rstrip(";").replace("*", "* ").rsplit(" ", 1) for field in fields]
    heads = ", ".join(f"{kind} {member}" for kind, member in parts)
    body = " ".join(f"made.{member} = {member};" for _, member in parts)
    return f"BG_KERNEL struct {title} {name}({heads}) {{ struct {title} made; {body} return made; }}"


class Program:
    """Kernels in one C file: ``entry`` and ``hook`` add one with all that it calls, ``source`` is the text."""

    def __init__(self, checked: bool = False, prefix: str = "", exported: str = "BG_EXPORT") -> None:
        """``prefix`` begins all names; ``exported`` is how functions are declared that others call."""
        self.checked, self.prefix, self.exported = checked, prefix, exported
        self._structs: list[str] = []
        self._types: dict[Any, str] = {}
        self._constants: dict[int, tuple[str, Kind, Any]] = {}
        self._functions: dict[Any, Function] = {}
        self._names: dict[Any, str] = {}
        self._under_way: list[Any] = []
        self._texts: list[str] = []
        self._taken: dict[str, int] = {}

    # ---------------------------------------------------------------- types

    def _unique(self, name: str) -> str:
        """``name`` with the prefix, and a number where it is taken."""
        name = self.prefix + name.removeprefix(self.prefix)
        self._taken[name] = self._taken.get(name, 0) + 1
        return name if self._taken[name] == 1 else f"{name}_{self._taken[name]}"

    def c_type(self, kind: Kind) -> str:
        """The type of a kind in C; a struct is declared at its first use."""
        if isinstance(kind, Number):
            return kind.c
        if isinstance(kind, Array):
            item = self.c_type(kind.item).removesuffix(" *")
            return self._struct(("array", item, kind.axes), f"{item.removeprefix('struct ').removesuffix('_t')}s"
                                + (f"_{kind.axes}d" if kind.axes > 1 else ""),
                                [f"{item} *p;", *(f"int64_t n{axis};" for axis in range(kind.axes))])  # fmt: skip
        if isinstance(kind, Record):
            fields = [f"{kind.kind_of(name).c} {name_in_c(name)};" for name in kind.dtype.names or ()]
            return self._struct(kind, "record", fields) + " *"
        if isinstance(kind, Tuple):
            named = [(self.c_type(item), name) for item, name in zip(kind.items, self.members(kind), strict=True)
                     if item is not NONE and not isinstance(item, Given)]  # fmt: skip
            fields = [f"{c_type} {name};" for c_type, name in named] or ["char none;"]
            return self._struct(("tuple", kind.title, tuple(fields)), kind.title, fields)
        assert isinstance(kind, Pointer)
        if kind not in self._types:
            name = self._unique("function")
            result = self.c_type(kind.result) if kind.result else "void"
            heads = ", ".join(self.handed(argument) for argument in kind.arguments)
            self._structs.append(f"typedef {result} (*{name})({heads});")
            self._types[kind] = name
        return self._types[kind]

    def _struct(self, key: Any, name: str, fields: list[str]) -> str:
        if key not in self._types:
            title = self._unique(name)
            self._structs.append(f"struct {title} {{ {' '.join(fields)} }};")
            self._types[key] = f"struct {title}"
            if isinstance(key, tuple):
                self._structs.append(_maker(title, self.maker(self._types[key]), fields))
        return self._types[key]

    def maker(self, struct: str) -> str:
        """The function that makes such a struct of its parts."""
        return f"{self.prefix}of_{struct.removeprefix('struct ').removeprefix(self.prefix)}"

    def known(self, record: Record, struct: str) -> None:
        """Say that records of this kind are the ``struct``, which is declared elsewhere and may have more fields."""
        self._types[record] = struct

    def handed(self, kind: Kind) -> str:
        """The type of an argument of a function that is called through a pointer: tuples go by address."""
        return f"const {self.c_type(kind)} *" if isinstance(kind, Tuple) else self.c_type(kind)

    def members(self, kind: Tuple) -> list[str]:
        """The names of a tuple's items in C."""
        return [name_in_c(name) for name in kind.names] or [f"item{k}" for k in range(len(kind.items))]

    def constant(self, array: np.ndarray[Any, Any]) -> tuple[str, Kind]:
        """(Text, kind) of an array that is known when kernels are translated."""
        kind = array_kind(array.dtype, array.ndim, constant=True)
        if id(array) not in self._constants:
            name = self._unique("constant")
            numbers = ", ".join(literal(number) for number in array.ravel().tolist())
            self._texts.append(f"static {self.c_type(kind.item)} {name}[] = {{ {numbers or 0} }};")
            self._constants[id(array)] = name, kind, array
        name = self._constants[id(array)][0]
        return f"{self.maker(self.c_type(kind))}({name}, {', '.join(map(str, array.shape))})", kind

    # ---------------------------------------------------------------- functions

    def called(self, function: Any, kinds: tuple[Kind, ...], caller: Scope, node: ast.AST) -> tuple[str, Kind]:
        """(Name, kind of its result) of a kernel that another one calls."""
        if (plain(function), kinds) in self._under_way:
            raise caller.refused(node, f"{function.__name__} calls itself: write a loop")
        result = self._inferred(function, kinds).result
        return (self._emitted(function, kinds) if caller.is_emitted else "k_"), result

    def _inferred(self, function: Any, kinds: tuple[Kind, ...]) -> Function:
        key = plain(function), kinds
        if key not in self._functions:
            made = Function(self, plain(function), kinds)
            self._under_way.append(key)
            try:
                made.infer()
            finally:
                self._under_way.pop()
            self._functions[key] = made
        return self._functions[key]

    def _emitted(self, function: Any, kinds: tuple[Kind, ...]) -> str:
        key = plain(function), kinds
        if key not in self._names:
            made = self._inferred(function, kinds)
            self._names[key] = self._unique(f"k_{plain(function).__name__.strip('<>')}")
            self._texts.append(made.text(self._names[key]))  # after all that it calls
        return self._names[key]

    def entry(self, symbol: str, function: Any, kinds: tuple[Kind, ...]) -> Kind:
        """Add ``const char *symbol(struct *call)``, which Python calls; return the kind of its result.

        ``call`` has the arguments, tuples by address, and room for the result. What comes back is what went wrong.
        """
        made, name = self._inferred(function, kinds), self._emitted(function, kinds)
        fields = [
            f"{self.c_type(kind)} {'*' * isinstance(kind, Tuple)}{name_in_c(a)};" for a, kind in made.parameters()
        ]
        texts = [f"{'*' * isinstance(kind, Tuple)}call->{name_in_c(a)}" for a, kind in made.parameters()]
        if made.result:
            fields.append(f"{self.c_type(made.result)} result;")
        struct = self._unique(f"call_{plain(function).__name__.strip('<>')}")
        call = f"{'call->result = ' * bool(made.result)}{name}({', '.join(texts)});"
        head = f"struct {struct} {{ {' '.join(fields) or 'char none;'} }};"
        body = f"    BG_CALLED(call);\n    {call}\n    return BG_RETURNED;"
        self._texts.append(f"{head}\nBG_EXPORT const char *{symbol}(struct {struct} *call)\n{{\n{body}\n}}\n")
        return made.result

    def hook(self, symbol: str, function: Any, pointer: Pointer) -> None:
        """Add ``symbol``, a function that is called through a pointer of this kind."""
        made, name = self._inferred(function, pointer.arguments), self._emitted(function, pointer.arguments)
        if (made.result is None) != (pointer.result is None):
            raise made.refused(made.tree, f"must return {'nothing' if pointer.result is None else 'a number'}")
        heads = [f"{self.handed(kind)} {name_in_c(a)}" for a, kind in made.parameters()]
        texts = [f"{'*' * isinstance(kind, Tuple)}{name_in_c(a)}" for a, kind in made.parameters()]
        call = f"{name}({', '.join(texts)})"
        result = self.c_type(pointer.result) if pointer.result else "void"
        if pointer.result:
            call = f"return {made.cast(Value(call, made.result), pointer.result)}"
        self._texts.append(f"{self.exported} {result} {symbol}({', '.join(heads)})\n{{\n    {call};\n}}\n")

    def text(self, more: str) -> None:
        """Add a declaration."""
        self._texts.append(more)

    def source(self) -> str:
        """The whole program."""
        head = "#define BG_CHECKED\n" * self.checked
        return "\n".join([head + PRELUDE, *self._structs, "", *self._texts])
