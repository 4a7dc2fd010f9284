"""Descriptions that stand below fields: where ``help`` finds those of named tuples, and as texts."""

import ast
import inspect
import textwrap
from typing import Any, TypeVar

Class = TypeVar("Class", bound=type[Any])


def documented(named_tuple: Class) -> Class:
    """Make the string below each field its docstring; ``help`` would otherwise show "Alias for field number 7"."""
    texts = below_fields(named_tuple)
    for field in named_tuple._fields:
        getattr(named_tuple, field).__doc__ = texts[field]
    return named_tuple


def below_fields(class_: type[Any]) -> dict[str, str]:
    """Map each field of a class to the string below it, where one stands there."""
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(class_))).body
    assert isinstance(definition, ast.ClassDef)
    found: dict[str, str] = {}
    for field, text in zip(definition.body, definition.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                found[field.target.id] = inspect.cleandoc(str(text.value.value))
    return found
