"""Pages of the documentation site that show the executed notebooks ``notebooks/*.ipynb``."""

from __future__ import annotations

import base64
import json
import pathlib
from typing import Any

FOLDER = pathlib.Path(__file__).resolve().parents[1] / "notebooks"


def render() -> dict[str, str | bytes]:
    """The files of the site by name: of each notebook its page, its pictures, and the notebook itself."""
    files: dict[str, str | bytes] = {}
    for path in sorted(FOLDER.glob("*.ipynb")):
        text = path.read_text("utf-8")
        files[path.name] = text.encode()
        parts = []
        for cell in json.loads(text)["cells"]:
            source = "".join(cell["source"])
            parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
            for output in cell.get("outputs", ()):
                parts.append(_output(output, files, path.stem))
        title, _, rest = "\n\n".join(parts).partition("\n")
        source = f"`vinesim examples` copies this notebook, or [download it]({path.name})."
        files[f"{path.stem}.md"] = f"{title}\n\n{source}\n{rest}\n"
    return files


def _output(output: Any, files: dict[str, str | bytes], name: str) -> str:
    """Markdown of an output of a cell; its picture, if it has one, is added to ``files``."""
    data = output.get("data", {})
    if "image/png" in data:
        picture = f"{name}-{sum(file.startswith(f'{name}-') for file in files) + 1}.png"
        files[picture] = base64.b64decode("".join(data["image/png"]))
        return f"![result of the cell above]({picture})"
    text = "".join(data.get("text/plain", output.get("text", "")))
    return f"```text\n{text.rstrip()}\n```"
