"""Values as other kinds, and elements and parts of arrays, in C."""

import ast

from bufgym.kernels.kinds import BOOL, FLOAT, INT, NONE, SINGLE, Array, Given, Kind, Number, Record, Tuple
from bufgym.kernels.scope import Scope, Value


class Subscripts(Scope):
    """Elements, rows and slices of arrays, and items of tuples."""

    def number(self, node: ast.expr) -> Value:
        """The value of an expression that must be a number."""
        value = self.ex(node)
        if not isinstance(value.kind, Number):
            raise self.refused(node, f"{ast.unparse(node)} is no number")
        return self.widened(value)

    def whole(self, node: ast.expr) -> Value:
        """The value of an expression that must be a whole number."""
        value = self.number(node)
        if value.kind not in (INT, BOOL):
            raise self.refused(node, f"{ast.unparse(node)} must be a whole number: write int(...)")
        return value

    def widened(self, value: Value) -> Value:
        """A number that an array keeps in fewer bits, as INT."""
        if isinstance(value.kind, Number) and value.kind.rank == 1:
            return Value(f"(int64_t){value.closed}", INT, value.known)
        return value

    def cast(self, value: Value, wanted: Kind) -> str:
        """The text of ``value`` as the kind ``wanted``."""
        if value.kind == wanted or not isinstance(wanted, Number | Tuple):
            return value.text
        if isinstance(wanted, Tuple):
            if self.program.c_type(value.kind) == self.program.c_type(wanted):
                return value.text
            name = self.temporary(value.kind)
            kinds = zip(self.program.members(value.kind), value.kind.items, wanted.items, strict=True)
            parts = [self.cast(Value(f"{name}.{m}", kind), want) for m, kind, want in kinds if kind is not NONE]
            return f"({name} = {value.text}, {self.made(wanted, parts)})"
        if value.kind in (FLOAT, SINGLE) and wanted.rank in (1, 2):
            whole = f"bg_whole({value.text})"
            return whole if wanted is INT else f"({wanted.c}){whole}"
        if wanted is BOOL:
            return f"{value.closed} != 0"
        return f"({wanted.c}){value.closed}"

    def made(self, kind: Tuple, parts: list[str]) -> str:
        """A tuple of these parts; None fields have none."""
        return f"{self.program.maker(self.program.c_type(kind))}({', '.join(parts) or '0'})"

    def made_array(self, kind: Array, start: str, lengths: list[str]) -> str:
        """An array that begins at ``start``."""
        return f"{self.program.maker(self.program.c_type(kind))}({', '.join([start, *lengths])})"

    def member(self, owner: Value, k: int) -> Value:
        """The k-th item of a tuple."""
        kind = owner.kind.items[k]
        if isinstance(kind, Given):
            return Value("", kind, kind.function)
        return Value("0" if kind is NONE else f"{owner.closed}.{self.program.members(owner.kind)[k]}", kind)

    def place(self, array: Value, indices: list[str]) -> Value:
        """The element of an array at these indices."""
        offset = indices[0]
        for axis, index in enumerate(indices[1:], start=1):
            offset = f"{Value(offset, INT).closed} * {array.closed}.n{axis} + {Value(index, INT).closed}"
        if isinstance(array.kind.item, Record):
            return Value(f"({array.closed}.p + {Value(offset, INT).closed})", array.kind.item)
        return Value(f"{array.closed}.p[{offset}]", array.kind.item)

    def row(self, array: Value, indices: list[str]) -> Value:
        """The part of an array at fewer indices than it has axes."""
        kind = Array(array.kind.item, array.kind.axes - len(indices), array.kind.constant)
        start = Value(indices[0], INT).closed
        for axis in range(1, array.kind.axes):
            more = f" + {Value(indices[axis], INT).closed}" if axis < len(indices) else ""
            start = f"({start} * {array.closed}.n{axis}{more})"
        lengths = [f"{array.closed}.n{axis}" for axis in range(len(indices), array.kind.axes)]
        return Value(self.made_array(kind, f"{array.closed}.p + {start}", lengths), kind)

    def is_count(self, node: ast.expr) -> bool:
        """Whether a number is never negative: of a loop from 0 on, ``np.uint64(...)``, and their sums and products."""
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Mult):
            return self.is_count(node.left) and self.is_count(node.right)
        if isinstance(node, ast.Constant):
            return isinstance(node.value, int) and node.value >= 0
        if isinstance(node, ast.Call):
            return ast.unparse(node.func) in ("np.uint64", "len")
        return isinstance(node, ast.Name) and node.id in self.counters

    def index(self, node: ast.expr, length: str) -> str:
        """An index as C has it: a negative one counts from the end."""
        value = self.whole(node)
        if not self.checked:
            if value.known is not None:
                return value.text if value.known >= 0 else f"{length} - {-value.known}"
            if self.is_count(node):
                return value.text
        return self.tested("bg_index", value.text, length, node=node)

    def part(self, array: Value, part: ast.Slice, before: list[str]) -> tuple[str, str]:
        """(First, length) of a slice of an array's first axis; its ends stay within the array, as in Python."""
        if part.step is not None:
            raise self.refused(part, "a slice has no step in kernels")
        length = f"{array.closed}.n0"
        first, end = "0", length
        if part.lower is not None:
            more, low = self.fixed(Value(f"bg_end({self.whole(part.lower).text}, {length})", INT))
            before += more
            first = low.text
        if part.upper is not None:
            end = f"bg_end({self.whole(part.upper).text}, {length})"
        return first, length if first == "0" and part.upper is None else f"bg_span({first}, {end})"

    def subscript(self, node: ast.Subscript) -> tuple[list[str], Value]:
        """(What to evaluate before, the element or part that ``node`` names)."""
        before, owner = self.fixed(self.ex(node.value))
        if not isinstance(owner.kind, Array):
            raise self.refused(node, f"{ast.unparse(node.value)} is no array")
        indices = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        if len(indices) > owner.kind.axes:
            raise self.refused(node, f"{ast.unparse(node.value)} has {owner.kind.axes} axes")
        while len(indices) > 1 and isinstance(indices[-1], ast.Slice) and ast.unparse(indices[-1]) == ":":
            indices = indices[:-1]  # all of an axis
        *fore, last = indices
        if any(isinstance(index, ast.Slice) for index in fore):
            raise self.refused(node, "only the last index may be a slice: write a loop")
        texts = [self.index(index, f"{owner.closed}.n{axis}") for axis, index in enumerate(fore)]
        if not isinstance(last, ast.Slice):
            texts.append(self.index(last, f"{owner.closed}.n{len(fore)}"))
            return before, self.place(owner, texts) if len(texts) == owner.kind.axes else self.row(owner, texts)
        if fore:
            more, owner = self.fixed(self.row(owner, texts))
            before += more
        first, length = self.part(owner, last, before)
        rest = [f"{owner.closed}.n{axis}" for axis in range(1, owner.kind.axes)]
        start = " * ".join([Value(first, INT).closed, *rest])
        return before, Value(self.made_array(owner.kind, f"{owner.closed}.p + {start}", [length, *rest]), owner.kind)

    def ex_Subscript(self, node: ast.Subscript) -> Value:
        """An element or a part of an array, or an item of a tuple."""
        if isinstance(node.value, ast.Attribute) and node.value.attr == "shape":
            axis = self.ex(node.slice).known
            before, array = self.fixed(self.ex(node.value.value))
            return Value(self.after(before, f"{array.closed}.n{axis}"), INT)
        owner = self.ex(node.value)
        if isinstance(owner.kind, Tuple):
            k = self.ex(node.slice).known
            if not isinstance(k, int) or not -len(owner.kind.items) <= k < len(owner.kind.items):
                raise self.refused(node, "a tuple's index must be a constant in its range")
            return self.member(owner, k % len(owner.kind.items))
        before, value = self.subscript(node)
        return self.widened(Value(self.after(before, value.text), value.kind))
