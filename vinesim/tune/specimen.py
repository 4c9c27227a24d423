"""The measured plant as trees of the simulator: a cane, or a bunch on its peduncle, clamped at the origin."""

from __future__ import annotations

import itertools
import re

import msgspec
import numpy as np

from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.scene import plausibility
from vinesim.scene.builder import RodMaterial, TreeBuilder
from vinesim.scene.cane import CaneBuilder
from vinesim.scene.ids import Organ
from vinesim.scene.plant_parameters import Specimen

TIP = "tip"
"""Name of the marker at the tip, which every specimen has."""
_PERCENT = re.compile(r"(\d\d?) percent")
_BELOW = re.compile(r"(\d+) mm")
_DIRECTIONS = {"cane": (1.0, 0.0, 0.0), "bunch": (0.0, 0.0, -1.0)}


def with_values(specimen: Specimen, **values: float) -> Specimen:
    """Returns a copy of the specimen with other values of some numbers, in their units: ``with_values(cane,
    modulus=4e9)``."""
    changed = {name: msgspec.structs.replace(getattr(specimen, name), value=value) for name, value in values.items()}
    return msgspec.structs.replace(specimen, **changed)


def base_pose(specimen: Specimen) -> np.ndarray:
    """Returns the pose [7] of the base at the origin; x is the direction of growth, or of the first segment of an
    axis."""
    if specimen.axis:
        return frames.pose(np.zeros(3), _axis_turns(specimen)[0])
    along = np.array(specimen.direction or _DIRECTIONS[specimen.organ], float)
    return frames.pose(np.zeros(3), frames.from_x_axis(along / np.linalg.norm(along)))


def rest_bends(specimen: Specimen, bow: np.ndarray) -> np.ndarray:
    """Returns the slack shape of a specimen as the rotation vector [..., segments, 3] rad of each segment relative to
    the previous segment.

    ``bow`` [..., 2] rad: bend from base to tip about the specimen's y and z axes. The first segment is clamped in the
    direction of growth. The bow is distributed equally over the other segments.
    """
    bends = np.zeros((*np.shape(bow)[:-1], specimen.segments, 3))
    bends[..., 1:, 1:] = np.asarray(bow, float)[..., None, :] / (specimen.segments - 1)
    return bends


def _axis_turns(specimen: Specimen) -> np.ndarray:
    """Returns the orientation [segments, 4] in the world of each segment along a specimen's axis, without twist between
    segments."""
    points = np.array(specimen.axis)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.linspace(0.0, way[-1], specimen.segments + 1)
    along = np.diff(np.stack([np.interp(at, way, points[:, i]) for i in range(3)], -1), axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    turns = [frames.from_x_axis(along[0])]
    for before, after in itertools.pairwise(along):
        axis = np.cross(before, after)
        sine = np.linalg.norm(axis)
        turn = axis * (np.arctan2(sine, before @ after) / max(sine, 1e-12))
        turns.append(frames.multiply(frames.exp(turn), turns[-1]))
    return np.array(turns)


def hanging_bends(specimen: Specimen) -> np.ndarray:
    """Returns the measured shape of a hanging cane as the bend of the chain of segments at the base of each segment:
    rotation vectors [segments, 3] rad relative to the previous segment.

    The bends follow the points ``Specimen.axis``. The bend at the base of the first segment is zero.
    """
    turns = _axis_turns(specimen)
    bends = frames.log(frames.multiply(frames.conjugate(turns[:-1]), turns[1:]))
    return np.concatenate([np.zeros((1, 3)), bends])


def build_tree(specimen: Specimen) -> TreeBuilder:
    """Returns a specimen as a tree: the segments of the rod, then the bunch if there is one.

    Numbers that no plant has are not reported here: those of files are reported when they are loaded, and the first
    guess of a fit may be far off.
    """
    with plausibility.unchecked():
        return _build_tree(specimen)


def _build_tree(specimen: Specimen) -> TreeBuilder:
    radius = (0.5 * specimen.base_diameter.value, 0.5 * specimen.tip_diameter.value)
    bends = hanging_bends(specimen) if specimen.axis else rest_bends(specimen, np.array(specimen.bow))
    if specimen.organ == "cane":
        return CaneBuilder(
            length=specimen.length.value,
            radius=radius,
            youngs_modulus=specimen.modulus.value,
            density=specimen.density.value,
            segments=specimen.segments,
            beta=specimen.damping.value,
            tip_mass=0.0 if specimen.tip_mass is None else specimen.tip_mass.value,
            pose=base_pose(specimen),
            bends=bends,
            shape="equilibrium" if specimen.axis else "slack",
        ).tree()
    tree = TreeBuilder(base_pose(specimen))
    material = RodMaterial(specimen.modulus.value, specimen.density.value, specimen.damping.value)
    last = tree.add_rod(
        -1, specimen.length.value, radius, material, specimen.segments, organ=Organ.PEDUNCLE, bends=frames.exp(bends)
    )[-1]
    assert specimen.tip_mass is not None  # checked when the specimen was loaded
    far = tree.bodies[last]["far"]  # spring of the last segment beyond its middle; the bunch is rigid
    tree.add_bunch(last, specimen.tip_mass.value, clusters=False, stiffness=far, damping=specimen.damping.value * far)
    return tree


def marker_at(percent: int) -> str:
    """Returns the name of the marker at ``percent`` of a cane's length, which every cane has."""
    return f"{percent} percent"


def marker_below(distance: float) -> str:
    """Returns the name of the marker on a bunch's axis at a ``distance`` [m] from the clamp, which every bunch has."""
    return f"{round(1e3 * distance)} mm"


def place_markers(specimen: Specimen, names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the body [k] of each marker in the specimen's tree, and the marker's position [k, 3] m in that body's
    frame.

    Raises :class:`UsageError` for a marker that the specimen does not have.
    """
    segment = specimen.length.value / specimen.segments
    bodies = []
    points = []
    for name in names:
        below = _BELOW.fullmatch(name)
        if specimen.organ == "bunch" and (name == TIP or below):
            tree = build_tree(specimen)
            far = 1e-3 * int(below[1]) - specimen.length.value if below else float(tree.bodies[-1]["length"])
            bodies.append(len(tree.bodies) - 1)
            points.append((far, 0.0, 0.0))
            continue
        share = _PERCENT.fullmatch(name) if specimen.organ == "cane" else None
        if name != TIP and name not in specimen.markers and share is None:
            known = ", ".join([TIP, *specimen.markers])
            raise UsageError(f"marker {name!r} is not in the specimen, which has: {known}; add it to specimen.markers")
        if name == TIP:
            along = specimen.length.value
        elif name in specimen.markers:
            along = specimen.markers[name]
        else:
            along = 0.01 * int(share[1]) * specimen.length.value if share else 0.0
        body = min(int(along / segment), specimen.segments - 1)
        bodies.append(body)
        points.append((along - body * segment, 0.0, 0.0))
    return np.array(bodies), np.array(points)
