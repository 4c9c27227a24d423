"""No cycle in the graph of modules: what a module imports, at its top or in a function, never imports it back.

Imports under ``if TYPE_CHECKING`` count: a type that two modules need from each other is a cycle of concepts, too.
"""

import ast
import pathlib

ROOT = pathlib.Path(__file__).parents[2]


def imports_of(path: pathlib.Path, modules: set[str]) -> set[str]:
    """Modules of the package that one file imports, wherever in the file."""
    found = set()
    waiting: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while waiting:
        node = waiting.pop()
        # an import is a statement: what is inside an expression need not be looked at
        waiting += [child for child in ast.iter_child_nodes(node) if not isinstance(child, ast.expr)]
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found |= {full if (full := f"{node.module}.{name.name}") in modules else node.module for name in node.names}
    return found & modules


def module_graph() -> dict[str, set[str]]:
    """Imports of all modules; not of ``vinesim`` itself, whose names of the public API are only loaded when used."""
    files = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
        for path in sorted((ROOT / "vinesim").rglob("*.py"))
    }
    return {name: imports_of(path, set(files)) - {name} if name != "vinesim" else set() for name, path in files.items()}


def cycles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected components of more than one module (Tarjan 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found = []

    def visit(name: str) -> None:
        index[name] = low[name] = len(index)
        stack.append(name)
        for other in sorted(graph[name]):
            if other not in index:
                visit(other)
                low[name] = min(low[name], low[other])
            elif other in stack:
                low[name] = min(low[name], index[other])
        if low[name] == index[name]:
            component = stack[stack.index(name) :]
            del stack[stack.index(name) :]
            if len(component) > 1:
                found.append(sorted(component))

    for name in graph:
        if name not in index:
            visit(name)
    return found


def test_modules_import_each_other_in_one_direction() -> None:
    assert cycles(module_graph()) == []


def test_a_cycle_is_found() -> None:
    assert cycles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]
