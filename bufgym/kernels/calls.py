"""Calls in kernels: of other kernels, of functions that are handed over, and of what C has itself."""

import ast
import inspect
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from bufgym.kernels.kinds import BOOL, FLOAT, INT, NONE, SINGLE, Array, Given, Number, Pointer, Tuple, joined
from bufgym.kernels.scope import OF_C, Value, name_in_c
from bufgym.kernels.source import plain
from bufgym.kernels.subscripts import Subscripts

_CASTS: dict[Any, Any] = {
    float: FLOAT, int: INT, bool: BOOL, np.float64: FLOAT, np.float32: SINGLE,
    **dict.fromkeys((np.int64, np.int32, np.uint64), INT),
}  # fmt: skip
_UNCHECKED = ("unchecked_item", "unchecked_at", "unchecked_slice", "unchecked_table", "prefetch")
_FIELD_KINDS = {"float": FLOAT, "int": INT, "bool": BOOL, float: FLOAT, int: INT, bool: BOOL}


class Calls(Subscripts):
    """Calls of one function."""

    def ex_Call(self, node: ast.Call) -> Value:
        """Any call."""
        if any(isinstance(a, ast.Starred) for a in node.args) or any(k.arg is None for k in node.keywords):
            raise self.refused(node, "name each argument: * and ** are not part of the kernel language")
        if isinstance(node.func, ast.Attribute) and not self.is_outside(node.func):
            return self.method(node, node.func)
        if isinstance(node.func, ast.Name) and node.func.id in self.kinds:
            value = Value(name_in_c(node.func.id), self.kinds[node.func.id])
            return self.called(node, value)
        function = plain(self.found(node.func))
        make = _BUILT_IN.get(function) if getattr(function, "__hash__", None) else None
        if getattr(function, "__module__", "") == "bufgym.jit.arrays" and function.__name__ in _UNCHECKED:
            make = Calls.unchecked
        if make is not None:
            return make(self, node)
        if getattr(function, "__module__", "") == "math" and function.__name__ in OF_C:
            texts = [self.cast(self.number(argument), FLOAT) for argument in node.args]
            return Value(f"{function.__name__}({', '.join(texts)})", FLOAT)
        return self.kernel(node, function)

    def called(self, node: ast.Call, function: Value) -> Value:
        """A call of a function that is a value."""
        if isinstance(function.kind, Given):
            return self.kernel(node, function.kind.function)
        if not isinstance(function.kind, Pointer):
            raise self.refused(node, f"{ast.unparse(node.func)} is no function")
        wanted = function.kind.arguments
        if len(node.args) != len(wanted) or node.keywords:
            raise self.refused(node, f"{ast.unparse(node.func)} takes {len(wanted)} arguments, by place")
        before, values = self.in_order([self.ex(argument) for argument in node.args])
        texts = [self.cast(value, kind) for value, kind in zip(values, wanted, strict=True)]
        for k, kind in enumerate(wanted):
            if isinstance(kind, Tuple):  # by address
                if texts[k] not in map(name_in_c, self.kinds):
                    name = self.temporary(kind)
                    before.append(f"{name} = {texts[k]}")
                    texts[k] = name
                texts[k] = f"&{texts[k]}"
        return Value(self.after(before, f"{function.text}({', '.join(texts)})"), function.kind.result)

    def method(self, node: ast.Call, func: ast.Attribute) -> Value:
        """``array.dtype.type(x)``, ``number.view(dtype)``, ``array.view(dtype)``, and functions in named tuples."""
        if func.attr == "type" and isinstance(func.value, ast.Attribute) and func.value.attr == "dtype":
            item = self.ex(func.value.value).kind.item
            return Value(self.cast(self.number(node.args[0]), item), item)
        owner = self.ex(func.value)
        if func.attr == "view" and owner.kind is SINGLE:
            return Value(f"bg_bits({owner.text})", INT)
        if func.attr == "view" and owner.kind is INT:
            return Value(f"bg_of_bits({owner.text})", SINGLE)
        if func.attr == "view" and owner.kind in (Array(FLOAT), Array(FLOAT, 1, True)):
            before, owner = self.fixed(owner)
            kind = Array(SINGLE, 1, owner.kind.constant)
            text = self.made_array(kind, f"(float *){owner.closed}.p", [f"2 * {owner.closed}.n0"])
            return Value(self.after(before, text), kind)
        if isinstance(owner.kind, Tuple) and func.attr in owner.kind.names:
            return self.called(node, self.ex(func))
        raise self.refused(node, f"{ast.unparse(func)}(...) is not part of the kernel language")

    def kernel(self, node: ast.Call, function: Any) -> Value:
        """A call of another kernel, or of a named tuple's class."""
        fields = getattr(function, "_fields", None)
        if fields is None and not hasattr(function, "__code__"):
            if getattr(function, "__name__", "") in OF_C:
                raise self.refused(node, f"write math.{function.__name__} for {ast.unparse(node.func)}")
            raise self.refused(node, f"{ast.unparse(node.func)}(...) is not part of the kernel language")
        arguments = {name: self.ex(argument) for name, argument in self.by_name(node, function).items()}
        before, values = self.in_order(list(arguments.values()))
        if fields is not None:
            hints = function.__annotations__
            wanted = [_FIELD_KINDS.get(hints.get(name), v.kind) if isinstance(v.kind, Number) else v.kind
                      for name, v in zip(fields, values, strict=True)]  # fmt: skip
            kind = Tuple(tuple(wanted), fields, function.__name__)
            parts = [self.cast(value, want) for value, want in zip(values, wanted, strict=True) if want is not NONE]
            return Value(self.after(before, self.made(kind, parts)), kind)
        name, result = self.program.called(function, tuple(value.kind for value in values), self, node)
        texts = [v.text for v in values if v.kind is not NONE and not isinstance(v.kind, Given)]
        return Value(self.after(before, f"{name}({', '.join(texts)})"), result)

    def by_name(self, node: ast.Call, function: Any) -> dict[str, ast.expr]:
        """Name of a parameter -> the argument; defaults where there is none."""
        parameters = inspect.signature(function).parameters
        names = list(parameters)
        if len(node.args) > len(names):
            raise self.refused(node, f"{function.__name__} takes {len(names)} arguments")
        given = dict(zip(names, node.args, strict=False)) | {k.arg: k.value for k in node.keywords if k.arg}
        for name, parameter in parameters.items():
            if name not in given:
                if parameter.default is inspect.Parameter.empty:
                    raise self.refused(node, f"{function.__name__} needs its argument {name!r}")
                given[name] = ast.copy_location(ast.Constant(parameter.default), node)
        return {name: given[name] for name in names}

    # ---------------------------------------------------------------- what C has itself

    def least(self, node: ast.Call, helper: str) -> Value:
        """``min`` and ``max`` of two numbers or more: the first of equal ones, as in Python."""
        if len(node.args) < 2 or node.keywords:
            raise self.refused(node, f"{helper} is of two numbers or more: write a loop over an array")
        values = [self.number(argument) for argument in node.args]
        kind = values[0].kind
        for value in values[1:]:
            kind = joined(kind, value.kind)
        kind = INT if kind is BOOL else kind
        before, values = self.in_order(values)
        text = self.cast(values[0], kind)
        for value in values[1:]:
            text = f"bg_{helper}_{kind.dtype}({text}, {self.cast(value, kind)})"
        return Value(self.after(before, text), kind)

    def length(self, node: ast.Call) -> Value:
        """``len`` of an array or a tuple."""
        value = self.ex(node.args[0])
        if isinstance(value.kind, Tuple):
            return self.constant(len(value.kind.items), node)
        if not isinstance(value.kind, Array):
            raise self.refused(node, f"{ast.unparse(node.args[0])} is no array")
        return Value(f"{value.closed}.n0", INT)

    def converted(self, node: ast.Call) -> Value:
        """``int(x)``, ``float(x)``, ``bool(x)``, ``np.float32(x)`` and others."""
        value, kind = self.number(node.args[0]), _CASTS[plain(self.found(node.func))]
        if value.known is not None and kind in (INT, FLOAT) and math.isfinite(value.known):
            return self.constant(int(value.known) if kind is INT else float(value.known), node)
        return Value(self.cast(value, kind), kind)

    def magnitude(self, node: ast.Call) -> Value:
        """``abs(x)``."""
        value = self.number(node.args[0])
        if value.kind is SINGLE:
            return Value(f"fabsf({value.text})", SINGLE)
        return Value(f"bg_abs({value.text})", INT) if value.kind is not FLOAT else Value(f"fabs({value.text})", FLOAT)

    def rounded(self, node: ast.Call) -> Value:
        """``math.floor(x)`` and ``math.ceil(x)``: whole numbers."""
        text = self.cast(self.number(node.args[0]), FLOAT)
        return Value(f"bg_{plain(self.found(node.func)).__name__}_of({text})", INT)

    def tested_number(self, node: ast.Call) -> Value:
        """``math.isnan(x)`` and others."""
        text = self.cast(self.number(node.args[0]), FLOAT)
        return Value(f"{plain(self.found(node.func)).__name__}({text})", BOOL)

    def unchecked(self, node: ast.Call) -> Value:
        """``unchecked_...``: elements and parts whose indices the caller answers for."""
        name = plain(self.found(node.func)).__name__
        before, array = self.fixed(self.ex(node.args[0]))
        if not isinstance(array.kind, Array):
            raise self.refused(node, f"{ast.unparse(node.args[0])} is no array")
        numbers = [self.whole(argument).text for argument in node.args[1:]]
        if self.checked and name in ("unchecked_item", "unchecked_at"):
            numbers = [self.tested("bg_inside", number, f"{array.closed}.n{axis}", node=node)
                       for axis, number in enumerate(numbers)]  # fmt: skip
        if name in ("unchecked_item", "unchecked_at"):
            value = self.place(array, numbers)
            return self.widened(Value(self.after(before, value.text), value.kind))
        if name == "prefetch":
            value = self.place(array, numbers)
            start = value.text if not isinstance(value.kind, Number) else f"&{value.text}"
            return Value(self.after(before, f"bg_prefetch({start})"), None)
        if name == "unchecked_table":
            rows, columns = numbers
            if self.checked:
                rows = self.tested("bg_fits", rows, f"{Value(rows, INT).closed} * {Value(columns, INT).closed}",
                                   f"{array.closed}.n0", node=node)  # fmt: skip
            kind = Array(array.kind.item, 2, array.kind.constant)
            return Value(self.after(before, self.made_array(kind, f"{array.closed}.p", [rows, columns])), kind)
        i, first, length = (Value(number, INT).closed for number in numbers)
        if self.checked:
            i = self.tested("bg_inside", i, f"{array.closed}.n0", node=node)
            length = self.tested("bg_fits", length, f"{first} + {length}", f"{array.closed}.n1", node=node)
        kind = Array(array.kind.item, 1, array.kind.constant)
        start = f"{array.closed}.p + ({i} * {array.closed}.n1 + {first})"
        return Value(self.after(before, self.made_array(kind, start, [length])), kind)


_BUILT_IN: dict[Any, Callable[[Any, ast.Call], Value]] = {
    min: lambda s, node: s.least(node, "min"),
    max: lambda s, node: s.least(node, "max"),
    len: Calls.length,
    abs: Calls.magnitude,
    math.floor: Calls.rounded,
    math.ceil: Calls.rounded,
    math.isnan: Calls.tested_number,
    math.isinf: Calls.tested_number,
    math.isfinite: Calls.tested_number,
    **dict.fromkeys(_CASTS, Calls.converted),
}  # fmt: skip
"""Functions of Python that have C of their own."""
