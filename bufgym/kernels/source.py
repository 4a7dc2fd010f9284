"""The source of a kernel as a syntax tree, with the names that it reads from outside."""

import ast
import functools
import hashlib
import linecache
from types import CodeType, FunctionType
from typing import Any

from bufgym.kernels.kinds import KernelError


def plain(function: Any) -> Any:
    """The Python function of a kernel; any other function as it is."""
    return getattr(function, "py_func", function)


@functools.cache
def _functions(file: str, text: str) -> dict[tuple[str, int], list[Any]]:
    """(name, first line) -> the functions of a file that begin there; a decorator's line counts."""
    found: dict[tuple[str, int], list[Any]] = {}
    try:
        tree = ast.parse(text)
    except SyntaxError as error:
        raise KernelError(f"{file}: is no Python any more ({error.msg}, line {error.lineno}); start again") from None
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
            found.setdefault((node.name, first), []).append(node)
        elif isinstance(node, ast.Lambda):
            found.setdefault(("<lambda>", node.lineno), []).append(node)
    return found


def tree_of(function: FunctionType) -> ast.FunctionDef:
    """The syntax tree of a function, from its file as it was imported."""
    code = function.__code__
    text = "".join(linecache.getlines(code.co_filename, function.__globals__))
    if not text:
        raise KernelError(f"{function.__qualname__}: its source is not there to read")
    found = _functions(code.co_filename, text).get((code.co_name, code.co_firstlineno), [])
    fitting = [node for node in found if _fits(node, code)]
    if not fitting or _meaning(code) not in _meanings(code.co_filename, text):
        raise KernelError(f"{code.co_filename}: has changed since {function.__qualname__} was imported; start again")
    node = fitting[0]
    if isinstance(node, ast.FunctionDef):
        return node
    body = ast.copy_location(ast.Return(node.body), node.body)
    made = ast.FunctionDef("field", node.args, [body], [])
    return ast.copy_location(made, node)


def _meaning(code: CodeType) -> Any:
    """What a function computes: its name, place, instructions and constants."""
    constants = [constant for constant in code.co_consts if not isinstance(constant, CodeType)]
    return code.co_name, code.co_firstlineno, code.co_code, repr(constants)


@functools.cache
def _meanings(file: str, text: str) -> set[Any]:
    """Those of all functions of a file, as it is now."""
    found, waiting = set(), [compile(text, file, "exec", dont_inherit=True)]
    while waiting:
        code = waiting.pop()
        found.add(_meaning(code))
        waiting += [inner for inner in code.co_consts if isinstance(inner, CodeType)]
    return found


def _fits(node: Any, code: CodeType) -> bool:
    """Whether the tree is of this code: the same arguments and names; of several lambdas in a line, the same place."""
    arguments = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
    count = code.co_argcount + code.co_kwonlyargcount
    if tuple(argument.arg for argument in arguments) != code.co_varnames[:count]:
        return False
    used = {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}
    used |= {part.attr for part in ast.walk(node) if isinstance(part, ast.Attribute)}
    if not used.issuperset((*code.co_names, *code.co_freevars)):
        return False
    if isinstance(node, ast.FunctionDef):
        return True
    places = [(p[0], p[2]) for p in code.co_positions() if p[0] is not None and p[2] is not None]
    inside = [place for place in places if place != (code.co_firstlineno, 0)]
    return not inside or (node.body.lineno, node.body.col_offset) <= min(inside) <= (
        node.end_lineno, node.end_col_offset)  # fmt: skip


def outside(function: FunctionType) -> dict[str, Any]:
    """Name -> value of all that a function reads from outside itself."""
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    return {**function.__globals__, **{name: cell.cell_contents for name, cell in cells}}


def generated(text: str) -> str:
    """Keep the source of a generated function where ``tree_of`` finds it; return the name to compile it under."""
    file = f"<generated {hashlib.sha256(text.encode()).hexdigest()[:12]}>"
    linecache.cache[file] = (len(text), None, text.splitlines(keepends=True), file)
    return file
