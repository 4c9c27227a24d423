"""Meshes of a URDF: found, named by absolute path, and replaced where physics cannot read their format.

Each mesh gets an attribute ``bounds``, its bounding box. A client that receives the URDF over the network opens no file
that it names: it makes boxes of these bounds.
"""

from __future__ import annotations

import functools
import pathlib

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.robot.description.errors import description_error
from vinesim.robot.description.package_resources import find_installed
from vinesim.robot.description.urdf_model import parse_origin

MESH_FORMATS = (".stl", ".obj", ".msh")
"""File formats that MuJoCo reads; meshes of others, such as Collada, are replaced."""
MAX_STL_FACES = 200_000
"""Of an STL file that MuJoCo reads."""
MIN_BOX_EDGE = 1e-4
"""[m] Smallest edge of a box in place of a mesh, which may be flat."""


def find_mesh(uri: str, file: pathlib.Path) -> pathlib.Path | None:
    """The file of a mesh URI: beside the URDF, in its package above it, or installed with a wheel; None if missing."""
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
    """Name meshes by absolute path, and replace those of unreadable formats.

    Collision meshes become their bounding boxes, visual meshes the collision shapes of their link, which is added to
    ``notes``. Raises :class:`DescriptionError` for a missing or broken file.
    """
    for mesh in root.iterfind("link//geometry/mesh"):
        uri = mesh.get("filename", "")
        found = find_mesh(uri, file)
        if found is None:
            raise description_error(
                file, f"mesh {uri!r} is missing", "put it there, beside the URDF, or install its package"
            )
        mesh.set("filename", str(found))
    unread: set[str] = set()

    def readable(shape: etree._Element) -> bool:
        mesh = shape.find("geometry/mesh")
        suffix = pathlib.Path(mesh.get("filename")).suffix.lower() if mesh is not None else ".stl"
        readable = suffix in MESH_FORMATS and (mesh is None or suffix != ".stl" or _is_binary_stl(mesh.get("filename")))
        if not readable:
            unread.add(suffix if suffix not in MESH_FORMATS else f"{suffix} (text, or too large)")
        return readable

    for link in root.iterfind("link"):
        for shape in [shape for shape in link.iterfind("collision") if not readable(shape)]:
            mesh = shape.find("geometry/mesh")
            _replace_by_box(shape, mesh, _bounds(mesh, file))
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
        notes.append(f"meshes of format {formats} cannot be read: seen as collision shapes, touched as boxes")
    for mesh in root.iterfind("link//geometry/mesh"):
        mesh.set("bounds", " ".join(f"{value:.6g}" for value in _bounds(mesh, file).ravel()))


def replace_unopened_meshes(root: etree._Element, assumed: list[str]) -> None:
    """Replace all meshes by boxes of their ``bounds``, without opening a file; those without bounds are removed.

    For a URDF from the network, whose numbers were checked. Adds to ``assumed``.
    """
    links = list(root.iterfind("link"))
    count = 0
    for link in links:
        for shape in (*link.findall("visual"), *link.findall("collision")):
            mesh = shape.find("geometry/mesh")
            if mesh is None:
                continue
            count += 1
            if mesh.get("bounds") is None:
                link.remove(shape)
            else:
                _replace_by_box(shape, mesh, np.array(mesh.get("bounds").split(), float).reshape(2, 3))
    if count:
        assumed.append(f"{count} meshes of another client are not opened: boxes of their size stand in")


def _is_binary_stl(filename: str) -> bool:
    """Whether physics can read an STL file: binary, as its size tells, and of no more faces than are allowed."""
    with open(filename, "rb") as file:
        header = file.read(84)
    faces = int.from_bytes(header[80:84], "little")
    return 1 <= faces <= MAX_STL_FACES and pathlib.Path(filename).stat().st_size >= 84 + 50 * faces


def _bounds(mesh: etree._Element, file: pathlib.Path) -> np.ndarray:
    """Lower and upper corner [2, 3] m of a mesh before it is scaled; :class:`DescriptionError` if it is unreadable."""
    name = mesh.get("filename")
    try:
        return _file_bounds(name, pathlib.Path(name).stat().st_mtime_ns)
    except Exception as error:  # each format has errors of its own
        raise description_error(file, f"mesh {name!r} cannot be read ({error})", "convert it to STL or OBJ") from error


@functools.lru_cache(1024)  # a mesh is often there as visual and collision shape, and for several robots
def _file_bounds(name: str, modified: int) -> np.ndarray:
    """Lower and upper corner [2, 3] m of a mesh file that was ``modified`` then [ns]."""
    if name.lower().endswith(".stl") and _is_binary_stl(name):
        facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        faces = int.from_bytes(pathlib.Path(name).read_bytes()[80:84], "little")
        corners = np.fromfile(name, facet, faces, offset=84)["corners"].reshape(-1, 3)
        return np.array([corners.min(axis=0), corners.max(axis=0)], float)
    import trimesh

    return np.array(trimesh.load(name, force="mesh").bounds, float)


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
