"""Writes a vineyard into a file whose suffix chooses the format."""

from __future__ import annotations

import os
import pathlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable

from vinesim.core.errors import UsageError, writing
from vinesim.export.articulation import Vineyard, describe
from vinesim.export.mjcf import mjcf
from vinesim.export.urdf import urdf
from vinesim.export.usd import write_usd
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters

Write = Callable[[Vineyard, pathlib.Path], None]


def _write_xml(document: Callable[[Vineyard], ElementTree.Element]) -> Write:
    def write(vineyard: Vineyard, file: pathlib.Path) -> None:
        root = document(vineyard)
        ElementTree.indent(root)
        file.write_text('<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n")

    return write


FORMATS: dict[str, tuple[Write, bool]] = {
    ".xml": (_write_xml(mjcf), False),
    ".urdf": (_write_xml(urdf), False),
    ".usda": (write_usd, True),
    ".usdc": (write_usd, True),
    ".usd": (write_usd, True),
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
    model: Model, file: pathlib.Path, *, name: str, leaves: bool, parameters: PhysicsParameters
) -> Vineyard:
    """Write a model into a file. The same model gives the same bytes. Returns what was written.

    Args:
        model: the vineyard, in its drawn shape.
        file: the file, see :func:`check_file`.
        name: name of the scene.
        leaves: whether leaves are drawn.
        parameters: gravity and friction.
    """
    write, orthogonal = FORMATS[file.suffix.lower()]
    vineyard = describe(
        model,
        name=name,
        leaves=leaves,
        orthogonal=orthogonal,
        gravity=parameters.gravity,
        friction=parameters.friction,
    )
    with writing(file):
        write(vineyard, file)
    return vineyard
