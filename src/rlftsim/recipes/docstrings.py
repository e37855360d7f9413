"""Docstrings of settings, which become help texts and comments of printed recipes. No torch is imported."""

import ast
import inspect
import linecache
from collections.abc import Iterator
from dataclasses import is_dataclass
from functools import cache
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
        body = _parse_classes(inspect.getsourcefile(owner) or "")[owner.__qualname__]
        # A field's docstring is the string that follows it; at run time it is gone, so the source is read.
        for statement, following in pairwise(body):
            if not isinstance(statement, ast.AnnAssign) or not isinstance(statement.target, ast.Name):
                continue
            if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
                documentation[statement.target.id] = " ".join(str(following.value.value).split())
    return documentation


@cache
def _parse_classes(path: str) -> dict[str, list[ast.stmt]]:
    """Statements of the classes in a source file, by qualified name. `inspect.getsource` parses the file for each."""
    return dict(_walk_classes(ast.parse("".join(linecache.getlines(path))).body, ""))


def _walk_classes(statements: list[ast.stmt], prefix: str) -> Iterator[tuple[str, list[ast.stmt]]]:
    for statement in statements:
        if isinstance(statement, ast.ClassDef):
            yield prefix + statement.name, statement.body
            yield from _walk_classes(statement.body, f"{prefix}{statement.name}.")
        elif isinstance(statement, ast.FunctionDef):
            yield from _walk_classes(statement.body, f"{prefix}{statement.name}.<locals>.")
