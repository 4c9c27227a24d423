"""``vinesim scene`` and ``vinesim export``: shows and exports scenes, and imports plants of other programs."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from vinesim.cli.render import parse_composition
from vinesim.core import frames
from vinesim.core.errors import WriteError
from vinesim.export.vineyard_file import check_file, write_vineyard
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.plant_import.imported_plant import import_plant
from vinesim.scene.plant_import.wood import build_model
from vinesim.scene.plant_parameters import load_plant
from vinesim.scene.spec import load_scene, with_seed
from vinesim.scene.summary import summary_rows as rows_of
from vinesim.sensors.export.images import render_overview
from vinesim.sensors.primitives.scene_primitives import rest_snapshot


def write_imported_plant(file: pathlib.Path, out: pathlib.Path | None, **options: Any) -> int:
    """Read another program's plant, write it as TOML, and print its contents and the filled numbers. Returns the exit
    code."""
    plant = import_plant(file, **options)
    target = out or pathlib.Path(f"{file.stem}.toml")
    plant.write(target)
    model = build_model(plant, frames.pose(np.zeros(3)), 0, load_plant(options["plants"]), 0)
    counts = model.counts()
    print(f"read     {plant.source}: {len(plant.nodes)} points, {len(plant.bunches)} bunches")
    print(
        f"moves    {counts['tree']} trees of {counts['body']} bodies, {model.body_mass.sum():.3g} kg; "
        f"{counts['fixed']} pieces of wood thicker than {1e3 * plant.wood.old_wood.value:.4g} mm are rigid"
    )
    for note in plant.notes:
        print(f"note     {note}")
    moduli = "moduli, density, damping and drag of wood"
    print(f"filled   {moduli}; diameters of {len(plant.filled)} points; from {options['plants']!r}, marked in the file")
    print(f"written  {target}; a scene loads it with [[imported]] file = {target.name!r}")
    return 0


def show(file: str, seed: int | None, out: pathlib.Path | None) -> int:
    """Print a table of the scene and write its picture. Returns the exit code."""
    scene = with_seed(load_scene(file), seed)
    model = generate(scene)
    console = Console(markup=False)
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


def export_scene(file: str, seed: int | None, out: pathlib.Path, leaves: bool, robots: Sequence[str] = ()) -> int:
    """Write a scene for another simulator, and print what was written. Returns the exit code."""
    path = check_file(out, "--out")
    scene = with_seed(load_scene(file), seed)
    model = generate(scene)
    specs = parse_composition(robots, (), ()).robot_specs(model.terrain) if robots else ()
    made = write_vineyard(model, path, name=scene.name, leaves=leaves, parameters=scene.physics, robots=specs)
    print(
        f"{path}: {len(made.links)} bodies of plants, {sum(link.mass for link in made.links):.4g} kg; "
        f"{len(made.ties)} ties, {len(made.fixed)} fixed pieces, {len(made.crates)} boxes; "
        f"{path.stat().st_size / 1e6:.1f} MB"
    )
    if path.suffix.lower() == ".xml":
        print(f"its time step is {1e3 * made.timestep:g} ms; a longer step may be unstable")
    return 0
