"""Statements of kernels in C, and a whole function."""

import ast

from bufgym.kernels.expressions import Expressions
from bufgym.kernels.kinds import INT, NONE, Array, Given, Kind, Number, Record, Text, Tuple, joined
from bufgym.kernels.scope import NotYetError, Value, name_in_c

_ROUNDS = 12
"""Kinds settle in three rounds or four: a kind only ever widens."""


class Function(Expressions):
    """One function for one set of kinds of its arguments: ``infer`` finds all kinds, ``text`` is its C."""

    lines: list[str]
    loops = 0

    def infer(self) -> Kind:
        """Find the kinds of all variables; return the result's, None for nothing."""
        self.counters = self._counters()
        for _ in range(_ROUNDS):
            before = dict(self.kinds), self.result
            self._run()
            if (self.kinds, self.result) == before:
                return self.result
        raise self.refused(self.tree, "the kinds of its variables do not settle: give each its kind at the start")

    def text(self, name: str) -> str:
        """The function in C."""
        self.is_emitted = True
        self._run()
        c_type = self.program.c_type
        heads = [f"{c_type(kind)} {name_in_c(argument)}" for argument, kind in self.parameters()]
        variables = {name_in_c(n): kind for n, kind in self.kinds.items() if n not in self.arguments} | self.temporaries
        in_c = {n: kind for n, kind in variables.items() if kind is not NONE and not isinstance(kind, Given)}
        own = [f"    {c_type(kind)} {n}{' = 0' * isinstance(kind, Number)};" for n, kind in in_c.items()]
        if isinstance(self.result, Number) and not isinstance(self.tree.body[-1], ast.Return):
            self.lines.append("    return 0;")
        result = c_type(self.result) if self.result else "void"
        head = f"/* {self.at(self.tree)} */\nBG_KERNEL {result} {name}({', '.join(heads) or 'void'})"
        return "\n".join([head, "{", *own, *self.lines, "}", ""])

    def parameters(self) -> list[tuple[str, Kind]]:
        """(Name, kind) of the arguments that C has: neither None nor a function that is known."""
        named = [(argument, self.kinds[argument]) for argument in self.arguments]
        return [(argument, kind) for argument, kind in named if kind is not NONE and not isinstance(kind, Given)]

    def _run(self) -> None:
        self.lines, self.temporaries, self.loops = [], {}, 0
        self.block(self.tree.body, 1)

    def _counters(self) -> set[str]:
        """Variables that only ever count from a number >= 0 upwards."""
        counted, others = set(), set()
        for node in ast.walk(self.tree):
            if isinstance(node, ast.For) and isinstance(node.target, ast.Name) and isinstance(node.iter, ast.Call):
                numbers = node.iter.args
                start = numbers[0] if len(numbers) > 1 else ast.Constant(0)
                is_up = isinstance(start, ast.Constant) and isinstance(start.value, int) and start.value >= 0
                if is_up and len(numbers) < 3 and ast.unparse(node.iter.func) == "range":
                    counted.add(id(node.target))
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call):
                if isinstance(node.targets[0], ast.Name) and ast.unparse(node.value.func) == "np.uint64":
                    counted.add(id(node.targets[0]))
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and id(node) not in counted:
                others.add(node.id)
        names = {node.id for node in ast.walk(self.tree) if isinstance(node, ast.Name) and id(node) in counted}
        return names - others - set(self.arguments)

    # ---------------------------------------------------------------- statements

    def emit(self, depth: int, text: str) -> None:
        """Add a line."""
        self.lines.append("    " * depth + text)

    def block(self, body: list[ast.stmt], depth: int) -> bool:
        """Statements; returns whether the last one leaves the function, so that the rest is never reached."""
        for node in body:
            make = getattr(self, f"st_{type(node).__name__}", None)
            if make is None:
                raise self.refused(node, f"{type(node).__name__} is not part of the kernel language")
            try:
                if make(node, depth):
                    return True
            except NotYetError:
                continue
        return False

    def st_Expr(self, node: ast.Expr, depth: int) -> None:
        """A call; a docstring leaves nothing."""
        value = self.ex(node.value)
        if not isinstance(value.kind, Text):
            self.emit(depth, f"{value.text};")

    def st_Pass(self, node: ast.Pass, depth: int) -> None:
        """Nothing."""

    def st_Return(self, node: ast.Return, depth: int) -> bool:
        """The result."""
        value = Value("", NONE) if node.value is None else self.ex(node.value)
        if value.kind is NONE or value.kind is None:
            if value.kind is None:
                self.emit(depth, f"{value.text};")
            self.emit(depth, "return;")
            return True
        kind = joined(self.result, value.kind)
        if kind is None:
            raise self.refused(node, "returns values of different kinds")
        self.result = kind
        self.emit(depth, f"return {self.cast(value, kind)};")
        return True

    def st_Assign(self, node: ast.Assign, depth: int) -> None:
        """``a = x``, ``a = b = x``, ``a, b = x, y``."""
        (target, *more) = node.targets
        if not more and isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
            if len(target.elts) != len(node.value.elts):
                raise self.refused(node, f"{len(node.value.elts)} values for {len(target.elts)} variables")
            # All values before any variable: a, b = b, a. What nothing here changes needs no copy.
            values = [self.ex(part) for part in node.value.elts]
            plain = all(isinstance(t, ast.Name) for t in target.elts) and not self._read(node.value) & {
                t.id for t in target.elts if isinstance(t, ast.Name)}  # fmt: skip
            if not plain:
                values = [value if value.known is not None or value.kind is NONE else self._copied(value, depth)
                          for value in values]  # fmt: skip
            for part, value in zip(target.elts, values, strict=True):
                self.store(part, value, depth)
            return
        value = self.ex(node.value)
        if more or isinstance(target, ast.Tuple):
            value = self._copied(value, depth)
        for one in node.targets:
            if not isinstance(one, ast.Tuple):
                self.store(one, value, depth)
                continue
            if not isinstance(value.kind, Tuple) or len(value.kind.items) != len(one.elts):
                raise self.refused(node, f"{ast.unparse(node.value)} is no tuple of {len(one.elts)}")
            for k, part in enumerate(one.elts):
                self.store(part, self.member(value, k), depth)

    def _read(self, node: ast.AST) -> set[str]:
        return {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}

    def _copied(self, value: Value, depth: int) -> Value:
        """The value in a temporary variable."""
        if value.kind is NONE or isinstance(value.kind, Given):
            return value
        name = self.temporary(value.kind)
        self.emit(depth, f"{name} = {value.text};")
        return Value(name, value.kind, value.known)

    def st_AnnAssign(self, node: ast.AnnAssign, depth: int) -> None:
        """``a: float = x``."""
        if node.value is not None:
            self.store(node.target, self.ex(node.value), depth)

    def st_AugAssign(self, node: ast.AugAssign, depth: int) -> None:
        """``a += x``."""
        # The same expression, read; a node of its own, as a Store is no Load.
        read = ast.parse(ast.unparse(node.target), mode="eval").body
        for part in ast.walk(read):
            ast.copy_location(part, node)
        self.store(node.target, self.binary(node.op, self.ex(read), self.ex(node.value), node), depth)

    def store(self, target: ast.expr, value: Value, depth: int) -> None:
        """Put a value where ``target`` says."""
        if isinstance(target, ast.Name):
            return self.keep(target, value, depth)
        if value.kind is None or value.kind is NONE:
            raise self.refused(target, f"{ast.unparse(target)} cannot be None in kernels")
        if isinstance(target, ast.Attribute):
            owner = self.ex(target.value)
            if not isinstance(owner.kind, Record):
                raise self.refused(target, "only fields of records and elements of arrays can be set")
            if target.attr not in (owner.kind.dtype.names or ()):
                raise self.refused(target, f"the record has no field {target.attr!r}")
            text = self.cast(value, owner.kind.kind_of(target.attr))
            return self.emit(depth, f"{owner.closed}->{name_in_c(target.attr)} = {text};")
        if not isinstance(target, ast.Subscript):
            raise self.refused(target, f"cannot assign to {ast.unparse(target)}")
        array = self.ex(target.value).kind
        if isinstance(array, Array) and array.constant:
            raise self.refused(target, f"{ast.unparse(target.value)} is read-only")
        indices = target.slice.elts if isinstance(target.slice, ast.Tuple) else []
        if len(indices) == 2 and isinstance(indices[0], ast.Slice) and not isinstance(indices[1], ast.Slice):
            return self.fill_column(target, indices[0], indices[1], value, depth)
        if value.calls:  # Python finds the place after the value
            value = self._copied(value, depth)
        before, place = self.subscript(target)
        for one in before:
            self.emit(depth, f"{one};")
        if isinstance(place.kind, Array):
            return self.fill(target, place, value, depth)
        if isinstance(place.kind, Record):
            if value.kind != place.kind:
                raise self.refused(target, "a record takes a record of the same fields")
            return self.emit(depth, f"*{place.closed} = *{value.closed};")
        self.emit(depth, f"{place.text} = {self.cast(value, place.kind)};")

    def keep(self, target: ast.Name, value: Value, depth: int) -> None:
        """Put a value into a variable."""
        if value.kind is None:
            raise self.refused(target, f"nothing is returned for {target.id}")
        if target.id == "_":
            return self.emit(depth, f"{value.text};")
        kind = joined(self.kinds.get(target.id), value.kind)
        if kind is None or (isinstance(kind, Given) and self.kinds.get(target.id, kind) != kind):
            raise self.refused(target, f"{target.id} is of one kind here and of another there")
        self.kinds[target.id] = kind
        if kind is not NONE and not isinstance(kind, Given):
            self.emit(depth, f"{name_in_c(target.id)} = {self.cast(value, kind)};")

    def fill_column(self, target: ast.Subscript, rows: ast.Slice, column: ast.expr, value: Value, depth: int) -> None:
        """``a[2:5, k] = 0.0``."""
        before, array = self.fixed(self.ex(target.value))
        if not isinstance(value.kind, Number) or not isinstance(array.kind, Array) or array.kind.axes != 2:
            raise self.refused(target, "a part of a column takes one number")
        first, length = self.part(array, rows, before)
        for one in before:
            self.emit(depth, f"{one};")
        value = value if value.known is not None else self._copied(value, depth)
        k, place = self.temporary(INT), self.index(column, f"{array.closed}.n1")
        start = self._copied(Value(first, INT), depth).text
        end = self._copied(Value(length, INT), depth).text
        element = self.place(array, [f"{start} + {k}", place])
        text = self.cast(value, element.kind)
        self.emit(depth, f"for ({k} = 0; {k} < {end}; {k}++) {element.text} = {text};")

    def fill(self, target: ast.Subscript, part: Value, value: Value, depth: int) -> None:
        """``a[2:5] = 0.0`` and ``a[2:5] = b``."""
        name = self._copied(part, depth).text
        axes = [f"{name}.n{axis}" for axis in range(part.kind.axes)]
        if isinstance(value.kind, Array):
            if value.kind.item != part.kind.item or value.kind.axes != part.kind.axes:
                raise self.refused(target, "arrays of different kinds: write a loop")
            other = self._copied(value, depth).text
            if self.checked:
                self.emit(depth, f"{self.tested('bg_same', f'{other}.n0', f'{name}.n0', node=target)};")
            return self.emit(depth, f"memmove({name}.p, {other}.p, {' * '.join(axes)} * sizeof *{name}.p);")
        if not isinstance(value.kind, Number) or isinstance(part.kind.item, Record):
            raise self.refused(target, "a part of an array takes one number, or an array of the same length")
        if value.known is None:
            value = self._copied(value, depth)
        text = self.cast(value, part.kind.item)
        self.loops += 1
        k = f"bg_j{self.loops}"
        self.emit(depth, f"for (int64_t {k} = 0; {k} < {' * '.join(axes)}; {k}++) {name}.p[{k}] = {text};")

    def st_If(self, node: ast.If, depth: int) -> bool:
        """``if``: a branch that is never taken leaves nothing."""
        if (known := self.settled(node.test)) is not None:
            return self.block(node.body if known else node.orelse, depth)
        self.emit(depth, f"if ({self.condition(node.test).text}) {{")
        leaves = self.block(node.body, depth + 1)
        if node.orelse:
            self.emit(depth, "} else {")
            leaves = self.block(node.orelse, depth + 1) and leaves
        self.emit(depth, "}")
        return leaves and bool(node.orelse)

    def st_While(self, node: ast.While, depth: int) -> None:
        """``while``."""
        if node.orelse:
            raise self.refused(node, "a loop has no else in kernels")
        self.emit(depth, f"while ({self.condition(node.test).text}) {{")
        self.block(node.body, depth + 1)
        self.emit(depth, "}")

    def st_For(self, node: ast.For, depth: int) -> None:
        """``for`` over a range or an array of numbers."""
        if node.orelse:
            raise self.refused(node, "a loop has no else in kernels")
        self.loops += 1
        k, end, by = f"bg_i{self.loops}", f"bg_end{self.loops}", f"bg_step{self.loops}"
        is_range = isinstance(node.iter, ast.Call) and ast.unparse(node.iter.func) == "range"
        if not is_range:
            before, array = self.fixed(self.ex(node.iter))
            if not isinstance(array.kind, Array) or not isinstance(node.target, ast.Name):
                raise self.refused(node, "a loop is over a range or an array")
            for one in before:
                self.emit(depth, f"{one};")
            self.emit(depth, f"for (int64_t {k} = 0; {k} < {array.closed}.n0; {k}++) {{")
            item = self.place(array, [k]) if array.kind.axes == 1 else self.row(array, [k])
            self.store(node.target, self.widened(item), depth + 1)
        else:
            assert isinstance(node.iter, ast.Call)
            numbers = [self.whole(argument) for argument in node.iter.args]
            first = numbers[0].text if len(numbers) > 1 else "0"
            last = numbers[min(1, len(numbers) - 1)].text
            step = numbers[2] if len(numbers) > 2 else Value("1", INT, 1)
            more = "" if step.known is not None else f", {by} = {step.text}"
            by = step.text if step.known is not None else by
            test = f"{k} < {end}" if (step.known or 0) > 0 else f"{k} > {end}"
            if step.known is None:
                test = f"{by} > 0 ? {k} < {end} : {k} > {end}"
            self.emit(depth, f"for (int64_t {k} = {first}, {end} = {last}{more}; {test}; {k} += {by}) {{")
            self.store(node.target, Value(k, INT), depth + 1)
        self.block(node.body, depth + 1)
        self.emit(depth, "}")

    def st_Break(self, node: ast.Break, depth: int) -> None:
        """``break``."""
        self.emit(depth, "break;")

    def st_Continue(self, node: ast.Continue, depth: int) -> None:
        """``continue``."""
        self.emit(depth, "continue;")
