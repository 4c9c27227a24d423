"""Every module with the first line of its docstring: a page of the site. ``python tools/list_modules.py`` prints it."""

from __future__ import annotations

import ast
import pathlib

ROOT = pathlib.Path(__file__).resolve().parent.parent
HEAD = """# Modules

The first lines of the docstrings of all modules.
"""


def summary(path: pathlib.Path) -> str:
    """The first paragraph of a module's docstring on one line; empty without one."""
    text = ast.get_docstring(ast.parse(path.read_text())) or ""
    return " ".join(text.split("\n\n")[0].split())


def render() -> str:
    """The page in Markdown."""
    lines = [HEAD]
    package = ROOT / "vinesim"
    folders = [package, *sorted(p for p in package.rglob("*") if (p / "__init__.py").is_file())]
    for folder in folders:
        name = folder.relative_to(ROOT)
        lines += [f"## {name}/", "", summary(folder / "__init__.py"), ""]
        modules = [p for p in sorted(folder.glob("*.py")) if p.name != "__init__.py"]
        if modules:
            lines += ["| module | |", "|---|---|"]
            lines += [f"| `{path.name}` | {summary(path).replace('|', chr(92) + '|')} |" for path in modules]
            lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    print(render())
