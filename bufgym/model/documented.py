"""Field descriptions of named tuples, in the place where ``help`` finds them."""

import ast
import inspect
import textwrap
from typing import Any, TypeVar

Class = TypeVar("Class", bound=type[Any])


def documented(named_tuple: Class) -> Class:
    """Make the string below each field its docstring; ``help`` would otherwise show "Alias for field number 7"."""
    definition = ast.parse(textwrap.dedent(inspect.getsource(named_tuple))).body[0]
    assert isinstance(definition, ast.ClassDef)
    for field, text in zip(definition.body, definition.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            assert isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
            getattr(named_tuple, field.target.id).__doc__ = inspect.cleandoc(str(text.value.value))
    return named_tuple
