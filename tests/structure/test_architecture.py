"""docs/architecture.md names every package, and every module has a docstring that states its purpose."""

import importlib.util
import pathlib

ROOT = pathlib.Path(__file__).parents[2]


def _tool():
    spec = importlib.util.spec_from_file_location("list_modules", ROOT / "tools/list_modules.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_module_states_its_purpose():
    summary = _tool().summary
    assert [str(p.relative_to(ROOT)) for p in (ROOT / "vinesim").rglob("*.py") if not summary(p)] == []


def test_docs_architecture_names_every_package():
    text = (ROOT / "docs/architecture.md").read_text()
    packages = {p.parent.relative_to(ROOT / "vinesim") for p in (ROOT / "vinesim").rglob("__init__.py")}
    assert [str(p) for p in packages if len(p.parts) == 1 and f"{p}/" not in text] == []
