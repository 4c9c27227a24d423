"""Exports vineyards for other simulators."""

from __future__ import annotations

import os
import pathlib

from vinesim.api.simulation import Source, model_of
from vinesim.export.vineyard_file import check_file, write_vineyard
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.spec import Scene, load_scene


def export_vineyard(source: Source, file: str | os.PathLike[str], *, leaves: bool = False) -> None:
    """Write a vineyard or canes for another simulator: bodies on hinges with springs, wood, wires, ground, boxes.

    docs/export.md explains what each format contains.

    Args:
        source: a model; a scene; the name or the file of a scene; one or more builders of canes or trees.
        file: MJCF (``.xml``), URDF (``.urdf``), or OpenUSD (``.usda``, ``.usdc``, ``.usd``), which needs the extra
            ``export``.
        leaves: whether leaves are drawn. They never collide; their mass is always part of their cane.

    Raises:
        UsdMissing: usd-core is not installed.
        UsageError: the suffix is unknown, or the folder of the file does not exist.
        WriteError: the file cannot be written.
    """
    path = check_file(file)
    if isinstance(source, (str, pathlib.Path)):
        source = load_scene(source)
    name = "vineyard"
    parameters = PhysicsParameters()
    if isinstance(source, Scene):
        name = source.name
        parameters = source.physics
    write_vineyard(model_of(source), path, name=name, leaves=leaves, parameters=parameters)
