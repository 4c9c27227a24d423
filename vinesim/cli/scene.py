"""``vinesim scene``."""

from __future__ import annotations

import pathlib

from rich.console import Console
from rich.table import Table

from vinesim.errors import WriteError
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene, with_seed
from vinesim.scene.summary import summary_rows as rows_of
from vinesim.sensors.export.images import render_overview
from vinesim.sensors.scene.primitives import rest_snapshot


def show(file: str, seed: int | None, out: pathlib.Path | None) -> int:
    """Print a table of the scene and write its picture; the exit code."""
    scene = with_seed(load_scene(file), seed)
    model = generate(scene)
    console = Console()
    table = Table(title=f"scene {scene.name}, seed {scene.seed}", title_justify="left", show_header=False)
    for quantity, value, unit in rows_of(scene, model):
        table.add_row(quantity, value, unit)
    console.print(table)
    target = out or pathlib.Path(f"{scene.name}.png")
    try:
        render_overview(model, rest_snapshot(model), target, sun=scene.sun.direction())
    except OSError as bad:
        raise WriteError(f"--out {target} cannot be written: {bad.strerror or bad}; give another file") from None
    console.print(f"picture: {target}")
    return 0
