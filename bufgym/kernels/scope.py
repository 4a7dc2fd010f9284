"""What translating one function keeps: kinds of its variables, temporary ones, what is refused and why."""

import ast
import builtins
import re
from pathlib import Path
from types import FunctionType
from typing import TYPE_CHECKING, Any, NamedTuple

from bufgym.kernels.kinds import NONE, KernelError, Kind
from bufgym.kernels.source import outside, tree_of
from bufgym.utils.files import PACKAGE

if TYPE_CHECKING:
    from bufgym.kernels.program import Program

OF_C = (
    "sqrt", "exp", "log", "log1p", "expm1", "tanh", "sin", "cos", "tan", "asin", "acos", "atan", "fabs", "hypot",
    "atan2", "pow", "log2", "log10", "sinh", "cosh", "copysign", "fmod",
)  # fmt: skip
"""Functions of Python's ``math`` that C has by the same name."""
_RESERVED = {
    "auto", "break", "case", "char", "const", "continue", "default", "do", "double", "else", "enum", "extern", "float",
    "for", "goto", "if", "inline", "int", "long", "register", "restrict", "return", "short", "signed", "sizeof",
    "static", "struct", "switch", "typedef", "union", "unsigned", "void", "volatile", "while", "bool", "true", "false",
    "INFINITY", "NAN", "asm", "typeof", *OF_C, "ceil", "floor", "fabsf", "memcpy", "memmove",
    "isnan", "isinf", "isfinite",
}  # fmt: skip
_ATOM = re.compile(r"-?[\w.]+|[\w.>\[\]-]+|\w+\([^()]*\)|\([^()]*\)")


class Value(NamedTuple):
    """An expression in C, its kind, and its value where that is known already."""

    text: str
    kind: Kind
    known: Any = None

    @property
    def closed(self) -> str:
        """The text as an operand."""
        return self.text if _ATOM.fullmatch(self.text) else f"({self.text})"

    @property
    def calls(self) -> bool:
        """Whether a kernel is called, so that order counts."""
        return "k_" in self.text or " = " in self.text

    @property
    def reads(self) -> bool:
        """Whether an array or a record is read, which a kernel may change."""
        return "->" in self.text or "[" in self.text


def name_in_c(name: str) -> str:
    """A Python name in C. Names that begin with ``bg_``, ``k_`` or ``of_`` are the translator's own."""
    return f"{name}_" if name in _RESERVED or name.startswith(("bg_", "BG_", "k_", "of_")) else name


class NotYetError(Exception):
    """A kind that a later round finds out."""


class Scope:
    """One function and one set of kinds of its arguments."""

    def __init__(self, program: "Program", function: FunctionType, kinds: tuple[Kind, ...]) -> None:
        self.program, self.function = program, function
        self.tree = tree_of(function)
        self.names = outside(function)
        arguments = self.tree.args
        if arguments.vararg or arguments.kwarg:
            raise self.refused(self.tree, "* and ** are not part of the kernel language")
        self.arguments = [a.arg for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
        self.kinds: dict[str, Kind] = dict(zip(self.arguments, kinds, strict=True))
        self.assigned = {n.id for n in ast.walk(self.tree) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
        self.counters: set[str] = set()
        self.result: Kind = None
        self.is_emitted = False
        self.temporaries: dict[str, Kind] = {}

    @property
    def checked(self) -> bool:
        """Whether every index and every sum is tested."""
        return self.program.checked

    @property
    def file(self) -> str:
        """The function's file as errors and comments name it."""
        path = Path(self.function.__code__.co_filename)
        return str(path.relative_to(PACKAGE.parent)) if path.is_relative_to(PACKAGE.parent) else str(path)

    def at(self, node: ast.AST) -> str:
        """File and line of a node."""
        return f"{self.file}:{getattr(node, 'lineno', self.tree.lineno)}"

    def refused(self, node: ast.AST, why: str) -> KernelError:
        """The error for what kernels cannot have: ``why`` says what to write instead."""
        return KernelError(f"{self.at(node)}: kernel {self.function.__name__}: {why}")

    def temporary(self, kind: Kind) -> str:
        """A new variable of this kind."""
        name = f"bg_t{len(self.temporaries) + 1}"
        self.temporaries[name] = kind
        return name

    def fixed(self, value: Value) -> tuple[list[str], Value]:
        """(What to evaluate before, the value), so that the value may be named twice."""
        return self._kept(value) if value.calls or len(value.text) >= 60 else ([], value)

    def _kept(self, value: Value) -> tuple[list[str], Value]:
        name = self.temporary(value.kind)
        return [f"{name} = {value.text}"], Value(name, value.kind, value.known)

    def in_order(self, values: list[Value]) -> tuple[list[str], list[Value]]:
        """(What to evaluate before, the values): Python evaluates from left to right, C as it likes."""
        last = max((k for k, value in enumerate(values) if value.calls), default=0)
        before: list[str] = []
        for k, value in enumerate(values[:last]):
            if value.calls or value.reads:  # what the last call may change is read before it
                first, values[k] = self._kept(value)
                before += first
        return before, values

    def after(self, before: list[str], text: str) -> str:
        """``text`` once all of ``before`` is evaluated."""
        return f"({', '.join([*before, text])})" if before else text

    def tested(self, helper: str, *operands: str, node: ast.AST) -> str:
        """A call of one of the prelude's helpers, which a checked build tells its place in Python."""
        more = (f'"{self.at(node)}"',) if self.checked else ()
        return f"{helper}({', '.join((*operands, *more))})"

    def settled(self, node: ast.expr) -> bool | None:
        """The answer of a test that is known when the kernel is translated: ``x is None``, or a constant; else None."""
        if isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.Is | ast.IsNot):
            other = node.comparators[0]
            if not (isinstance(other, ast.Constant) and other.value is None) or len(node.ops) > 1:
                raise self.refused(node, "``is`` asks for None only: compare numbers with ==")
            return (self.ex(node.left).kind is NONE) == isinstance(node.ops[0], ast.Is)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            answer = self.settled(node.operand)
            return None if answer is None else not answer
        if isinstance(node, ast.BoolOp):
            ends = isinstance(node.op, ast.Or)
            answers = []
            for part in node.values:  # what stands behind the answer is not looked at
                answers.append(self.settled(part))
                if answers[-1] is ends:
                    return ends
            return (not ends) if None not in answers else None
        if isinstance(node, ast.Constant | ast.Name | ast.Attribute):
            value = self.ex(node)
            return value.known if isinstance(value.known, bool) else None
        return None

    def ex(self, node: ast.expr) -> Value:
        """The value of any expression."""
        raise NotImplementedError

    def constant(self, value: Any, node: ast.AST) -> Value:
        """A value that is known when the kernel is translated."""
        raise NotImplementedError

    def found(self, node: ast.expr) -> Any:
        """The Python value of a name or of a.b.c that stands outside the function."""
        if isinstance(node, ast.Attribute):
            owner = self.found(node.value)
            if not hasattr(owner, node.attr):
                raise self.refused(node, f"{ast.unparse(node)} does not exist")
            return getattr(owner, node.attr)
        if not isinstance(node, ast.Name):
            raise self.refused(node, f"{ast.unparse(node)} cannot be called")
        if node.id in self.names:
            return self.names[node.id]
        if not hasattr(builtins, node.id):
            raise self.refused(node, f"{node.id} is not defined")
        return getattr(builtins, node.id)

    def is_outside(self, node: ast.expr) -> bool:
        """Whether the expression is a name, or a.b.c, of something outside the function."""
        while isinstance(node, ast.Attribute):
            node = node.value
        return isinstance(node, ast.Name) and node.id not in self.kinds and node.id not in self.assigned
