"""Docstrings describe arguments that exist."""

import ast
import pathlib
import re
from collections.abc import Iterator

ROOT = pathlib.Path(__file__).parents[2]
FILES = sorted((ROOT / "vinesim").rglob("*.py"))

ENTRY = re.compile(r"( *)\**(\w+): ")
"""An argument in a section ``Args:``."""
IN_PROSE = re.compile(r"(?:^|[.:;] )``(\w+)``(?: \[[^\]]*\])?: ", re.MULTILINE)
"""An argument that is described in the text: ``name``: what it is."""


def described(docstring: str) -> list[str]:
    """Names of the arguments that a docstring describes."""
    names = IN_PROSE.findall(docstring)
    section = re.split(r"^ *Args:\n", docstring, maxsplit=1, flags=re.MULTILINE)
    if len(section) == 2:
        entries = [ENTRY.match(line) for line in section[1].split("\n\n")[0].splitlines()]
        found = [entry for entry in entries if entry is not None]
        least = min((len(entry[1]) for entry in found), default=0)
        names += [entry[2] for entry in found if len(entry[1]) == least and entry[2] not in ("Returns", "Raises")]
    return names


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> set[str]:
    """Names of the parameters of a function."""
    given = function.args
    every = [*given.posonlyargs, *given.args, *given.kwonlyargs, *filter(None, (given.vararg, given.kwarg))]
    return {one.arg for one in every}


def unknown_arguments(source: str) -> Iterator[str]:
    """``function: argument`` for what docstrings describe, and the function or the constructor of the class lacks."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ClassDef):
            fields = {
                one.target.id
                for one in node.body
                if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name)
            }
            makers = [one for one in node.body if isinstance(one, ast.FunctionDef) and one.name == "__init__"]
            known = fields.union(*map(parameters, makers))
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            known = parameters(node)
        else:
            continue
        for name in described(ast.get_docstring(node) or ""):
            if name not in known:
                yield f"{node.name}: {name}"


def test_docstrings_describe_arguments_that_exist():
    found = {str(path.relative_to(ROOT)): list(unknown_arguments(path.read_text())) for path in FILES}
    assert {file: names for file, names in found.items() if names} == {}


def test_a_wrong_argument_is_found():
    source = '''
class Rollout:
    """Runs.

    Args:
        watch: bodies. Further lines
            may say more: much more.
        ticks: how many.
    """
    def __init__(self, ticks, watched): ...
def f(a):
    """Do it. ``a``: one. ``b`` [3] m: another."""
def g(c):
    """Do it. ``d``: one."""
'''
    assert list(unknown_arguments(source)) == ["Rollout: watch", "g: d"]
