"""Berries of a bunch, computed from (count, seed, variety), for sensors and ground truth. The physics has no berries.

Prototypes with berries of unit radius are packed once (:mod:`vinesim.scene.berry_packing`): 18 for table grapes, and 24
for each of three degrees of compactness of wine grapes. A bunch is a scaled copy of the prototype that its seed
selects, so ten thousand bunches need no relaxation of their own.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from vinesim.core import portable_math
from vinesim.scene import berry_packing, plant_parameters
from vinesim.scene.berry_packing import BerryLayout, Style
from vinesim.scene.plant_parameters import Berry


@dataclasses.dataclass(frozen=True, slots=True)
class Variety:
    """Berries, bunches and leaves of one variety (sources in ``data/plants/varieties.toml``)."""

    name: str
    colour: tuple[float, float, float]
    """Linear RGB reflectance of a ripe berry."""
    radius: float
    """Half of the berry's thickness across its axis [m]."""
    elongation: float
    """Ratio of length to thickness."""
    unripe: tuple[float, float, float] = (0.085, 0.150, 0.022)
    """Linear RGB reflectance of a hard green berry: GUESSED by eye."""
    turning: tuple[float, float, float] | None = None
    """Linear RGB reflectance halfway between green and ripe; None: the mean of both."""
    veraison: float = 0.10
    """Standard deviation of the ripeness (0 to 1) of berries within a bunch. GUESSED."""
    bunch_mass: float | None = None
    """Mean mass of a bunch [kg]; None: that of the plant's file. So for the other properties of bunches."""
    bunch_mass_variation: float | None = None
    bunch_mass_range: tuple[float, float] | None = None
    peduncle_length: tuple[float, float] | None = None
    """Smallest and largest length of the bunch's stalk [m]."""
    peduncle_pull: tuple[float, float] | None = None
    """Range of the pulling forces [N] at which the stalk breaks; see ``Peduncle.pull``."""
    style: Style = "table"
    """How the berries are packed."""
    leaf_area: float | None = None
    """Mean area of a grown leaf [m^2]; None: that of the plant's file."""
    sinus_depth: float | None = None
    """Depth of the leaf's sinuses, note of OIV descriptor 094, 1 to 9; None: leaves of all outlines."""

    @classmethod
    def of(cls, berry: Berry) -> Variety:
        """Returns the variety that an entry of the file describes."""
        names = [field.name for field in dataclasses.fields(cls) if field.name not in ("name", "style")]
        given = {name: value.value for name in names if (value := getattr(berry, name)) is not None}
        if berry.compactness is not None:
            note = berry.compactness.value
            given["style"] = "loose" if note < 4.5 else "medium" if note < 6.5 else "dense"
        return cls(name=berry.name, **given)

    @property
    def volume_radius(self) -> float:
        """Radius of the sphere of the same volume [m]."""
        return self.radius * self.elongation ** (1.0 / 3.0)

    @property
    def mass(self) -> float:
        """Mass of one berry [kg]."""
        return DENSITY * 4.0 / 3.0 * np.pi * self.volume_radius**3


DENSITY = 1080.0
"""Density of a ripe berry [kg/m^3]. GUESSED from 18 % sugar."""

VARIETIES = tuple(Variety.of(berry) for berry in plant_parameters.load_varieties())
"""Varieties, indexed by ``Model.bunch_variety``."""

MIN_BERRIES = 40
MAX_BERRIES = max(berry_packing.PROTOTYPE_BERRIES)
"""Smallest and largest number of berries of a generated bunch of table grapes."""


def most_berries(variety: int) -> int:
    """Returns the largest number of berries of a bunch of a variety."""
    return max(berry_packing.counts_of(VARIETIES[variety].style))


def lay_out_berries(length: float, radius: float, count: int, variety: int, seed: int) -> BerryLayout:
    """Returns the berries of one bunch of ``Model``, scaled to a hull of ``length`` [m] and ``radius`` [m]."""
    which = int(_prototype(VARIETIES[variety].style, count, seed))
    return _scaled(which, int(count), float(length), float(radius), int(variety))


def hull_size(count: np.ndarray, seed: np.ndarray, variety: np.ndarray | int) -> np.ndarray:
    """Returns length and radius of the hulls of bunches [..., 2], in units of the berry's volume radius."""
    count, seed, variety = np.broadcast_arrays(count, seed, variety)
    out = np.zeros((*count.shape, 2))
    for style, here in _by_style(variety):
        which = _prototype(style, count[here], seed[here])
        lengths, across = _tables(style)
        out[here] = np.stack([lengths[which, count[here]], across[which]], -1)
    return out


def segment_of(position: np.ndarray, length: float | np.ndarray, pieces: int | np.ndarray) -> np.ndarray:
    """Returns the index of the piece to which each point [..., 3] belongs if a rachis of ``length`` is cut into equal
    pieces. Piece 0 is at the peduncle."""
    return np.clip((position[..., 0] * (pieces / length)).astype(int), 0, pieces - 1)


def mass_by_segment(
    count: np.ndarray, seed: np.ndarray, variety: np.ndarray, pieces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the mass of the berries on ``pieces`` [n] equal pieces of the rachis, for bunches [n] of unit mass and
    length.

    Returns:
        Share of the mass [n, most], centre of mass [n, most, 3] and moments of inertia about it [n, most, 3] in the
        axes of the bunch's body; zero after a bunch's last piece. ``most`` is the largest of ``pieces``.
    """
    most = int(np.max(pieces, initial=1))
    count, seed, variety, pieces = (np.asarray(one) for one in (count, seed, variety, pieces))
    share = np.zeros((len(count), most))
    centre, inertia = np.zeros((2, len(count), most, 3))
    for style, here in _by_style(variety):
        share[here], centre[here], inertia[here] = _mass_by_segment(style, count[here], seed[here], pieces[here], most)
    return share, centre, inertia


def _mass_by_segment(
    style: Style, count: np.ndarray, seed: np.ndarray, pieces: np.ndarray, most: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns what :func:`mass_by_segment` returns, for bunches of one style. ``most``: largest number of pieces."""
    which = _prototype(style, count, seed)
    position, radius = _packed(style)
    number = np.arange(radius.shape[1])
    length = _tables(style)[0][which, count]
    position = position[which] / length[:, None, None]
    radius = radius[which] / length[:, None]
    weight = np.where(number < count[:, None], portable_math.power(radius, 3), 0.0)
    weight = weight / weight.sum(1, keepdims=True)
    piece = np.clip((position[..., 0] * pieces[:, None]).astype(int), 0, pieces[:, None] - 1)
    flat = (np.arange(len(count))[:, None] * most + piece).ravel()

    def gathered(value: np.ndarray) -> np.ndarray:
        return np.bincount(flat, value.ravel(), len(count) * most).reshape(len(count), most)

    share = gathered(weight)
    some = np.where(share > 0.0, share, 1.0)[..., None]
    centre = np.stack([gathered(weight * position[..., axis]) for axis in range(3)], -1) / some
    square = np.stack([gathered(weight * position[..., axis] ** 2) for axis in range(3)], -1)
    square = square - share[..., None] * centre * centre
    own = gathered(0.4 * weight * radius * radius)[..., None]  # a ball's 2/5 m r^2
    return share, centre, square.sum(-1, keepdims=True) - square + own


def _by_style(variety: np.ndarray) -> list[tuple[Style, np.ndarray]]:
    """Returns each style of bunches that occurs among ``variety`` [...], and where it occurs [...] bool."""
    styles: dict[Style, list[int]] = {}
    for number in np.unique(variety).tolist():
        styles.setdefault(VARIETIES[number].style, []).append(number)
    return [(style, np.isin(variety, numbers)) for style, numbers in styles.items()]


@functools.cache
def _packed(style: Style) -> tuple[np.ndarray, np.ndarray]:
    """Returns the positions [prototype, most, 3] and radii [prototype, most] of the berries of a style's prototypes,
    rounded as in :func:`_tables`. ``most`` is the largest number of berries; missing ones are zero."""
    bunches = berry_packing.prototypes(style)
    most = max(berry_packing.counts_of(style))
    position = np.zeros((len(bunches), most, 3))
    radius = np.zeros((len(bunches), most))
    for i, bunch in enumerate(bunches):
        position[i, : len(bunch.radius)] = bunch.position
        radius[i, : len(bunch.radius)] = bunch.radius
    return position.round(3), radius.round(3)


def _prototype(style: Style, count: np.ndarray | int, seed: np.ndarray | int) -> np.ndarray:
    """Returns the index of the prototype (packed model bunch) of a bunch: the prototype with the next larger count of
    berries, in the shape that the seed selects.
    """
    counts = berry_packing.counts_of(style)
    if np.size(count) and (np.min(count) < 1 or np.max(count) > counts[-1]):
        raise ValueError(f"a bunch has 1 to {counts[-1]} berries, not {np.min(count)} to {np.max(count)}")
    shapes = berry_packing.shapes_of(style)
    return np.searchsorted(counts, count) * shapes + np.asarray(seed, np.int64) % shapes


@functools.cache
def _tables(style: Style) -> tuple[np.ndarray, np.ndarray]:
    """Returns hull lengths by prototype and count, and hull radii by prototype, rounded so that all machines have the
    same bits."""
    bunches = berry_packing.prototypes(style)
    lengths = np.zeros((len(bunches), max(berry_packing.counts_of(style)) + 1))
    for i, bunch in enumerate(bunches):
        reach = np.maximum.accumulate(bunch.position[:, 0] + bunch.radius)
        lengths[i, 1 : len(reach) + 1] = reach
    across = [np.quantile(np.hypot(*b.position[:, 1:].T) + b.radius, 0.9) for b in bunches]
    return lengths.round(3), np.array(across).round(3)


@functools.lru_cache(maxsize=512)
def _scaled(which: int, count: int, length: float, radius: float, variety: int) -> BerryLayout:
    kind = VARIETIES[variety]
    unit = berry_packing.prototypes(kind.style)[which]
    lengths, across = _tables(kind.style)
    scale = min(length / lengths[which, count], radius / across[which])
    thin = kind.elongation ** (-1.0 / 3.0)
    near = np.where(unit.neighbours[:count] < count, unit.neighbours[:count], -1)
    order = np.argsort(near < 0, axis=1, kind="stable")
    rachis = unit.rachis
    if kind.style != "table":  # branches below the last berry were cut off with their berries
        inside = rachis[..., 0].max(1) < lengths[which, count] - 1.0
        inside[0] = True
        rachis = rachis[inside]
    return BerryLayout(
        position=unit.position[:count] * scale,
        radius=unit.radius[:count] * (scale * thin),
        axis=unit.axis[:count],
        foot=unit.foot[:count] * scale,
        rachis=rachis * scale,
        neighbours=np.take_along_axis(near, order, 1),
    )
