"""Hooks of the documentation site (mkdocs.yml): the first page of decisions lists all of them by their titles."""

from __future__ import annotations

import pathlib
from typing import Any


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """The page's text; that of decisions with a link to each decision."""
    if page.file.src_uri != "decisions/README.md":
        return markdown
    folder = pathlib.Path(page.file.abs_src_path).parent
    pages = [path for path in sorted(folder.glob("*.md")) if path.name != "README.md"]
    titles = {path.name: path.read_text().partition("\n")[0].lstrip("# ") for path in pages}
    return f"{markdown}\n\n" + "\n".join(f"- [{title}]({name})" for name, title in titles.items()) + "\n"
