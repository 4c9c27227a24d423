"""Mesh files of all formats: their triangles in metres, their colours, and STL files in the cache for physics.

MuJoCo reads binary STL and OBJ files. Files of other formats (Collada, glTF, PLY, text STL, ...) are read by trimesh
and written as STL files, one for each colour. Collada's unit is applied. Its up axis is not, as in RViz, Gazebo and
MoveIt: authors of robots place the points of their meshes in the frame of the link, whatever the file says about the up
axis.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import os
import pathlib
import re
import tempfile
from typing import Any, NamedTuple

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.core import disk_cache
from vinesim.scene.appearance.mesh_surfaces import simplify
from vinesim.scene.triangles import MAX_FACES, digest_of, to_stl

MUJOCO_FORMATS = (".stl", ".obj", ".msh")
"""File formats of meshes that MuJoCo reads."""
CACHE_NAME = "mesh_file_1"
"""First part of the names of read meshes in the disk cache, with a number that rises when their reading changes."""
MAX_COLORS = 8
"""Largest number of colours of one mesh; similar colours are merged."""
_COLOR_STEP = 16
"""Step of 8-bit colours within which faces count as of one colour."""
_PAINT = ("bind_material", "library_materials", "library_effects", "library_images")
"""Elements of Collada that have to do with colours."""
_PLAIN = (0.4, 0.4, 0.4, 1.0)
"""Colour that trimesh gives to faces of a file without colours (102 of 255)."""

Color = tuple[float, float, float, float]


class EmptyMeshError(ValueError):
    """A mesh file without triangles."""


class MeshPart(NamedTuple):
    """The triangles of one colour of a mesh file, as a file that MuJoCo reads."""

    file: pathlib.Path
    color: Color | None
    """Colour (sRGB) and opacity, 0 to 1; None if the mesh file has no colours."""


def mesh_parts(file: pathlib.Path, *, colored: bool) -> tuple[MeshPart, ...]:
    """Returns the parts of a mesh file, each in one colour; one part without a colour unless ``colored``.

    A part is the file itself if MuJoCo can read it, and an STL file in the cache otherwise. Raises the errors of the
    file's format if it is unreadable.
    """
    state = file.stat()
    return _parts(file, colored, state.st_mtime_ns, state.st_size)


@functools.lru_cache(2048)
def _parts(file: pathlib.Path, colored: bool, modified: int, size: int) -> tuple[MeshPart, ...]:
    """``modified`` [ns] and ``size`` [B] of the file, so that a changed file is read again."""
    suffix = file.suffix.lower()
    is_direct = suffix in MUJOCO_FORMATS and (suffix != ".stl" or is_binary_stl(file))
    if is_direct and not (colored and suffix == ".obj" and _names_materials(file)):
        return (MeshPart(file, None),)
    corners, colors = read_colored(file)
    if is_direct and colors is None:
        return (MeshPart(file, None),)
    if colors is None or not colored:
        return (MeshPart(store_stl(corners), None),)
    return tuple(MeshPart(store_stl(corners[faces]), color) for color, faces in _by_color(corners, colors))


def read_triangles(file: str | pathlib.Path) -> np.ndarray:
    """Returns the corners [face, 3, 3] m, float32, of a mesh file. Raises the errors of the file's format if it is
    unreadable."""
    file = pathlib.Path(file)
    if file.suffix.lower() == ".stl" and is_binary_stl(file):
        facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        with open(file, "rb") as opened:
            faces = int.from_bytes(opened.read(84)[80:84], "little")
            return np.fromfile(opened, facet, faces)["corners"]
    return read_colored(file)[0]


def read_colored(file: pathlib.Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Returns the corners [face, 3, 3] m, float32, of a mesh file, and the colour [face, 4] of each face, 0 to 255;
    None if the file has no colours. Raises the errors of the file's format if it is unreadable."""
    digest = hashlib.blake2b(f"{file}|{file.stat().st_mtime_ns}|".encode() + file.read_bytes(), digest_size=20)
    found = disk_cache.load_or_make(CACHE_NAME, disk_cache.source_digest(digest.digest()), lambda: _read_file(file))
    return found["corners"], found["colors"] if len(found["colors"]) else None


def _read_file(file: pathlib.Path) -> dict[str, np.ndarray]:
    """Returns the arrays of :func:`read_colored`; ``colors`` is empty if the file has no colours."""
    import trimesh

    kind = file.suffix.lower().lstrip(".")
    scene = _as_scene(trimesh.load(str(file), file_type=kind))
    if kind == "dae" and not scene.geometry:  # a reference to a missing texture hides all that is painted with it
        scene = _as_scene(trimesh.load(io.BytesIO(_without_materials(file.read_bytes())), file_type=kind))
    metre = _unit(scene)
    corners = []
    colors = []
    is_colored = False
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            continue
        placed = trimesh.transform_points(np.asarray(mesh.vertices), transform) * metre
        faces = np.asarray(mesh.faces)
        corners.append(placed[faces if np.linalg.det(transform[:3, :3]) > 0.0 else faces[:, ::-1]])
        found = _face_colors(mesh)
        is_colored |= found is not None
        plain = np.tile(np.array(_PLAIN) * 255.0, (len(faces), 1))
        colors.append(plain if found is None else found)
    if not corners:
        raise EmptyMeshError("it has no triangles")
    return {
        "corners": np.concatenate(corners).astype(np.float32),
        "colors": np.concatenate(colors).astype(np.float32) if is_colored else np.zeros((0, 4), np.float32),
    }


def _as_scene(loaded: Any) -> Any:
    import trimesh

    return loaded if isinstance(loaded, trimesh.Scene) else trimesh.Scene(loaded)


def _without_materials(content: bytes) -> bytes:
    """Returns the content of a Collada file without its materials."""
    root = etree.fromstring(content, etree.XMLParser(resolve_entities=False, huge_tree=True))
    for element in list(root.iter(etree.Element)):
        if etree.QName(element).localname in _PAINT:
            element.getparent().remove(element)
    return etree.tostring(root)


def store_stl(corners: np.ndarray) -> pathlib.Path:
    """Writes triangles ``corners`` [face, 3, 3] m into an STL file in the cache, and returns its path. The name of the
    file depends on its content only. A mesh with more triangles than MuJoCo reads is simplified."""
    if len(corners) > MAX_FACES:
        every = np.arange(3 * len(corners)).reshape(-1, 3)
        vertices, faces = simplify(corners.reshape(-1, 3).astype(float), every, (1.0, 1.0, 1.0))
        corners = vertices[faces].astype(np.float32)
    content = to_stl(np.ascontiguousarray(corners, np.float32))
    name = f"{digest_of(content)}.stl"
    with contextlib.suppress(OSError, RuntimeError):  # a read-only folder, or no home folder
        return _write(disk_cache.folder() / "meshes" / name, content)
    return _write(_private_folder() / name, content)


def is_binary_stl(file: str | pathlib.Path) -> bool:
    """Returns whether MuJoCo can read an STL file: its size is that of a binary STL, and it has at most
    :data:`vinesim.scene.triangles.MAX_FACES` faces."""
    with open(file, "rb") as opened:
        header = opened.read(84)
    faces = int.from_bytes(header[80:84], "little")
    return 1 <= faces <= MAX_FACES and pathlib.Path(file).stat().st_size >= 84 + 50 * faces


def _write(file: pathlib.Path, content: bytes) -> pathlib.Path:
    if not file.is_file() or file.read_bytes() != content:
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_name(f"{file.name}.{os.getpid()}")
        part.write_bytes(content)
        part.replace(file)
    return file


@functools.cache
def _private_folder() -> pathlib.Path:
    """Returns a folder for meshes of this process, used if the cache cannot be written."""
    return pathlib.Path(tempfile.mkdtemp(prefix="vinesim-meshes-"))


def _names_materials(file: pathlib.Path) -> bool:
    """Returns whether an OBJ file names materials in its first lines."""
    with open(file, "rb") as opened:
        return b"mtllib" in opened.read(1 << 16)


def _unit(scene: Any) -> float:
    """Returns the unit of a file's coordinates [m]: that of Collada, 1 for formats without a unit."""
    try:
        units = scene.units
    except ValueError:  # parts of different units
        units = None
    found = re.match(r"\s*([0-9.eE+-]+)\s*\*\s*met", units or "")
    return float(found.group(1)) if found else 1.0


def _face_colors(mesh: Any) -> np.ndarray | None:
    """Returns the colours [face, 4] of a mesh, 0 to 255; None if it has none. A texture gives each face the mean colour
    of its corners."""
    visual = mesh.visual
    if not visual.defined:
        return None
    if visual.kind == "texture":
        material = visual.material
        if type(material).__name__ == "MultiMaterial":
            return None
        has_image = (
            getattr(material, "image", None) is not None or getattr(material, "baseColorTexture", None) is not None
        )
        if not has_image or visual.uv is None:
            return np.tile(np.asarray(material.main_color, float), (len(mesh.faces), 1))
        corners = np.asarray(visual.to_color().vertex_colors, float)[mesh.faces]
        return corners.mean(axis=1)
    return np.asarray(visual.face_colors, float)


def _by_color(corners: np.ndarray, colors: np.ndarray) -> list[tuple[Color, np.ndarray]]:
    """Returns the colours of a mesh, 0 to 1, each with the indices of its faces. Rare colours are merged with the
    nearest frequent one."""
    steps = np.round(colors / _COLOR_STEP).astype(int)
    kinds, member = np.unique(steps, axis=0, return_inverse=True)
    member = member.reshape(-1)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    weight = np.bincount(member, area + 1e-12)
    kept = np.argsort(-weight, kind="stable")[:MAX_COLORS]
    distance = np.linalg.norm(kinds[:, None] - kinds[kept][None], axis=2)
    nearest = distance.argmin(axis=1)[member]
    found = []
    for number in range(len(kept)):
        faces = np.flatnonzero(nearest == number)
        mean = np.average(colors[faces], axis=0, weights=area[faces] + 1e-12) / 255.0
        red, green, blue, alpha = np.clip(mean, 0.0, 1.0).tolist()
        found.append(((red, green, blue, alpha), faces))
    return found
