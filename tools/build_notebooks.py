"""Runs the sources of the notebooks, ``notebooks/*.py``, and writes what they show: ``notebooks/*.ipynb``.

    python tools/build_notebooks.py            # all whose source has changed
    python tools/build_notebooks.py first_steps

Needs the extra ``docs`` (jupytext, nbclient, ipykernel). ``tests/docs/test_notebooks.py`` compares the written
notebooks with their sources.
"""

from __future__ import annotations

import argparse
import os
import pathlib
import sys
import tempfile
import time
from typing import Any

import jupytext
import nbclient
import nbformat

ROOT = pathlib.Path(__file__).resolve().parents[1]
FOLDER = ROOT / "notebooks"
KEPT = ("image/png", "text/markdown", "text/plain")
"""Forms of an output that a written notebook keeps."""
LIMIT = 600
"""Time after which a cell has failed [s]."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", help="notebooks to build, without .py; by default those that are stale")
    names = parser.parse_args().names
    known = sorted(path.stem for path in FOLDER.glob("*.py"))
    if unknown := [name for name in names if name not in known]:
        print(f"no notebook {unknown[0]!r}; there are: {', '.join(known)}", file=sys.stderr)
        return 2
    for name in names or [name for name in known if _stale(name)]:
        begun = time.monotonic()
        print(f"{name} ...", end=" ", flush=True)
        (FOLDER / f"{name}.ipynb").write_text(build(FOLDER / f"{name}.py"), encoding="utf-8")
        print(f"{time.monotonic() - begun:.0f} s", flush=True)
    return 0


def _stale(name: str) -> bool:
    """Returns whether the cells of a notebook differ from those of its source."""
    path = FOLDER / f"{name}.ipynb"
    if not path.is_file():
        return True
    return _cells(nbformat.read(path, 4)) != _cells(jupytext.read(FOLDER / f"{name}.py"))


def _cells(notebook: Any) -> list[tuple[str, str]]:
    return [(cell.cell_type, cell.source) for cell in notebook.cells]


def build(source: pathlib.Path) -> str:
    """Returns the executed notebook of a source, as text. The same source and outputs yield the same text."""
    notebook = jupytext.read(source)
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as folder:
        nbclient.NotebookClient(
            notebook,
            timeout=LIMIT,
            kernel_name="python3",
            record_timing=False,
            resources={"metadata": {"path": folder}},
        ).execute()
    for number, cell in enumerate(notebook.cells):
        cell.id = f"cell-{number}"
        cell.metadata.clear()
        if cell.cell_type == "code":
            cell.outputs = [kept for output in cell.outputs if (kept := _keep(output))]
    notebook.metadata = nbformat.from_dict(
        {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        }
    )
    nbformat.validate(notebook)
    return nbformat.writes(notebook) + "\n"


def _keep(output: Any) -> Any:
    """Returns an output with the forms that a written notebook keeps, or None for one that has none of them."""
    if output.output_type == "stream":
        return output if output.name == "stdout" else None  # progress goes to stderr
    if "data" not in output:
        return output
    if {"text/html", "application/vnd.jupyter.widget-view+json"} & output.data.keys():
        return None  # a page of a running client, or sliders: both live only while the notebook runs
    output.data = {form: value for form, value in output.data.items() if form in KEPT}
    output.metadata = {}
    if "image/png" in output.data:
        output.data.pop("text/plain", None)  # <Figure size ...>
    return output if output.data else None


if __name__ == "__main__":
    sys.exit(main())
