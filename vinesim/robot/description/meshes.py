"""Meshes of a URDF: finds their files, and sets the paths, shapes and colours with which physics and sensors read them.

Each mesh gets three attributes: ``bounds``, its bounding box, and ``digest`` and ``faces``, with which other clients
request its triangles (:mod:`vinesim.scene.triangles`). A client that receives the URDF over the network opens no file
that the URDF names. It replaces a mesh by the box of its ``bounds`` if it has no triangles with this digest.
"""

from __future__ import annotations

import copy
import functools
import pathlib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.robot.description.packages import find_resource
from vinesim.robot.description.urdf import description_error, parse_origin
from vinesim.scene import triangles
from vinesim.scene.appearance.mesh_files import EmptyMeshError, MeshPart, mesh_parts, read_triangles

MIN_BOX_EDGE = 1e-4
"""[m] Smallest edge of a box that replaces a mesh, since a mesh may be flat."""


MAX_MESHES = 256
"""Largest number of meshes of one robot that a client requests from another client. Further meshes are shown as
boxes."""

MAX_ROBOT_BYTES = 64 << 20
"""Largest total size of the meshes of one robot that a client requests from another client [B]."""


class MeshOffer(NamedTuple):
    """A mesh that a URDF names and whose triangles other clients may request."""

    file: str
    """File name in the URDF. It is a path on the machine that wrote the URDF, and is never opened on another."""
    size: int
    """Size of the mesh's encoded triangles [B]."""


def resolve_meshes(root: etree._Element, file: pathlib.Path, assumed: list[str]) -> dict[str, pathlib.Path]:
    """Set the absolute paths of all meshes of a robot ``file``, as physics reads them. Returns the file of each mesh by
    the name that ``root`` had for it.

    A mesh whose format physics cannot read is converted. A visible mesh with colours of its own becomes one shape for
    each colour, as RViz shows it: its colours come before the ``<material>`` of the shape. Adds
    meshes without triangles, which are left out, to ``assumed``. Raises :class:`DescriptionError` for a missing or
    broken file.
    """
    sources: dict[str, pathlib.Path] = {}
    empty: list[str] = []
    for mesh in root.iterfind("link//geometry/mesh"):
        uri = mesh.get("filename", "")
        found = sources.get(uri) or find_resource(uri, file)
        if found is None:
            raise description_error(file, f"mesh {uri!r} is missing", _remedy(uri))
        sources[uri] = found
    for shape in [*root.iterfind("link/visual"), *root.iterfind("link/collision")]:
        mesh = shape.find("geometry/mesh")
        if mesh is None:
            continue
        source = sources[mesh.get("filename", "")]
        try:
            parts = mesh_parts(source, colored=shape.tag == "visual")
        except EmptyMeshError:
            empty.append(source.name)
            shape.getparent().remove(shape)
            continue
        except Exception as error:  # each format raises different errors
            raise description_error(
                file, f"mesh {str(source)!r} cannot be read ({error})", "convert it to STL or OBJ"
            ) from error
        link = shape.getparent()
        for part in parts[1:]:
            copied = copy.deepcopy(shape)
            link.insert(link.index(shape) + 1, copied)
            _use_part(copied, part)
        _use_part(shape, parts[0])
    if empty:
        assumed.append(f"mesh {empty[0]!r} has no triangles: left out")
    for mesh in root.iterfind("link//geometry/mesh"):
        facts = _facts(mesh, file)
        mesh.set("bounds", " ".join(f"{value:.6g}" for value in facts.bounds.ravel()))
        mesh.set("digest", facts.digest)
        mesh.set("faces", str(facts.faces))
    return sources


def _remedy(uri: str) -> str:
    """Returns what a user can do about a mesh ``uri`` that was not found."""
    scheme, separator, rest = uri.partition("://")
    if separator and scheme in ("package", "model"):
        where = "AMENT_PREFIX_PATH or ROS_PACKAGE_PATH" if scheme == "package" else "GZ_SIM_RESOURCE_PATH"
        return (
            f"source the workspace with {rest.split('/')[0]!r} (it is in no folder of {where}), or put the folder "
            f"{rest.split('/')[0]!r} beside or above the file"
        )
    if separator and scheme.startswith("http"):
        return "check the address and the connection"
    return "put it into the folder of the robot file"


def _use_part(shape: etree._Element, part: MeshPart) -> None:
    """Set the mesh file and the colour of a shape."""
    shape.find("geometry/mesh").set("filename", str(part.file))
    if part.color is None:
        return
    material = shape.find("material")
    if material is None:
        material = etree.SubElement(shape, "material", name="")
    for old in material.findall("color"):
        material.remove(old)
    etree.SubElement(material, "color", rgba=" ".join(f"{value:.6g}" for value in part.color))


def list_meshes(urdf: str) -> dict[str, MeshOffer]:
    """Returns the meshes that a URDF offers to other clients, by digest, in the order of the URDF. Meshes beyond the
    limits for one robot are left out.

    ``urdf`` may come from the network. A text that is no URDF offers no meshes.
    """
    found: dict[str, MeshOffer] = {}
    try:
        root = etree.fromstring(urdf.encode(), etree.XMLParser(remove_comments=True, resolve_entities=False))
    except (etree.XMLSyntaxError, ValueError):
        return {}
    for mesh in root.iterfind("link//geometry/mesh"):
        digest = mesh.get("digest", "")
        faces = mesh.get("faces", "")
        if triangles.is_digest(digest) and faces.isascii() and faces.isdecimal() and len(faces) < 9:
            found.setdefault(digest, MeshOffer(mesh.get("filename", ""), int(faces) * triangles.FACE_BYTES))
    room = MAX_ROBOT_BYTES
    allowed = {}
    for digest, mesh in found.items():
        if 0 < mesh.size <= min(room, triangles.MAX_BYTES) and len(allowed) < MAX_MESHES:
            allowed[digest] = mesh
            room -= mesh.size
    return allowed


def replace_unopened_meshes(
    root: etree._Element, assumed: list[str], received: Mapping[str, np.ndarray] | None = None
) -> dict[str, np.ndarray]:
    """Replace all meshes of a URDF from the network, whose numbers were checked, without opening a file. Returns the
    corners [face, 3, 3] m of the remaining meshes, by their file name in ``root``.

    A mesh whose digest is in ``received`` (digest -> corners) gets the file name of these triangles. Another mesh is
    replaced by the box of its ``bounds``, or removed if it has no bounds; this is added to ``assumed``.
    """
    links = list(root.iterfind("link"))
    count = 0
    meshes = {}
    for link in links:
        for shape in (*link.findall("visual"), *link.findall("collision")):
            mesh = shape.find("geometry/mesh")
            if mesh is None:
                continue
            digest = mesh.get("digest", "")
            if received is not None and digest in received:
                name = f"{digest}.stl"
                mesh.set("filename", name)
                meshes[name] = received[digest]
                continue
            count += 1
            if mesh.get("bounds") is None:
                link.remove(shape)
            else:
                _replace_by_box(shape, mesh, np.array(mesh.get("bounds").split(), float).reshape(2, 3))
    if count:
        assumed.append(f"{count} meshes of another client are not opened: replaced by boxes of the same size")
    return meshes


class _Facts(NamedTuple):
    """Properties of a mesh file that other clients need to show the mesh."""

    bounds: np.ndarray
    """Lower and upper corner of the mesh [2, 3] m before scaling."""
    digest: str
    """Digest of the mesh's triangles. It is empty if there are none, or too many to be sent."""
    faces: int


def _facts(mesh: etree._Element, file: pathlib.Path) -> _Facts:
    """Returns the properties of a mesh. Raises :class:`DescriptionError` if its file is unreadable."""
    name = mesh.get("filename")
    try:
        return _file_facts(name, pathlib.Path(name).stat().st_mtime_ns)
    except Exception as error:  # each format raises different errors
        raise description_error(file, f"mesh {name!r} cannot be read ({error})", "convert it to STL or OBJ") from error


@functools.lru_cache(1024)  # a mesh is often used as visual and collision shape, and by several robots
def _file_facts(name: str, modified: int) -> _Facts:
    """Returns the properties of a mesh file. ``modified`` [ns]: time of its last change, so that a changed file is
    read again."""
    corners = read_triangles(name)
    points = corners.reshape(-1, 3)
    bounds = np.array([points.min(axis=0), points.max(axis=0)], float)
    try:
        digest = triangles.digest_of(triangles.encode_triangles(corners))
    except triangles.TrianglesError:
        digest = ""
    return _Facts(bounds, digest, len(corners))


def _replace_by_box(shape: etree._Element, mesh: etree._Element, bounds: np.ndarray) -> None:
    """Replace the ``mesh`` of a shape by the box of its ``bounds`` [2, 3] m."""
    scale = np.array([float(value) for value in (mesh.get("scale") or "1 1 1").split()])
    lower, upper = bounds * scale
    origin = shape.find("origin")
    values = dict(origin.attrib) if origin is not None else {}
    transform = parse_origin(etree.Element("origin", values))
    assert transform is not None, "an element has an origin"
    centre = transform[:3, :3] @ (0.5 * (lower + upper)) + transform[:3, 3]
    if origin is None:
        origin = etree.SubElement(shape, "origin")
    origin.set("xyz", " ".join(f"{value:.9g}" for value in centre))
    geometry = shape.find("geometry")
    geometry.remove(mesh)
    size = np.maximum(np.abs(upper - lower), MIN_BOX_EDGE)
    etree.SubElement(geometry, "box", size=" ".join(f"{value:.9g}" for value in size))
