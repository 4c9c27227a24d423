"""Truth of a vineyard for measurements of perception: volume and berries of bunches, distance to the true surface."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np

from vinesim.core.errors import UsageError
from vinesim.scene.berries import DENSITY, VARIETIES, lay_out_berries
from vinesim.scene.ids import LABEL_STRIDE, Organ, label
from vinesim.scene.model import Model
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.raster.primitive_arrays import CONE, SPHEROID

_CANDIDATES = 8
"""Number of round cones, those with the nearest middles, to which the distance of a point is computed."""
_CHUNK = 20_000


class Vineyard(Protocol):
    """A simulated vineyard, such as :class:`vinesim.Simulation`."""

    @property
    def model(self) -> Model:
        """Constants of the plants."""
        ...

    def primitives(self) -> Primitives:
        """Returns the shapes that sensors see, at the present time."""
        ...


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class TrueBunch:
    """Truth of one bunch."""

    bunch: int
    """Index of the bunch in the model."""
    variety: str
    """Name of the grape variety."""
    centres: np.ndarray
    """[berry, 3] m, centres of the berries in the world."""
    diameters: np.ndarray
    """[berry] m, thickness of each berry across its axis."""
    lengths: np.ndarray
    """[berry] m, length of each berry along its axis."""

    @property
    def volume(self) -> float:
        """Volume of all berries [m^3]."""
        return float(np.pi / 6.0 * (self.diameters**2 * self.lengths).sum())

    @property
    def mass(self) -> float:
        """Mass of all berries [kg]."""
        return DENSITY * self.volume


def true_bunch(vineyard: Vineyard, bunch: int) -> TrueBunch:
    """Returns the berries of a bunch at the present time."""
    model = vineyard.model
    if not 0 <= bunch < len(model.bunch_body):
        raise UsageError(f"bunch is {bunch}; the vineyard has {len(model.bunch_body)}, numbered from 0")
    primitives = vineyard.primitives()
    rows = np.flatnonzero((_kinds(primitives) == SPHEROID) & (primitives.label == label(Organ.BUNCH, bunch)))
    a, b = (getattr(primitives.shapes, name).numpy()[rows].astype(float) for name in "ab")
    variety = VARIETIES[model.bunch_variety[bunch]].name
    return TrueBunch(bunch, variety, a[:, :3], 2.0 * a[:, 3], 2.0 * a[:, 3] * b[:, 3])


def true_volumes(model: Model) -> np.ndarray:
    """Returns the volume [bunch] m^3 of the ripe berries of every bunch."""
    volumes = np.zeros(len(model.bunch_body))
    for bunch, variety in enumerate(model.bunch_variety):
        berries = lay_out_berries(
            float(model.bunch_length[bunch]),
            float(model.bunch_radius[bunch]),
            int(model.bunch_berries[bunch]),
            int(variety),
            int(model.bunch_seed[bunch]),
        )
        volumes[bunch] = 4.0 / 3.0 * np.pi * VARIETIES[variety].elongation * (berries.radius**3).sum()
    return volumes


def wood_distance(
    vineyard: Vineyard, points: np.ndarray, organs: tuple[Organ, ...] = (Organ.CANE, Organ.PEDUNCLE)
) -> np.ndarray:
    """Returns the signed distance [n] m of points [n, 3] m from the true surface of the nearest wood or stalk; negative
    inside.

    ``organs``: organs whose round cones count, such as canes, arms and trunks. Only the cones with the nearest middles
    are compared, so the result may be too large, never too small in magnitude outside of wood.
    """
    from vinesim.perception.open3d_library import load_open3d

    o3d = load_open3d()
    primitives = vineyard.primitives()
    organ = primitives.label // LABEL_STRIDE
    rows = np.flatnonzero((_kinds(primitives) == CONE) & np.isin(organ, [int(one) for one in organs]))
    if not len(rows):
        raise UsageError(f"the vineyard has no {' or '.join(one.name.lower() for one in organs)}")
    start, end = (getattr(primitives.shapes, name).numpy()[rows].astype(float) for name in "ab")
    middle = 0.5 * (start[:, :3] + end[:, :3])
    search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(middle))
    search.knn_index()
    found = np.empty(len(points))
    for first in range(0, len(points), _CHUNK):
        some = np.ascontiguousarray(points[first : first + _CHUNK], float)
        near = search.knn_search(o3d.core.Tensor(some), min(_CANDIDATES, len(rows)))[0].numpy()
        distances = _cone_distance(some[:, None], start[near], end[near])
        found[first : first + _CHUNK] = distances.min(1)
    return found


def _cone_distance(p: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Returns the signed distance [...] m of points [..., 3] from round cones, each the hull of two balls: centre [3]
    and radius of ``start`` [..., 4] and of ``end`` [..., 4]."""
    axis = end[..., :3] - start[..., :3]
    length = np.maximum(np.linalg.norm(axis, axis=-1), 1e-9)
    axis = axis / length[..., None]
    away = p - start[..., :3]
    along = (away * axis).sum(-1)
    across = np.sqrt(np.maximum((away**2).sum(-1) - along**2, 0.0))
    sine = np.clip((start[..., 3] - end[..., 3]) / length, -1.0, 1.0)
    cosine = np.sqrt(1.0 - sine**2)
    # the foot of the surface's normal through the point, limited to the segment between the balls
    foot = np.clip(along - across * sine / np.maximum(cosine, 1e-9), 0.0, length)
    radius = start[..., 3] + foot / length * (end[..., 3] - start[..., 3])
    return np.hypot(along - foot, across) - radius


def _kinds(primitives: Primitives) -> np.ndarray:
    """Returns [primitive] the kind of each primitive, -1 for primitives that are not drawn."""
    shown = np.repeat(primitives.clusters_shown(), primitives.cluster_size)
    return np.where(shown, np.repeat(primitives.cluster_kind, primitives.cluster_size), -1)
