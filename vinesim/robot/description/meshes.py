"""Meshes of a URDF: found, named by absolute path, and replaced where physics cannot read their format."""

from __future__ import annotations

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
            _replace_by_box(shape, file)
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


def _is_binary_stl(filename: str) -> bool:
    """Whether physics can read an STL file: binary, as its size tells, and of no more faces than are allowed."""
    with open(filename, "rb") as file:
        header = file.read(84)
    faces = int.from_bytes(header[80:84], "little")
    return 1 <= faces <= MAX_STL_FACES and pathlib.Path(filename).stat().st_size >= 84 + 50 * faces


def _replace_by_box(shape: etree._Element, file: pathlib.Path) -> None:
    """Replace the mesh of a shape by its bounding box."""
    import trimesh

    mesh = shape.find("geometry/mesh")
    scale = np.array([float(value) for value in (mesh.get("scale") or "1 1 1").split()])
    try:
        lower, upper = trimesh.load(mesh.get("filename"), force="mesh").bounds * scale
    except Exception as error:  # each format has errors of its own
        raise description_error(
            file, f"mesh {mesh.get('filename')!r} cannot be read ({error})", "convert it to STL or OBJ"
        ) from error
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
    etree.SubElement(geometry, "box", size=" ".join(f"{value:.9g}" for value in np.abs(upper - lower)))
