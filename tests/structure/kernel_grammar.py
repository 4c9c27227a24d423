"""The grammar of Warp kernels, read from their source: ``python tests/structure/kernel_grammar.py FILE...``

A kernel's arguments stand under the comment lines ``# model``, ``# in``, ``# out``, in that order; what it writes is
under ``# out``, and those names, and only those, end in ``_out``. It has at most 20 arguments (``wp.struct`` groups
arrays). Its docstring names what one thread does, and may give shapes, units and sources in as many lines as it needs.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

GROUPS = ("model", "in", "out")
MAX_ARGUMENTS = 20


def decorated(function: ast.FunctionDef, name: str) -> bool:
    """Whether ``@wp.<name>`` or ``@wp.<name>(...)`` stands above the function."""
    heads = (d.func if isinstance(d, ast.Call) else d for d in function.decorator_list)
    return any(ast.unparse(head) in (f"wp.{name}", f"warp.{name}") for head in heads)


def written(function: ast.FunctionDef) -> Iterator[tuple[str, int]]:
    """Name and line of every array element stored to, augmented, or handed to ``wp.atomic_*``."""
    for node in ast.walk(function):
        if isinstance(node, ast.Call) and ast.unparse(node.func).startswith(("wp.atomic_", "warp.atomic_")):
            targets = node.args[:1]
        elif isinstance(node, ast.Assign):
            targets = [part for target in node.targets for part in ast.walk(target) if isinstance(part, ast.Subscript)]
        elif isinstance(node, (ast.AugAssign, ast.AnnAssign)) and isinstance(node.target, ast.Subscript):
            targets = [node.target]
        else:
            continue
        for target in targets:
            while isinstance(target, (ast.Subscript, ast.Attribute)):
                target = target.value
            if isinstance(target, ast.Name):
                yield target.id, node.lineno


def grouped(function: ast.FunctionDef, lines: list[str]) -> dict[str, str | None]:
    """The group under which each argument stands."""
    groups = {}
    current = None
    line = function.lineno
    for argument in function.args.args:
        for text in lines[line - 1 : argument.lineno]:
            mark = text.strip().removeprefix("#").strip()
            current = mark if text.strip().startswith("#") and mark in GROUPS else current
        line = argument.lineno
        groups[argument.arg] = current
    return groups


def breaches(source: str, name: str = "<source>") -> list[str]:
    """Every breach of the grammar, one line each with file, line and remedy."""
    found = []
    lines = source.splitlines()
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef):
            continue
        arguments = [argument.arg for argument in function.args.args]
        if decorated(function, "func"):
            found += [
                f"{name}:{line}: {function.name} writes its argument {target}; call it {target}_out"
                for target, line in written(function)
                if target in arguments and not target.endswith("_out")
            ]
        if not decorated(function, "kernel"):
            continue
        where = f"{name}:{function.lineno}: {function.name}"
        groups = grouped(function, lines)
        order = [GROUPS.index(group) if group else -1 for group in groups.values()]
        if -1 in order or order != sorted(order):
            found.append(f"{where}: put the arguments under # model, # in, # out, in that order")
        found += [
            f"{where}: {a} is under # out; call it {a}_out"
            for a, g in groups.items()
            if g == "out" and not a.endswith("_out")
        ]
        found += [
            f"{where}: {a} ends in _out; put it under # out"
            for a, g in groups.items()
            if g != "out" and a.endswith("_out")
        ]
        if "thread" not in (ast.get_docstring(function) or "").lower():
            found.append(f"{where}: name in its docstring what one thread does")
        if len(arguments) > MAX_ARGUMENTS:
            found.append(f"{where}: {len(arguments)} arguments; group them in wp.struct's, {MAX_ARGUMENTS} at most")
        found += [
            f"{name}:{line}: {function.name} writes {target}, which is not under # out"
            for target, line in written(function)
            if groups.get(target, "out") != "out"
        ]
    return found


if __name__ == "__main__":
    bad = [breach for path in sys.argv[1:] for breach in breaches(Path(path).read_text(), path)]
    print("\n".join(bad) or "all kernels keep to the grammar")
    sys.exit(bool(bad))
