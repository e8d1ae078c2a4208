"""Docstrings of a class's fields: the string that stands below each."""

import ast
import functools
import inspect
import textwrap
from dataclasses import is_dataclass
from itertools import pairwise


def field_docstrings(cls: type) -> dict[str, str]:
    """Field -> docstring, of a dataclass and the dataclasses that it derives from; empty where there is no source.

    pydantic's `use_attribute_docstrings` finds them by the frame that defines the class, and loses them where it builds the class again later; this
    reads the source when somebody asks, so that commands that do not show them need not wait for it.
    """
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if is_dataclass(base):
            found |= _own(base)
    return found


@functools.cache
def _own(cls: type) -> dict[str, str]:
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(cls)))
    except (OSError, TypeError, SyntaxError):
        return {}
    body = tree.body[0].body if isinstance(tree.body[0], ast.ClassDef) else []
    return {
        field.target.id: " ".join(words.value.value.split())
        for field, words in pairwise(body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(words, ast.Expr)
        and isinstance(words.value, ast.Constant)
        and isinstance(words.value.value, str)
    }
