"""Sizes: at most 500 lines a file, 80 lines a function, or a reason in the docstring."""

from __future__ import annotations

import ast
from pathlib import Path

import vinesim

PACKAGE = Path(vinesim.__file__).parent
MAX_FILE_LINES = 500
MAX_FUNCTION_LINES = 80
"""Without the docstring."""


def has_reason(node: ast.Module | ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Whether the first line of the docstring states why the file or the function is long, after ``reason:``."""
    return "reason:" in (ast.get_docstring(node) or "").partition("\n")[0].lower()


def code_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function from ``def`` to its end, without its docstring."""
    lines = (function.end_lineno or function.lineno) - function.lineno + 1
    first = function.body[0]
    if ast.get_docstring(function) is not None:
        lines -= (first.end_lineno or first.lineno) - first.lineno + 1
    return lines


def offences(source: str, name: str = "<source>") -> list[str]:
    """Every file and function that is too long and gives no reason, with the remedy."""
    tree, found = ast.parse(source), []
    lines = source.count("\n")
    if lines > MAX_FILE_LINES and not has_reason(tree):
        found.append(f"{name}: {lines} lines; split it, or begin its docstring with what it is and 'reason: ...'")
    for node in ast.walk(tree):
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) or has_reason(node):
            continue
        if (lines := code_lines(node)) > MAX_FUNCTION_LINES:
            found.append(f"{name}:{node.lineno}: {node.name} has {lines} lines; split it, or give a 'reason: ...'")
    return found


def test_files_and_functions_are_short() -> None:
    files = sorted(PACKAGE.rglob("*.py"))
    found = [one for path in files for one in offences(path.read_text(), str(path.relative_to(PACKAGE)))]
    assert files
    assert not found, "\n".join(found)


def test_long_code_is_found_and_a_reason_excuses_it() -> None:
    body = "    x = 1\n" * 80
    assert offences("def f():\n" + body) == ["<source>:1: f has 81 lines; split it, or give a 'reason: ...'"]
    assert offences('def f():\n    """Add up; reason: one formula."""\n' + body) == []
    assert offences('def f():\n    """Short.\n\n    But\n    explained.\n    """\n' + body[:-10]) == []
    assert offences("x = 1\n" * 501)[0].startswith("<source>: 501 lines; split it")
    assert offences('"""Tables; reason: generated."""\n' + "x = 1\n" * 501) == []
