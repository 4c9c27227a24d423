"""Meshes of a URDF: finds their files, sets their absolute paths, and replaces meshes whose format physics cannot read.

Each mesh gets three attributes: ``bounds``, its bounding box, and ``digest`` and ``faces``, with which other clients
request its triangles (:mod:`vinesim.scene.triangles`). A client that receives the URDF over the network opens no file
that the URDF names. It replaces a mesh by the box of its ``bounds`` if it has no triangles with this digest.
"""

from __future__ import annotations

import functools
import importlib.util
import pathlib
import sys
from collections.abc import Mapping
from typing import NamedTuple, cast

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.robot.description.urdf import description_error, parse_origin
from vinesim.scene import triangles

MESH_FORMATS = (".stl", ".obj", ".msh")
"""File formats of meshes that MuJoCo reads. Meshes in other formats, such as Collada, are replaced."""
MAX_STL_FACES = 200_000
"""Largest number of faces in an STL file that MuJoCo reads."""
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


def find_mesh(uri: str, file: pathlib.Path) -> pathlib.Path | None:
    """Returns the file of a mesh URI: relative to the folder of the URDF, in a package folder above it, or installed
    with a wheel. Returns None if it is missing."""
    path = uri.removeprefix("file://")
    if not path.startswith("package://"):
        found = file.parent / path
        return found.resolve() if found.is_file() else None
    path = path.removeprefix("package://")
    inside = path.split("/", 1)[-1]
    for above in file.parents:
        for candidate in (above / path, above / inside):
            if candidate.is_file():
                return candidate.resolve()
    return find_installed(path)


def resolve_meshes(root: etree._Element, file: pathlib.Path, notes: list[str]) -> None:
    """Set the absolute paths of all meshes, and replace meshes whose format cannot be read.

    A collision mesh is replaced by its bounding box, a visual mesh by the collision shapes of its link. Replacements
    are added to ``notes``. Raises :class:`DescriptionError` for a missing or broken file.
    """
    for mesh in root.iterfind("link//geometry/mesh"):
        uri = mesh.get("filename", "")
        found = find_mesh(uri, file)
        if found is None:
            raise description_error(
                file, f"mesh {uri!r} is missing", "put it into the folder of the URDF, or install its package"
            )
        mesh.set("filename", str(found))
    unread: set[str] = set()

    def readable(shape: etree._Element) -> bool:
        """Returns whether MuJoCo can read the mesh of a shape."""
        mesh = shape.find("geometry/mesh")
        suffix = pathlib.Path(mesh.get("filename")).suffix.lower() if mesh is not None else ".stl"
        readable = suffix in MESH_FORMATS and (mesh is None or suffix != ".stl" or _is_binary_stl(mesh.get("filename")))
        if not readable:
            unread.add(suffix if suffix not in MESH_FORMATS else f"{suffix} (text, or too large)")
        return readable

    for link in root.iterfind("link"):
        for shape in [shape for shape in link.iterfind("collision") if not readable(shape)]:
            mesh = shape.find("geometry/mesh")
            _replace_by_box(shape, mesh, _facts(mesh, file).bounds)
        for shape in [shape for shape in link.iterfind("visual") if not readable(shape)]:
            material = shape.find("material")
            for solid in link.findall("collision"):
                visual = etree.SubElement(link, "visual")
                visual.extend(etree.fromstring(etree.tostring(part)) for part in solid)
                if material is not None:
                    visual.append(etree.fromstring(etree.tostring(material)))
            link.remove(shape)
    if unread:
        formats = ", ".join(sorted(unread))
        notes.append(f"meshes of format {formats} cannot be read: shown as collision shapes, boxes in contacts")
    for mesh in root.iterfind("link//geometry/mesh"):
        facts = _facts(mesh, file)
        mesh.set("bounds", " ".join(f"{value:.6g}" for value in facts.bounds.ravel()))
        mesh.set("digest", facts.digest)
        mesh.set("faces", str(facts.faces))


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


def read_triangles(file: str) -> np.ndarray:
    """Returns the corners [face, 3, 3] m, float32, of a mesh file. Raises the errors of the file's format if it is
    unreadable."""
    if file.lower().endswith(".stl") and _is_binary_stl(file):
        facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        with open(file, "rb") as opened:
            faces = int.from_bytes(opened.read(84)[80:84], "little")
            return np.fromfile(opened, facet, faces)["corners"]
    import trimesh

    return np.asarray(cast("trimesh.Trimesh", trimesh.load(file, force="mesh")).triangles, np.float32)


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


def _is_binary_stl(filename: str) -> bool:
    """Returns whether MuJoCo can read an STL file: its size is that of a binary STL, and it has at most
    :data:`MAX_STL_FACES` faces."""
    with open(filename, "rb") as file:
        header = file.read(84)
    faces = int.from_bytes(header[80:84], "little")
    return 1 <= faces <= MAX_STL_FACES and pathlib.Path(filename).stat().st_size >= 84 + 50 * faces


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


def find_installed(path: str) -> pathlib.Path | None:
    """Returns the path of a file that a cmeel wheel (such as example-robot-data) installed in ``share``; None if it
    is missing."""
    roots = [pathlib.Path(sys.prefix) / "share"]
    cmeel = importlib.util.find_spec("cmeel")
    if cmeel is not None and cmeel.origin:
        roots.append(pathlib.Path(cmeel.origin).parent.parent / "cmeel.prefix" / "share")
    roots += [pathlib.Path(entry) / "cmeel.prefix" / "share" for entry in sys.path if entry]
    return next((root / path for root in roots if (root / path).is_file()), None)
