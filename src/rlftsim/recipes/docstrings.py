"""Docstrings of settings, which become help texts and comments of printed recipes. No torch is imported."""

import ast
import inspect
import textwrap
from dataclasses import is_dataclass
from itertools import pairwise


def summarize_docstring(documented: object) -> str:
    """First sentence or line of a docstring."""
    return (inspect.getdoc(documented) or "").partition("\n")[0]


def read_field_texts(config: type) -> dict[str, str]:
    """Docstrings below the fields of a dataclass, inherited fields included, each on a single line."""
    documentation: dict[str, str] = {}
    for owner in reversed(config.__mro__):
        if not is_dataclass(owner):
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(owner))).body[0].body  # type: ignore[attr-defined]
        # A field's docstring is the string that follows it; at run time it is gone, so the source is read.
        for statement, following in pairwise(body):
            if not isinstance(statement, ast.AnnAssign) or not isinstance(statement.target, ast.Name):
                continue
            if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
                documentation[statement.target.id] = " ".join(str(following.value.value).split())
    return documentation
