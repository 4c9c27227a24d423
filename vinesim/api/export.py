"""Exports vineyards for other simulators."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Mapping, Sequence

import numpy as np

from vinesim.api.simulation import Source, base_pose, model_of
from vinesim.export.vineyard_file import check_file, write_vineyard
from vinesim.robot.description.loader import load_description
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.spec import Scene, load_scene


def export_vineyard(
    source: Source,
    file: str | os.PathLike[str],
    *,
    leaves: bool = False,
    robots: Mapping[str, tuple[str | pathlib.Path, Sequence[float] | np.ndarray]] = {},
) -> None:
    """Write a vineyard or canes for another simulator: bodies on hinges with springs, wood, wires, ground, boxes.

    docs/export.md explains what each format contains.

    Args:
        source: a model; a scene; the name or the file of a scene; one or more builders of canes or trees.
        file: MJCF (``.xml``), URDF (``.urdf``), or OpenUSD (``.usda``, ``.usdc``, ``.usd``), which needs the extra
            ``export``.
        leaves: whether leaves are drawn. They never collide; their mass is always part of their cane.
        robots: robots at rest beside the plants, by name: file or name of the robot, and its pose as in
            :meth:`Simulation.add_robot`. In MJCF only.

    Raises:
        UsdMissing: usd-core is not installed.
        UsageError: the suffix is unknown, the folder of the file does not exist, or the format has no robots.
        DescriptionError: a robot cannot be used.
        RobotError: a robot cannot be written.
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
    model = model_of(source)
    specs = [
        load_description(robot).to_spec(called, index, base_pose(pose, model.terrain))
        for index, (called, (robot, pose)) in enumerate(robots.items())
    ]
    write_vineyard(model, path, name=name, leaves=leaves, parameters=parameters, robots=specs)
