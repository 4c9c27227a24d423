"""Robots, crates, people and picked bunches as primitives that rigid bodies carry."""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np

from vinesim.core import frames
from vinesim.kernels.shading import materials
from vinesim.scene.appearance import read_surface
from vinesim.scene.ids import Organ, label
from vinesim.scene.model import Model
from vinesim.scene.values import Mesh, RigidVisual, Shape
from vinesim.sensors.primitives.bunch_primitives import Ripeness, bunch_batches
from vinesim.sensors.primitives.primitive_batches import Batch, make_batch
from vinesim.sensors.raster.primitive_arrays import BOX, CONE, CYLINDER, ELLIPSOID, TRIANGLE

_DEFAULT_SURFACE = {Organ.BOX: "plastic", Organ.HUMAN: "cloth"}
"""Visible surface, by organ, of shapes without a named surface; the default of robots is paint."""
_MATERIALS = {
    "paint": int(materials.PAINT),
    "plastic": int(materials.PLASTIC),
    "cloth": int(materials.CLOTH),
    "skin": int(materials.SKIN),
    "rubber": int(materials.RUBBER),
    "metal": int(materials.METAL),
    "straw": int(materials.STRAW),
    "reflex": int(materials.REFLEX),
    "glass": int(materials.GLASS),
    "lamp": int(materials.LAMP),
}
_NORMAL_LEVELS = 2047
"""Number of levels of each coordinate of a packed normal."""


def rigid_batches(
    model: Model,
    visuals: tuple[RigidVisual, ...],
    first: int,
    groups: int,
    shape: dict[int, np.ndarray],
    ripeness: Ripeness | None = None,
) -> list[Batch]:
    """Returns the primitives of all rigid bodies in ``visuals``.

    ``first``, ``groups``: first carrier and first group, one of each for every body; ``shape``: by picked bunch, poses
    [piece, 7] of the bunch's pieces in the bunch's frame; ``ripeness``: None means that all fruit is ripe.
    """
    batches: list[Batch] = []
    for k, visual in enumerate(visuals):
        if visual.organ == Organ.BUNCH:  # a picked bunch that has become a rigid body
            place = shape[visual.index]
            which = np.array([visual.index])
            on = np.full(len(place), first + k)
            mine = bunch_batches(model, which, [place], [on], np.array([groups + k]), ripeness)
            batches += [dataclasses.replace(b, bunch=np.full(len(b), -1)) for b in mine]
            if visual.stalk is not None:
                common = {
                    "material": int(materials.STEM),
                    "tint": np.array(model.look.palette.wood.stem),
                    "organ": int(Organ.PEDUNCLE),
                    "label": label(Organ.PEDUNCLE, visual.index),
                    "carrier": first + k,
                    "group": groups + k,
                }
                batches += [_rigid_shape(piece, common) for piece in visual.shapes[-visual.stalk.pieces :]]
            continue
        usual = _DEFAULT_SURFACE.get(visual.organ, "paint")
        name = label(visual.organ, visual.index)
        for piece in visual.shapes:
            common = {
                "material": _MATERIALS[piece.surface or usual],
                "tint": np.asarray(piece.rgba[:3]) ** 2.2,
                "organ": int(visual.organ),
                "label": name,
                "carrier": first + k,
                "group": groups + k,
            }
            batches.append(_rigid_shape(piece, common))
    return batches


def _rigid_shape(shape: Shape, common: dict) -> Batch:
    """Returns one shape of a rigid body as a batch, in the body's frame: one primitive, or the triangles of a mesh.

    ``common``: properties that all shapes of the body share, as for :func:`make_batch`.
    """
    size = shape.size
    pose = np.asarray(shape.pose, float)
    centre = pose[:3]
    turn = pose[3:]
    if shape.kind in ("capsule", "cylinder", "cone"):
        low, high = (size[0], size[1]) if shape.kind == "cone" else (size[0], size[0])
        half = frames.rotate(turn, np.array([0.0, 0.0, size[-1]]))
        kind = CYLINDER if shape.kind == "cylinder" else CONE
        return make_batch(kind, [[*(centre - half), low]], b=[[*(centre + half), high]], **common)
    if shape.kind == "sphere":
        return make_batch(ELLIPSOID, [[*centre, size[0]]], b=[turn], c=[[size[0], size[0], 0, 0]], **common)
    if shape.kind in ("ellipsoid", "box"):
        kind = ELLIPSOID if shape.kind == "ellipsoid" else BOX
        return make_batch(kind, [[*centre, size[0]]], b=[turn], c=[[size[1], size[2], 0, 0]], **common)
    if shape.kind == "mesh":
        mesh = shape.mesh or _load_mesh(shape.file, tuple(size) if len(size) == 3 else (size[0],) * 3)
        corners = centre + frames.rotate(turn, mesh.corners)
        normals = pack_normals(frames.rotate(turn, mesh.normals))
        a, b, c = (np.concatenate([corners[:, k], normals[:, k, None]], 1) for k in range(3))
        return make_batch(TRIANGLE, a, b=b, c=c, **common)
    raise ValueError(
        f"shape kind {shape.kind!r} of a link is unknown; use capsule, cone, sphere, ellipsoid, box, cylinder or mesh"
    )


def pack_normals(normals: np.ndarray) -> np.ndarray:
    """Pack unit vectors [..., 3] into one float each, for
    :func:`vinesim.kernels.shading.solid_materials.unpack_normal`.

    The mapping is octahedral (Meyer et al. 2010), with eleven bits for each coordinate: accurate to 0.001 rad.
    """
    flat = normals / np.maximum(np.abs(normals).sum(-1, keepdims=True), 1e-12)
    side = np.where(flat[..., :2] >= 0.0, 1.0, -1.0)
    folded = np.where(flat[..., 2:] < 0.0, (1.0 - np.abs(flat[..., 1::-1])) * side, flat[..., :2])
    level = np.round((0.5 + 0.5 * folded) * (_NORMAL_LEVELS - 1))
    return (1.0 + level[..., 0] + _NORMAL_LEVELS * level[..., 1]).astype(np.float32)


_meshes: dict[tuple[str, tuple[float, ...]], Mesh] = {}


def _load_mesh(file: str, scale: tuple[float, ...]) -> Mesh:
    """Read a mesh file, scale it to metres, and reduce its number of faces if it is too large for sensors."""
    key = (file, scale)
    if key not in _meshes:
        if not pathlib.Path(file).is_file():
            raise ValueError(f"mesh file {file!r} of a link does not exist; give an absolute path")
        _meshes[key] = read_surface(file, scale)
    return _meshes[key]
