"""docs/architecture.md shows the tree as it is."""

import pathlib
import re

ROOT = pathlib.Path(__file__).parents[2]


def drawn():
    """Paths drawn in the tree of docs/architecture.md: indentation by two spaces, one name a line."""
    text = (ROOT / "docs/architecture.md").read_text()
    block = re.search(r"```tree\n(.*?)```", text, re.S).group(1)
    stack, paths = [], {}
    for line in block.splitlines():
        name, _, comment = line.strip().partition(" ")
        depth = (len(line) - len(line.lstrip())) // 2
        stack = [*stack[:depth], name.rstrip("/")]
        paths["/".join(stack)] = comment.strip()
    return paths


def real():
    package = ROOT / "vinesim"
    files = [p for p in package.rglob("*.py") if p.name != "__init__.py"]
    folders = {q for p in files for q in p.relative_to(ROOT).parents if str(q) != "."}
    return {str(p.relative_to(ROOT)) for p in files} | {str(f) for f in folders}


def test_the_drawn_tree_is_the_real_tree():
    assert set(drawn()) == real()


def test_every_file_says_what_it_is_for():
    assert [path for path, comment in drawn().items() if not comment] == []
    assert [p for p in real() if p.endswith(".py") and '"""' not in (ROOT / p).read_text()[:400]] == []
