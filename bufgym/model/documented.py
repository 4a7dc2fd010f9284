"""Descriptions that stand below fields: where ``help`` finds those of named tuples, and as texts."""

import ast
import inspect
import linecache
import re
import sys
from typing import Any, TypeVar

Class = TypeVar("Class", bound=type[Any])


def documented(named_tuple: Class) -> Class:
    """Make the string below each field its docstring; ``help`` would otherwise show "Alias for field number 7"."""
    texts = below_fields(named_tuple)
    for field in named_tuple._fields:
        getattr(named_tuple, field).__doc__ = texts[field]
    return named_tuple


def below_fields(class_: type[Any]) -> dict[str, str]:
    """Map each field of a module's class to the string below it, where one stands there."""
    # inspect.getsource would parse the whole module at each import, to find these lines.
    text = "".join(linecache.getlines(str(sys.modules[class_.__module__].__file__)))
    found_at = re.search(rf"^class {class_.__name__}\b.*\n(?:[ \t].*\n|\n)*", text, re.MULTILINE)
    assert found_at is not None, class_
    (definition,) = ast.parse(found_at[0]).body
    assert isinstance(definition, ast.ClassDef)
    found: dict[str, str] = {}
    for field, below in zip(definition.body, definition.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                found[field.target.id] = inspect.cleandoc(str(below.value.value))
    return found
