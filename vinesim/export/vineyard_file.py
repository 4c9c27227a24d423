"""Writes a vineyard into a file whose suffix chooses the format."""

from __future__ import annotations

import os
import pathlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence

from vinesim.core.errors import UsageError, writing
from vinesim.export.articulation import Vineyard, describe
from vinesim.export.mjcf import mjcf
from vinesim.export.urdf import urdf
from vinesim.export.usd import write_usd
from vinesim.rigid.robot_mjcf import RobotDocument, robot_document
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.values import RobotSpec

Write = Callable[[Vineyard, pathlib.Path, Sequence[RobotDocument]], None]


def _write_xml(document: Callable[[Vineyard, Sequence[RobotDocument]], ElementTree.Element]) -> Write:
    def write(vineyard: Vineyard, file: pathlib.Path, robots: Sequence[RobotDocument]) -> None:
        root = document(vineyard, robots)
        ElementTree.indent(root)
        file.write_text('<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n")

    return write


def _write_usd(vineyard: Vineyard, file: pathlib.Path, _robots: Sequence[RobotDocument]) -> None:
    write_usd(vineyard, file)


FORMATS: dict[str, tuple[Write, bool]] = {
    ".xml": (_write_xml(mjcf), False),
    ".urdf": (_write_xml(lambda vineyard, _robots: urdf(vineyard)), False),
    ".usda": (_write_usd, True),
    ".usdc": (_write_usd, True),
    ".usd": (_write_usd, True),
}
"""Writer of each suffix, and whether the hinges of a joint must be orthogonal."""


def check_file(file: str | os.PathLike[str], what: str = "file") -> pathlib.Path:
    """Returns the path of a file to write. Raises :class:`UsageError`, whose message names ``what``, if its suffix is
    not one of :data:`FORMATS` or its folder does not exist."""
    path = pathlib.Path(file)
    if path.suffix.lower() not in FORMATS:
        raise UsageError(f"{what} is {path}; give a file with one of the suffixes {', '.join(FORMATS)}")
    if not path.absolute().parent.is_dir():
        raise UsageError(f"{what} is {path}: its folder is not there; make it first")
    return path


def write_vineyard(
    model: Model,
    file: pathlib.Path,
    *,
    name: str,
    leaves: bool,
    parameters: PhysicsParameters,
    robots: Sequence[RobotSpec] = (),
) -> Vineyard:
    """Write a model into a file. The same model gives the same bytes. Returns what was written.

    Args:
        model: the vineyard, in its drawn shape.
        file: the file, see :func:`check_file`.
        name: name of the scene.
        leaves: whether leaves are drawn.
        parameters: gravity and friction.
        robots: robots at rest beside the plants; in MJCF only.
    """
    if robots and file.suffix.lower() != ".xml":
        raise UsageError(f"{file}: robots are written as MJCF (.xml) only; in other formats load the robot's own file")
    write, orthogonal = FORMATS[file.suffix.lower()]
    if model.terrain is not None and file.suffix.lower() == ".urdf":
        raise UsageError(
            f"{file}: a URDF has no uneven ground, which this scene has; write MJCF (.xml) or OpenUSD (.usd)"
        )
    vineyard = describe(
        model,
        name=name,
        leaves=leaves,
        orthogonal=orthogonal,
        gravity=parameters.gravity,
        friction=parameters.friction,
    )
    documents = [robot_document(one, parameters, model.terrain) for one in robots]
    with writing(file):
        write(vineyard, file, documents)
    return vineyard
