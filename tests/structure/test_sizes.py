"""Sizes: at most 80 lines a function, or a reason in its docstring. A file is as long as its one subject needs."""

from __future__ import annotations

import ast
from pathlib import Path

import vinesim

PACKAGE = Path(vinesim.__file__).parent
MAX_LINES = 80
"""Of a function, without its docstring."""


def has_reason(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Whether the first line of the docstring states why the function is long, after ``reason:``."""
    return "reason:" in (ast.get_docstring(function) or "").partition("\n")[0].lower()


def code_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function from ``def`` to its end, without its docstring."""
    lines = (function.end_lineno or function.lineno) - function.lineno + 1
    first = function.body[0]
    if ast.get_docstring(function) is not None:
        lines -= (first.end_lineno or first.lineno) - first.lineno + 1
    return lines


def offences(source: str, name: str = "<source>") -> list[str]:
    """Every function that is too long and gives no reason, with the remedy."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) or has_reason(node):
            continue
        if (lines := code_lines(node)) > MAX_LINES:
            found.append(f"{name}:{node.lineno}: {node.name} has {lines} lines; split it, or give a 'reason: ...'")
    return found


def test_functions_are_short() -> None:
    files = sorted(PACKAGE.rglob("*.py"))
    found = [one for path in files for one in offences(path.read_text(), str(path.relative_to(PACKAGE)))]
    assert files
    assert not found, "\n".join(found)


def test_a_long_function_is_found_and_a_reason_excuses_it() -> None:
    body = "    x = 1\n" * 80
    assert offences("def f():\n" + body) == ["<source>:1: f has 81 lines; split it, or give a 'reason: ...'"]
    assert offences('def f():\n    """Add up; reason: one formula."""\n' + body) == []
    assert offences('def f():\n    """Short.\n\n    But\n    explained.\n    """\n' + body[:-10]) == []
