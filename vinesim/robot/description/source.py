"""Reads robot files of all formats as one: the XML of a URDF, before any repair.

The format is recognised by the content, not by the name: URDF and xacro by ``<robot>``, MJCF by ``<mujoco>``, SDF by
``<sdf>``. A file may also be a pipe, or ``-`` for the standard input.
"""

from __future__ import annotations

import dataclasses
import pathlib
import sys
from collections.abc import Mapping
from xml.etree import ElementTree

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.core import data_files
from vinesim.rigid.mjcf import MjcfError, urdf_of_mjcf
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.packages import find_installed
from vinesim.robot.description.sdf import urdf_of_sdf
from vinesim.robot.description.urdf import DescriptionError, description_error, parse_xml
from vinesim.robot.description.xacro_files import expand_xacro, is_xacro

ENDINGS = (".urdf", ".xacro", ".sdf", ".xml", ".mjb")
"""Endings of the names of robot files that are proposed if a folder is given instead of a file."""
CONVERTERS = {
    (".usd", ".usda", ".usdc", ".usdz"): "nvidia-srl-usd-to-urdf (pip install nvidia-srl-usd-to-urdf)",
    (".proto", ".wbt"): "Webots: Robot > Export to URDF",
    (".ttt", ".ttm"): "the URDF exporter of CoppeliaSim",
    (".sldasm", ".sldprt"): "the URDF exporter of SolidWorks",
    (".step", ".stp", ".iges", ".igs", ".fcstd", ".f3d", ".blend", ".fbx"): "the URDF exporter of your CAD program",
}
"""Programs that convert other files of robots to URDF, by the endings of their names."""


@dataclasses.dataclass(frozen=True, slots=True)
class RobotSource:
    """A robot file as read."""

    root: etree._Element
    """Root element ``<robot>`` of its URDF, or of the URDF that it was converted to."""
    file: pathlib.Path
    """The file; for a pipe, a file in the working folder with the name of the robot."""
    text: str | None
    """Text of the URDF as it is in the file; None if it is not there, because the file was converted."""
    home: Mapping[str, float]
    """Home positions [rad or m] of joints, where the file gives them."""
    notes: tuple[str, ...] = ()
    floats: bool = False
    """Whether its format has models that move freely unless they are fixed, and nothing fixes this one."""


def is_shipped(name: str) -> bool:
    """Returns whether ``name`` is that of a robot in ``data/robots`` or of an installed package, and not a path."""
    return name == "tiago_pro" or name in {file.stem for file in (data_files.data_dir() / "robots").glob("*.urdf")}


def kept_robot_file(name: str, description: RobotDescription, folder: pathlib.Path) -> str:
    """Returns a name by which other processes can read the robot called ``name``: itself, or the path of a file in
    ``folder`` into which a robot that came through a pipe is written."""
    given = pathlib.Path(name)
    if name != "-" and (given.is_file() or not given.exists()):
        return name
    kept = folder / f"{description.name}.urdf"
    kept.write_text(description.ros_urdf)
    return str(kept)


def read_source(name: str, arguments: Mapping[str, str]) -> RobotSource:
    """Read the robot called ``name``: a path, ``-``, the name of a URDF in ``data/robots``, or ``tiago_pro``.

    ``arguments``: arguments of a xacro file. Raises :class:`DescriptionError`, with one line of text, if there is no
    robot of this name or its format is not read.
    """
    file, content = _read(name)
    if file.suffix.lower() == ".mjb":
        return _from_mjcf(content, file)
    for endings, converter in CONVERTERS.items():
        if file.suffix.lower() in endings or (".usd" in endings and content.startswith((b"PXR-USDC", b"#usda"))):
            raise description_error(file, "this format is not read", f"convert it to URDF by {converter}")
    root = parse_xml(content, file)
    if root.tag == "robot" and (is_xacro(root) or file.suffix.lower() == ".xacro"):
        return _named(expand_xacro(content, file, arguments), file, None)
    if root.tag == "robot":
        text = content.decode("utf-8-sig", errors="replace") if _is_plain(content) else None
        return _named(root, file, text)
    if root.tag == "mujocoinclude":
        raise description_error(file, "it is a part of a MJCF file", "give the file that includes it")
    if root.tag == "mujoco":
        return _from_mjcf(content, file)
    if root.tag in ("sdf", "gazebo", "world", "model"):
        found, notes = urdf_of_sdf(root, file)
        floats = found.find("link[@name='world']") is None
        return dataclasses.replace(_named(found, file, None), notes=notes, floats=floats)
    raise description_error(
        file, f"its root is <{root.tag}>, not <robot>", "give a URDF, xacro, SDF or MJCF file of a robot"
    )


def _named(root: etree._Element, file: pathlib.Path, text: str | None) -> RobotSource:
    """Returns a source whose file has the name of the robot if it was read from a pipe."""
    if root.tag != "robot":
        raise description_error(file, f"its root is <{root.tag}>, not <robot>", "give a file of a robot")
    if not file.is_file():
        file = file.with_name(f"{root.get('name') or 'robot'}.urdf".replace("/", "_"))
    return RobotSource(root, file, text, {})


def _from_mjcf(content: bytes, file: pathlib.Path) -> RobotSource:
    try:
        urdf, home, notes = urdf_of_mjcf(file, content)
    except MjcfError as error:
        raise description_error(file, str(error), "give a complete MJCF file of a robot") from error
    return dataclasses.replace(_named(parse_xml(urdf.encode(), file), file, None), home=home, notes=notes)


def _is_plain(content: bytes) -> bool:
    """Returns whether the text of a URDF can be given to ROS as it is: well-formed XML in UTF-8, without an XML
    namespace as default."""
    try:
        text = content.decode("utf-8-sig")
        return ElementTree.fromstring(text).tag == "robot"
    except (UnicodeDecodeError, ElementTree.ParseError, LookupError):
        return False


def _read(name: str) -> tuple[pathlib.Path, bytes]:
    """Returns the path and the content of the robot file called ``name``."""
    if name == "-":
        return pathlib.Path.cwd() / "robot", sys.stdin.buffer.read()
    if name == "tiago_pro":
        found = find_installed("example-robot-data/robots/tiago_pro_description/robots/tiago_pro.urdf")
        if found is None:
            raise DescriptionError("tiago_pro: its files are not installed; type: pip install 'vinesim[tiago]'")
        return found, found.read_bytes()
    given = pathlib.Path(name)
    if given.is_dir():
        files = sorted(str(one.relative_to(given)) for one in given.rglob("*") if one.suffix.lower() in ENDINGS)
        known = f"give one of its files: {', '.join(files[:5])}" if files else "it has no robot file"
        raise description_error(given, "this is a folder", known)
    try:
        if given.exists() and not given.is_file():  # a pipe
            return pathlib.Path.cwd() / "robot", given.read_bytes()
        file = data_files.find_data_file("robots", name, ".urdf").resolve()
        return file, file.read_bytes()
    except data_files.DataFileNotFound as error:
        raise DescriptionError(f"{name}: {error}") from error
    except OSError as error:
        raise description_error(given, error.strerror or str(error), "give a file that can be read") from error
