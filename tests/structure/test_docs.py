"""Pages name files that exist."""

import pathlib
import re
import sys

from tests.support import programs

ROOT = pathlib.Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
NAMED = re.compile(r"`((?:[a-z0-9_]+/)+[a-z0-9_]*(?:\.(?:py|md|toml|urdf))?)(?:::[^`]*)?`")


def missing(page: pathlib.Path) -> list[str]:
    """Paths named in a page that are neither in the checkout, nor in the package, nor written by a command."""
    names = {name for name in NAMED.findall(page.read_text()) if name.endswith((".py", ".md", ".toml", ".urdf"))}
    bases = (ROOT, ROOT / "vinesim", ROOT / "data", page.parent)
    return sorted(name for name in names if not any((base / name).exists() for base in bases))


def test_pages_name_files_that_exist():
    assert {str(page.relative_to(ROOT)): names for page in PAGES if (names := missing(page))} == {}


def test_the_glossary_names_places_that_exist():
    rows = [line for line in (ROOT / "docs/glossary.md").read_text().splitlines() if line.startswith("| ")]
    places = {place for row in rows for place in re.findall(r"`([a-z_/]+(?:/|\.py))`", row)}
    assert len(places) > 30
    assert [place for place in sorted(places) if not (ROOT / "vinesim" / place).exists()] == []


def test_the_python_of_the_readme_runs(tmp_path):
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    result = programs.run([sys.executable, "-c", code], cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    last = result.stdout.splitlines()[-1]
    assert last.startswith("3.0 ["), last
