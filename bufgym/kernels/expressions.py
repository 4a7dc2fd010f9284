"""Expressions of kernels in C: constants, names, arithmetic, conditions."""

import ast
import math
from typing import Any

import numpy as np

from bufgym.kernels.calls import Calls
from bufgym.kernels.kinds import BOOL, FLOAT, INT, NONE, SINGLE, Array, Given, Number, Record, Text, Tuple, joined
from bufgym.kernels.scope import NotYetError, Value, name_in_c
from bufgym.kernels.source import plain
from bufgym.kernels.subscripts import Subscripts

_ARITHMETIC = {
    "Add": "+", "Sub": "-", "Mult": "*", "RShift": ">>", "LShift": "<<", "BitAnd": "&", "BitOr": "|", "BitXor": "^",
}  # fmt: skip
_COMPARISONS = {"Lt": "<", "LtE": "<=", "Gt": ">", "GtE": ">=", "Eq": "==", "NotEq": "!="}


def literal(x: Any) -> str:
    """A number in C."""
    if isinstance(x, bool | np.bool_):
        return "true" if x else "false"
    if isinstance(x, int | np.integer):
        return str(int(x)) if abs(int(x)) < 2**31 else f"INT64_C({int(x)})"
    if not math.isfinite(x):
        return "NAN" if math.isnan(x) else "INFINITY" if x > 0 else "(-INFINITY)"
    return repr(float(x)) + "f" * isinstance(x, np.float32)


class Expressions(Calls, Subscripts):
    """The expressions of one function: each ``ex_...`` makes a ``Value`` of the node of that name."""

    def ex(self, node: ast.expr) -> Value:
        """The value of any expression."""
        make = getattr(self, f"ex_{type(node).__name__}", None)
        if make is None:
            raise self.refused(node, f"{type(node).__name__} is not part of the kernel language")
        value: Value = make(node)
        return value

    # ---------------------------------------------------------------- names and constants

    def constant(self, value: Any, node: ast.AST) -> Value:
        """A value that is known when the kernel is translated."""
        value = plain(value)
        if isinstance(value, bool | np.bool_):
            return Value(literal(value), BOOL, bool(value))
        if isinstance(value, int | np.integer):
            return Value(literal(value), INT, int(value))
        if isinstance(value, np.float32):
            return Value(literal(value), SINGLE, value)
        if isinstance(value, float | np.floating):
            return Value(literal(value), FLOAT, float(value))
        if value is None:
            return Value("0", NONE)
        if isinstance(value, str):
            return Value("0", Text())
        if isinstance(value, np.ndarray):
            return Value(*self.program.constant(value))
        if isinstance(value, tuple):
            parts = [self.constant(part, node) for part in value]
            names = getattr(type(value), "_fields", ())
            kind = Tuple(tuple(p.kind for p in parts), names, type(value).__name__ if names else "tuple")
            return Value(self.made(kind, [p.text for p in parts if p.kind is not NONE]), kind)
        if callable(value) and hasattr(value, "__code__"):
            return Value("", Given(value), value)
        name = ast.unparse(node) if isinstance(node, ast.expr) else "a default"
        raise self.refused(node, f"{name} = {value!r} is neither number, array, tuple nor function")

    def ex_Constant(self, node: ast.Constant) -> Value:
        """A number, None, or a default that stands for an argument left out."""
        return self.constant(node.value, node)

    def ex_Name(self, node: ast.Name) -> Value:
        """A variable, or a constant from outside."""
        if node.id in self.kinds:
            kind = self.kinds[node.id]
            return Value(name_in_c(node.id), kind, kind.function if isinstance(kind, Given) else None)
        if node.id in self.assigned:
            if self.is_emitted:
                raise self.refused(node, f"{node.id} is read before anything is assigned to it")
            raise NotYetError
        return self.constant(self.found(node), node)

    def ex_Attribute(self, node: ast.Attribute) -> Value:
        """A field of a record or a named tuple, or a constant of a module."""
        if self.is_outside(node):
            return self.constant(self.found(node), node)
        owner = self.ex(node.value)
        if isinstance(owner.kind, Record) and node.attr in (owner.kind.dtype.names or ()):
            return self.widened(Value(f"{owner.closed}->{name_in_c(node.attr)}", owner.kind.kind_of(node.attr)))
        if isinstance(owner.kind, Tuple) and node.attr in owner.kind.names:
            return self.member(owner, owner.kind.names.index(node.attr))
        if isinstance(owner.kind, Array) and node.attr == "shape":
            before, array = self.fixed(owner)
            kind = Tuple((INT,) * owner.kind.axes)
            lengths = [f"{array.closed}.n{axis}" for axis in range(owner.kind.axes)]
            return Value(self.after(before, self.made(kind, lengths)), kind)
        raise self.refused(node, f"{ast.unparse(node.value)} has no {node.attr!r} in kernels")

    def ex_Tuple(self, node: ast.Tuple) -> Value:
        """A tuple of values."""
        parts = [self.ex(part) for part in node.elts]
        kind = Tuple(tuple(part.kind for part in parts))
        before, parts = self.in_order([part for part in parts if part.kind is not NONE])
        return Value(self.after(before, self.made(kind, [part.text for part in parts])), kind)

    # ---------------------------------------------------------------- arithmetic

    def binary(self, op: ast.operator, one: Value, other: Value, node: ast.AST) -> Value:
        """``one op other``."""
        name = type(op).__name__
        if not (isinstance(one.kind, Number) and isinstance(other.kind, Number)):
            raise self.refused(node, "arithmetic is of numbers: write a loop over an array")
        one, other = self.widened(one), self.widened(other)
        kind = joined(one.kind, other.kind)
        kind = INT if kind is BOOL else kind
        if name == "Div" and kind is INT:
            kind = FLOAT
        before, (one, other) = self.in_order([one, other])
        x, y = (Value(self.cast(side, kind), kind).closed for side in (one, other))
        known = isinstance(one.known, int) and isinstance(other.known, int)
        if name == "Div":
            return Value(self.after(before, f"{x} / {y}"), kind)
        if name in ("FloorDiv", "Mod"):
            of_two = kind is INT and isinstance(other.known, int) and other.known > 0 and other.known.bit_count() == 1
            if of_two:  # rounds down as it is, in a third of the time: half of a binary search
                shift = (
                    f"{x} >> {int(other.known).bit_length() - 1}" if name == "FloorDiv" else f"{x} & {other.known - 1}"
                )
                return Value(self.after(before, shift), kind)
            helper = "bg_floor" if name == "FloorDiv" else "bg_mod"
            text = self.tested(helper, x, y, node=node) if kind is INT else f"{helper}_real({x}, {y})"
            return Value(self.after(before, text), kind)
        if name == "Pow":
            whole = kind is INT and isinstance(other.known, int) and other.known >= 0
            return Value(self.after(before, f"{'bg_power' if whole else 'pow'}({x}, {y})"), INT if whole else FLOAT)
        if name not in _ARITHMETIC:
            raise self.refused(node, f"{name} is not part of the kernel language")
        if kind is INT and known:
            return self.constant(_folded(name, int(one.known), int(other.known)), node)
        if kind is INT and self.checked and name in ("Add", "Sub", "Mult"):
            return Value(self.after(before, self.tested(f"bg_{name.lower()}", x, y, node=node)), kind)
        if kind is not INT and name not in ("Add", "Sub", "Mult"):
            raise self.refused(node, f"{name} is of whole numbers")
        wide = "(int64_t)" * (kind is INT and one.known is not None)
        return Value(self.after(before, f"{wide}{x} {_ARITHMETIC[name]} {y}"), kind)

    def ex_BinOp(self, node: ast.BinOp) -> Value:
        """Arithmetic."""
        return self.binary(node.op, self.ex(node.left), self.ex(node.right), node)

    def ex_UnaryOp(self, node: ast.UnaryOp) -> Value:
        """``not x``, ``-x``, ``+x``, ``~x``."""
        if isinstance(node.op, ast.Not):
            return Value(f"!{self.condition(node.operand).closed}", BOOL)
        value = self.number(node.operand)
        if value.known is not None and not isinstance(node.op, ast.UAdd):
            return self.constant(-value.known if isinstance(node.op, ast.USub) else ~value.known, node)
        sign = {"USub": "-", "Invert": "~", "UAdd": ""}[type(node.op).__name__]
        return Value(f"{sign}{value.closed}", INT if value.kind is BOOL else value.kind)

    def condition(self, node: ast.expr) -> Value:
        """An expression as a test."""
        value = self.ex(node)
        if not isinstance(value.kind, Number):
            raise self.refused(node, f"{ast.unparse(node)} is no condition: compare it with something")
        return value if value.kind is BOOL else Value(f"{value.closed} != 0", BOOL)

    def ex_BoolOp(self, node: ast.BoolOp) -> Value:
        """``and`` and ``or``: True or False."""
        if (known := self.settled(node)) is not None:
            return Value(literal(known), BOOL, known)
        parts = [self.condition(part) for part in node.values if self.settled(part) is None]
        return Value((" && " if isinstance(node.op, ast.And) else " || ").join(p.closed for p in parts), BOOL)

    def ex_Compare(self, node: ast.Compare) -> Value:
        """Comparisons, chained as in Python."""
        if (known := self.settled(node)) is not None:
            return Value(literal(known), BOOL, known)
        parts, left = [], self.number(node.left)
        for op, comparator in zip(node.ops, node.comparators, strict=True):
            if type(op).__name__ not in _COMPARISONS:
                raise self.refused(node, f"{type(op).__name__} is not part of the kernel language")
            before, (one, other) = self.in_order([left, self.number(comparator)])
            if len(node.ops) > 1:
                first, other = self.fixed(other)
                before += first
            parts.append(self.after(before, f"{one.closed} {_COMPARISONS[type(op).__name__]} {other.closed}"))
            left = other
        return Value(parts[0] if len(parts) == 1 else " && ".join(f"({part})" for part in parts), BOOL)

    def ex_IfExp(self, node: ast.IfExp) -> Value:
        """``one if test else other``."""
        if (known := self.settled(node.test)) is not None:
            return self.ex(node.body if known else node.orelse)
        test, one, other = self.condition(node.test), self.ex(node.body), self.ex(node.orelse)
        kind = joined(one.kind, other.kind)
        if kind is None:
            raise self.refused(node, "both cases must be of one kind")
        first, second = Value(self.cast(one, kind), kind), Value(self.cast(other, kind), kind)
        return Value(f"{test.closed} ? {first.closed} : {second.closed}", kind)


def _folded(name: str, x: int, y: int) -> int:
    """Arithmetic of two whole numbers that are known."""
    if "Shift" in name:
        return x << y if name == "LShift" else x >> y
    return {"Add": x + y, "Sub": x - y, "Mult": x * y, "BitAnd": x & y, "BitOr": x | y, "BitXor": x ^ y}[name]
