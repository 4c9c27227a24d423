"""``vinesim notebooks``: copies the notebooks that ship with vinesim into a folder of the user."""

from __future__ import annotations

import pathlib
import shutil

from vinesim.core.data_files import notebook_dir
from vinesim.core.errors import UsageError, writing


def run(names: list[str], out: pathlib.Path | None) -> int:
    """Copy the named notebooks, or all, into ``out``; without ``out``, list them. Existing files are kept. Returns the
    exit code."""
    known = {path.stem: path for path in sorted(notebook_dir().glob("*.ipynb"))}
    if unknown := [name for name in names if name not in known]:
        raise UsageError(f"no notebook {unknown[0]!r}; there are: {', '.join(known)}")
    if out is None:
        print("\n".join(names or known))
        return 0
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    for name in names or known:
        target = out / known[name].name
        if target.exists():
            print(f"{target}: exists, kept")
            continue
        with writing(target):
            shutil.copyfile(known[name], target)
        print(target)
    return 0
