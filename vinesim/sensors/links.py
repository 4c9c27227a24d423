"""Robots, boxes, people and what was picked as primitives that ride on links."""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np

from vinesim import frames
from vinesim.kernels import materials
from vinesim.sensors.batches import BOX, CONE, CYLINDER, ELLIPSOID, TRIANGLE, Batch, batch
from vinesim.sensors.vines import bunch_parts
from vinesim.world.ids import Organ, label
from vinesim.world.model import Model
from vinesim.world.values import Link, Shape

_MESH_FACES = 4000
"""Most triangles of one mesh; finer ones are simplified."""

_RIGID = {Organ.BOX: int(materials.PLASTIC), Organ.HUMAN: int(materials.CLOTH)}


def rigid(model: Model, links: tuple[Link, ...], first: int, groups: int, shape: dict[int, np.ndarray]) -> list[Batch]:
    """Shapes of all links; carriers and groups count on from the given numbers.

    ``shape`` has the poses [piece, 7] of each picked bunch's pieces in its frame.
    """
    batches: list[Batch] = []
    for k, link in enumerate(links):
        if link.organ == Organ.BUNCH:  # a picked bunch that has become a rigid body
            place = shape[link.index]
            mine = bunch_parts(model, link.index, place, np.full(len(place), first + k), groups + k)
            batches += [dataclasses.replace(b, bunch=-1) for b in mine]
            continue
        material = _RIGID.get(link.organ, int(materials.PAINT))
        name = label(link.organ, link.index)
        for piece in link.shapes:
            common = {
                "material": material,
                "tint": np.asarray(piece.rgba[:3]) ** 2.2,
                "organ": int(link.organ),
                "label": name,
                "carrier": first + k,
                "group": groups + k,
            }
            batches.append(_rigid_shape(piece, common))
    return batches


def _rigid_shape(shape: Shape, common: dict) -> Batch:
    """One primitive, or the triangles of a mesh, in the frame of its link."""
    size, pose = shape.size, np.asarray(shape.pose, float)
    centre, turn = pose[:3], pose[3:]
    if shape.kind in ("capsule", "cylinder"):
        half = frames.rotate(turn, np.array([0.0, 0.0, size[1]]))
        kind = CONE if shape.kind == "capsule" else CYLINDER
        return batch(kind, [[*(centre - half), size[0]]], b=[[*(centre + half), size[0]]], **common)
    if shape.kind == "sphere":
        return batch(ELLIPSOID, [[*centre, size[0]]], b=[turn], c=[[size[0], size[0], 0, 0]], **common)
    if shape.kind in ("ellipsoid", "box"):
        kind = ELLIPSOID if shape.kind == "ellipsoid" else BOX
        return batch(kind, [[*centre, size[0]]], b=[turn], c=[[size[1], size[2], 0, 0]], **common)
    if shape.kind == "mesh":
        corners = _triangles(shape.file, tuple(size) if len(size) == 3 else (size[0],) * 3)
        corners = centre + frames.rotate(turn, corners)
        a, b, c = (np.concatenate([corners[:, k], np.zeros((len(corners), 1))], 1) for k in range(3))
        return batch(TRIANGLE, a, b=b, c=c, **common)
    raise ValueError(
        f"shape kind {shape.kind!r} of a link is unknown; use capsule, sphere, ellipsoid, box, cylinder or mesh"
    )


_meshes: dict[tuple[str, tuple[float, ...]], np.ndarray] = {}


def _triangles(file: str, scale: tuple[float, ...]) -> np.ndarray:
    """Corners [face, 3, 3] m of a mesh file, simplified by merging near vertices until it has few enough faces."""
    key = (file, scale)
    if key not in _meshes:
        import trimesh

        if not pathlib.Path(file).is_file():
            raise ValueError(f"mesh file {file!r} of a link does not exist; give an absolute path")
        mesh = trimesh.load(file, force="mesh", process=True)
        vertices, faces = np.asarray(mesh.vertices) * scale, np.asarray(mesh.faces)
        if np.prod(scale) < 0.0:
            faces = faces[:, ::-1]
        extent = float(np.ptp(vertices, axis=0).max(initial=1e-6))
        cells = 256
        while len(faces) > _MESH_FACES and cells > 8:
            spot = np.floor(vertices / extent * cells).astype(np.int64)
            _, member = np.unique(spot, axis=0, return_inverse=True)
            member = member.reshape(-1)
            count = np.bincount(member)
            merged = np.stack([np.bincount(member, vertices[:, k]) / count for k in range(3)], 1)
            linked = member[faces]
            whole = (linked[:, 0] != linked[:, 1]) & (linked[:, 1] != linked[:, 2]) & (linked[:, 0] != linked[:, 2])
            vertices, faces, cells = merged, linked[whole], int(cells * 0.75)
        _meshes[key] = vertices[faces].astype(np.float32)
    return _meshes[key]
