"""Every notebook runs to its end without a screen, uses the public interface alone, and ends with a check."""

import ast
import json
import os
import pathlib
import re
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))
PAGE = ROOT / "docs/tutorials/notebooks.md"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_uses_the_public_interface_and_ends_with_a_check(path):
    text = path.read_text()
    assert text.startswith("# %% [markdown]\n# # ")
    cells = re.split(r"^# %%", text, flags=re.M)
    checks = [node for node in ast.walk(ast.parse("# " + cells[-1])) if isinstance(node, ast.Assert)]
    assert checks, "the last cell has no check"
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom):
            public = node.module in ("vinesim.perception", "vinesim.tune") or not (node.module or "").startswith(
                "vinesim."
            )
            assert public, f"{node.module} is not public"
        if isinstance(node, ast.Import):
            assert not [alias.name for alias in node.names if alias.name.startswith("vinesim.")]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_executed_notebook_has_the_cells_of_its_source_and_results(path):
    """``tools/build_notebooks.py`` makes it. Its cells, as the source writes them, are the source."""
    executed = path.with_suffix(".ipynb")
    assert executed.is_file(), f"run: python tools/build_notebooks.py {path.stem}"
    cells = json.loads(executed.read_text())["cells"]
    source = path.read_text()
    written = ""
    for cell in cells:
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            text = "\n".join(f"# {line}".rstrip() for line in text.split("\n"))
        assert text in source, f"stale; run: python tools/build_notebooks.py {path.stem}\n{text}"
        written += text
    missing = [line for line in source.splitlines() if not line.startswith("# %%") and line and line not in written]
    assert not missing, f"stale; run: python tools/build_notebooks.py {path.stem}\n{missing}"
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell["outputs"]]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not [output for output in outputs if output["output_type"] == "error"]
    assert "/home/" not in executed.read_text()


@pytest.mark.long
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_its_check_holds(path, tmp_path):
    done = subprocess.run(
        [sys.executable, str(path)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Warning" not in done.stderr, done.stderr


def test_the_page_lists_every_notebook():
    assert sorted(re.findall(r"`notebooks/(\w+)\.py`", PAGE.read_text())) == [path.stem for path in NOTEBOOKS]
