"""Hooks of the documentation site (mkdocs.yml): its version, the list of modules, the list of decisions, and a page of
each notebook."""

from __future__ import annotations

import pathlib
import re
import runpy
import sys
from typing import Any

from mkdocs.structure.files import File

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import list_modules
import notebook_pages


def on_config(config: Any) -> Any:
    """The configuration, with the version of vinesim in the site's name."""
    version = runpy.run_path(str(pathlib.Path(__file__).parents[1] / "vinesim/core/version.py"))["__version__"]
    config.site_name = f"vinesim {version}"
    return config


def on_files(files: Any, *, config: Any) -> Any:
    """The files of the site, with a page that lists all modules, and the notebooks with a page of each."""
    files.append(File.generated(config, "modules.md", content=list_modules.render()))
    for name, content in notebook_pages.render().items():
        files.append(File.generated(config, f"tutorials/{name}", content=content))
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """The page's text; that of decisions with a link to each decision, that of notebooks with a link to each page."""
    if page.file.src_uri == "tutorials/notebooks.md":
        return re.sub(r"`notebooks/(\w+)\.py`", r"[`notebooks/\1.py`](\1.md)", markdown)
    if page.file.src_uri != "decisions/README.md":
        return markdown
    folder = pathlib.Path(page.file.abs_src_path).parent
    pages = [path for path in sorted(folder.glob("*.md")) if path.name != "README.md"]
    titles = {path.name: path.read_text().partition("\n")[0].lstrip("# ") for path in pages}
    return f"{markdown}\n\n" + "\n".join(f"- [{title}]({name})" for name, title in titles.items()) + "\n"
