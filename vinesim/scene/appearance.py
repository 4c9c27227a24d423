"""What people and crates look like: shapes read from ``data/figures``, in the frames of the links that they ride on.

A figure knows nothing of who draws it: a part is a few round cones, ellipsoids, boxes, cylinders and lofts (meshes
through rings), each with a colour and a surface by name. Bodies that touch are others, and lie in the room of physics.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Annotated, Literal

import msgspec
import numpy as np

from vinesim import frames
from vinesim.scene.data_files import find_data_file
from vinesim.scene.toml_loader import DataError, load_toml
from vinesim.scene.values import HumanPose, Mesh, Shape

SURFACES = ("paint", "plastic", "cloth", "skin", "rubber", "metal", "straw", "reflex", "glass", "lamp")
"""What a shape can be made of, beside its colour."""
Surface = Literal["paint", "plastic", "cloth", "skin", "rubber", "metal", "straw", "reflex", "glass", "lamp"]
Point = tuple[float, float, float]
FINGERS = ("thumb", "index", "middle", "ring", "little")
"""In the order of ``HumanPose.left_fingers``."""
PHALANGES = 3
_Z_TO_X = frames.exp(np.array([0.0, 0.5 * np.pi, 0.0]))


class AppearanceError(DataError):
    """A figure that cannot be drawn; one line with file, place, finding and remedy."""


class _Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class Paint(_Part, frozen=True):
    """Colour and surface of a shape."""

    rgb: Point
    """sRGB, 0 to 1."""
    surface: Surface


class ShapeSpec(_Part, frozen=True, kw_only=True):
    """One shape of a part [m, rad]; which fields count follows from ``kind``."""

    kind: Literal["cone", "cylinder", "ellipsoid", "box", "loft"]
    paint: str | tuple[str, ...]
    """Name of a :class:`Paint`; of a loft, one for each strip between two rings."""
    start: Point = (0.0, 0.0, 0.0)
    """Of a cone or a cylinder."""
    end: Point = (0.0, 0.0, 0.0)
    radius: tuple[float, float] = (0.0, 0.0)
    """At both ends; the first alone counts for a cylinder."""
    at: Point = (0.0, 0.0, 0.0)
    half: Point = (0.0, 0.0, 0.0)
    """Half axes of an ellipsoid, half edges of a box."""
    turn: Point = (0.0, 0.0, 0.0)
    """Rotation vector of an ellipsoid or a box [rad]."""
    twin: bool = False
    """There is a second one, mirrored to the other side."""
    along: Literal["x", "z"] = "z"
    """Axis of a loft: z (front is x) or x (front is z); left is y."""
    rings: tuple[tuple[float, ...], ...] = ()
    """Of a loft: place on the axis, rear, front, half width, and how far it lies to the left (0 unless given)."""
    arc: tuple[float, float] = (-180.0, 180.0)
    """Which part of its rings a loft covers, counter-clockwise about its axis from the front [degrees]."""
    arc_end: tuple[float, float] | None = None
    """The same at its last ring, if it narrows or widens from the first to there."""
    swell: float = 0.0
    """By how much a loft's rings are wider than written: a patch on another loft."""
    sides: int = 20
    """Edges of a whole ring."""
    square: float = 2.0
    """Exponent of the rings: 2 an ellipse, more a rounded rectangle."""


class Finger(_Part, frozen=True):
    """A finger of the left hand, straight."""

    root: Point
    """[m] in the palm's frame."""
    spread: float
    """Turn about the palm's normal [rad], to the left."""
    roll: float
    """Turn of the hinges about the finger [rad]."""
    lengths: Point
    """Of the phalanges [m]."""
    radii: tuple[float, float, float, float]
    """At the knuckle, both joints and the tip [m]."""
    bent: Point
    """Angle of each hinge when the finger is bent all the way [rad]."""


class Limbs(_Part, frozen=True):
    """What hangs between tracked parts [m]."""

    shoulder: Point
    """Left, in the chest's frame."""
    upper_arm: float
    forearm: float
    wrist: Point
    """Left, in the palm's frame."""
    elbow: Point
    """Where the left elbow would rather go, chest's axes."""
    neck: float
    """Height of its lower end in the chest's frame."""
    nape: Point
    """Its upper end in the head's frame."""


class _File(_Part, frozen=True):
    source: str
    height: float
    paints: dict[str, Paint]
    parts: dict[str, tuple[ShapeSpec, ...]]
    limbs: Limbs
    fingers: dict[str, Finger]
    finger_paint: str


@dataclasses.dataclass(frozen=True, eq=False)
class HumanModel:
    """A person's looks at one height: shapes [m] by part, and what the parts between the tracked ones need."""

    parts: dict[str, tuple[Shape, ...]]
    """By link: head, chest, ..., ``left_hand``, ``neck``, ``left_upper_arm``, ..., ``left_index_1`` to ``_3``, ..."""
    limbs: Limbs
    root: np.ndarray
    """[finger, 7] of the first phalanx in the palm; left hand, then right."""
    length: np.ndarray
    """[finger, phalanx] m"""
    bent: np.ndarray
    """[finger, phalanx] rad, all the way."""


@functools.lru_cache(16)
def load_human_model(height: float, name: str = "worker") -> HumanModel:
    """The figure of a person of this height [m], from ``data/figures``; :class:`AppearanceError` if it cannot be read."""
    path = find_data_file("figures", name, ".toml")
    file = load_toml(path, _File, AppearanceError)
    scale = height / file.height
    for part, pieces in file.parts.items():
        for i, piece in enumerate(pieces):
            _check(file.paints, piece, f"{path}: parts.{part}[{i}]")
    parts: dict[str, tuple[Shape, ...]] = {}
    for part, pieces in file.parts.items():
        sides = ((part, False),) if not part.startswith("left_") else ((part, False), (f"right_{part[5:]}", True))
        for link, mirror in sides:
            parts[link] = tuple(s for p in pieces for s in _shapes(p, file.paints, scale, mirror))
    paint = file.paints[file.finger_paint]
    roots = []
    for side, mirror in (("left", 1.0), ("right", -1.0)):
        for number, finger in enumerate(FINGERS):
            one = file.fingers[finger]
            turn = frames.multiply(
                frames.exp(np.array([0.0, 0.0, mirror * one.spread])), frames.exp(np.array([mirror * one.roll, 0, 0]))
            )
            roots.append(frames.pose(scale * np.array(one.root) * [1.0, mirror, 1.0], turn))
            for k, length in enumerate(one.lengths):
                r = one.radii[k], one.radii[k + 1]
                bone = _between((0, 0, 0), (length, 0, 0), r, scale, paint)
                parts[f"{side}_{FINGERS[number]}_{k + 1}"] = (bone,)
    limbs = msgspec.convert(_scaled(msgspec.to_builtins(file.limbs), scale), Limbs)
    every = [file.fingers[finger] for finger in FINGERS] * 2
    return HumanModel(
        parts=parts, limbs=limbs, root=np.array(roots), length=scale * np.array([f.lengths for f in every]),
        bent=np.array([f.bent for f in every]),
    )  # fmt: skip


def _scaled(value, scale: float):
    if isinstance(value, dict):
        return {key: _scaled(one, scale) for key, one in value.items()}
    return [scale * one for one in value] if isinstance(value, (list, tuple)) else scale * value


def _check(paints: dict[str, Paint], piece: ShapeSpec, place: str) -> None:
    names = (piece.paint,) if isinstance(piece.paint, str) else piece.paint
    if missing := [name for name in names if name not in paints]:
        raise AppearanceError(f"{place}.paint is {missing[0]!r}; give one of: {', '.join(paints)}")
    if piece.kind != "loft":
        return
    if len(piece.rings) < 2 or any(len(ring) not in (4, 5) for ring in piece.rings):
        raise AppearanceError(
            f"{place}.rings: give two rings or more, each [place, rear, front, half width] or one more"
        )
    if not isinstance(piece.paint, str) and len(piece.paint) != len(piece.rings) - 1:
        raise AppearanceError(f"{place}.paint names {len(piece.paint)} paints; give one, or {len(piece.rings) - 1}")


def _shapes(piece: ShapeSpec, paints: dict[str, Paint], scale: float, mirror: bool) -> list[Shape]:
    """A piece as shapes: one, or two that mirror each other, or a mesh for each paint of a loft."""
    sides = (False, True) if piece.twin else (mirror,)
    if piece.kind == "loft":
        return [shape for side in sides for shape in _loft(piece, paints, scale, side)]
    assert isinstance(piece.paint, str)
    paint, found = paints[piece.paint], []
    for side in sides:
        over = np.array([1.0, -1.0 if side else 1.0, 1.0])
        if piece.kind in ("cone", "cylinder"):
            start, end = (tuple(over * point) for point in (piece.start, piece.end))
            found.append(_between(start, end, piece.radius, scale, paint, piece.kind))
        else:
            turn = frames.exp(np.array(piece.turn) * [over[1], 1.0, over[1]])
            pose = frames.pose(scale * over * piece.at, turn)
            found.append(Shape(piece.kind, tuple(scale * h for h in piece.half), pose, *_look(paint)))
    return found


def _look(paint: Paint) -> tuple[tuple[float, float, float, float], str, str]:
    """Colour, file and surface of a shape."""
    return (*paint.rgb, 1.0), "", paint.surface


def _between(start, end, radius: tuple[float, float], scale: float, paint: Paint, kind: str = "cone") -> Shape:
    """A round cone or a cylinder from one point to another."""
    a, b = scale * np.asarray(start, float), scale * np.asarray(end, float)
    half = 0.5 * float(np.linalg.norm(b - a))
    turn = frames.multiply(frames.from_x_axis(b - a), _Z_TO_X)
    ends = tuple(scale * r for r in radius) if kind == "cone" else (scale * radius[0],)
    return Shape(kind, (*ends, half), frames.pose(0.5 * (a + b), turn), *_look(paint))


def _loft(piece: ShapeSpec, paints: dict[str, Paint], scale: float, mirror: bool) -> list[Shape]:
    """Meshes through the rings of a loft, one for each paint; a whole ring is closed by a lid at either end."""
    place, rear, front, wide, aside = np.array([(*ring, 0.0)[:5] for ring in piece.rings]).T
    whole = piece.arc[1] - piece.arc[0] >= 360.0
    first, last = (np.radians(arc) for arc in (piece.arc, piece.arc_end or piece.arc))
    widest = max(first[1] - first[0], last[1] - last[0])
    steps = piece.sides if whole else max(int(np.ceil(piece.sides * widest / (2.0 * np.pi))), 1)
    up, around = np.linspace(0.0, 1.0, len(place))[:, None], np.arange(steps + (not whole)) / steps
    low, high = (first[k] * (1.0 - up) + last[k] * up for k in (0, 1))
    angle = low + (high - low) * around
    bow = np.stack([np.cos(angle), np.sin(angle)])
    bow = np.sign(bow) * np.abs(bow) ** (2.0 / piece.square)
    deep = 0.5 * (front - rear) + piece.swell
    ahead = 0.5 * (front + rear)[:, None] + deep[:, None] * bow[0]
    left = aside[:, None] + (wide + piece.swell)[:, None] * bow[1]
    axis = np.broadcast_to(place[:, None], ahead.shape)
    # x ahead, y left, z along; for a limb, whose axis is x, the front is z and the ring runs the other way
    points = np.stack([ahead, left, axis] if piece.along == "z" else [axis, left, ahead], -1)
    reverse = piece.along == "x"
    if mirror:
        points, reverse = points * [1.0, -1.0, 1.0], not reverse
    count = len(around)
    vertices = scale * points.reshape(-1, 3)
    i = np.arange(count if whole else count - 1)
    j = (i + 1) % count
    paint = [piece.paint] * (len(place) - 1) if isinstance(piece.paint, str) else list(piece.paint)
    strips: dict[str, list[np.ndarray]] = {name: [] for name in paint}
    for k, name in enumerate(paint):
        a, b = count * k + i, count * k + j
        strips[name] += [np.stack([a, b, b + count], 1), np.stack([a, b + count, a + count], 1)]
    if whole:
        middles = scale * points[[0, -1]].mean(1)
        top = count * (len(place) - 1)
        strips[paint[0]].append(np.stack([j, i, np.full(count, len(vertices))], 1))
        strips[paint[-1]].append(np.stack([top + i, top + j, np.full(count, len(vertices) + 1)], 1))
        vertices = np.concatenate([vertices, middles])
    every = np.concatenate([face for faces in strips.values() for face in faces])
    every = every[:, ::-1] if reverse else every
    ends = np.cumsum([sum(map(len, faces)) for faces in strips.values()])[:-1]
    pieces = zip(strips, np.split(vertices[every], ends), np.split(smooth_normals(vertices, every), ends), strict=True)
    return [
        Shape("mesh", (1.0,), frames.pose(np.zeros(3)), *_look(paints[name]), Mesh(corners, normals))
        for name, corners, normals in pieces
    ]


CREASE_ANGLE = np.radians(50.0)
"""Faces that meet at a sharper angle than this [rad] meet at an edge; others are one smooth surface."""


def smooth_normals(vertices: np.ndarray, faces: np.ndarray, crease: float = float(CREASE_ANGLE)) -> np.ndarray:
    """Unit normals [face, 3, 3] at the corners of a mesh: of the faces around, as far as they turn no crease."""
    corners = vertices[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit = frames.normalize(area + 1e-30)
    _, spot = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    at = spot.reshape(-1)[faces.ravel()]
    order = np.argsort(at, kind="stable")
    first = np.searchsorted(at[order], at, "left")
    size = np.searchsorted(at[order], at, "right") - first
    mine = np.repeat(np.arange(len(at)), size)
    other = order[np.repeat(first - (np.cumsum(size) - size), size) + np.arange(len(mine))] // 3
    near = (unit[mine // 3] * unit[other]).sum(1) > np.cos(crease)
    total = np.stack([np.bincount(mine[near], area[other[near], k], len(at)) for k in range(3)], 1)
    lost = np.linalg.norm(total, axis=1) < 1e-14
    total[lost] = unit[np.flatnonzero(lost) // 3]
    return frames.normalize(total).reshape(-1, 3, 3)


# ---------------------------------------------------------------------- postures


class Palm(_Part, frozen=True):
    """Where a hand is."""

    at: Point
    """[m]"""
    along: Point
    """Where the fingers point."""
    back: Point
    """Where the back of the hand faces."""
    bent: tuple[float, float, float, float, float]
    """Thumb, index, middle, ring and little finger, 0 to 1."""


class Posture(_Part, frozen=True):
    """How somebody stands, feet about the origin, looking along x [m]."""

    head: Point | None = None
    tilt: float = 0.0
    """Of the head [rad], positive looks down."""
    hips: Point | None = None
    left: Palm | None = None
    right: Palm | None = None
    left_foot: Point | None = None
    right_foot: Point | None = None


class _Postures(_Part, frozen=True):
    height: float
    postures: dict[str, Posture]


@functools.cache
def _postures() -> _Postures:
    return load_toml(find_data_file("figures", "postures", ".toml"), _Postures, AppearanceError)


def posture_names() -> tuple[str, ...]:
    """Names that :func:`apply_posture` knows."""
    return tuple(_postures().postures)


def apply_posture(standing: HumanPose, name: str, height: float) -> HumanPose:
    """Somebody of this height [m], who is ``standing`` upright, in a posture of ``data/figures/postures.toml``."""
    file = _postures()
    if name not in file.postures:
        raise AppearanceError(f"posture {name!r} is unknown; give one of: {', '.join(file.postures)}")
    scale, one, usual = height / file.height, file.postures[name], file.postures["stand"]
    points = {}
    for point in ("head", "hips", "left_foot", "right_foot"):
        if at := getattr(one, point) or getattr(usual, point):
            points[point] = frames.compose(standing.root, frames.pose(scale * np.array(at)))
    nod = frames.pose(np.zeros(3), frames.exp(np.array([0.0, one.tilt, 0.0])))
    points["head"] = frames.compose(points.get("head", standing.head), nod)
    for side in ("left", "right"):
        palm = getattr(one, side) or getattr(usual, side)
        if palm:
            turn = frames.from_x_axis(np.array(palm.along), np.array(palm.back))
            points[side] = frames.compose(standing.root, frames.pose(scale * np.array(palm.at), turn))
            points[f"{side}_fingers"] = palm.bent
    return dataclasses.replace(standing, **points)


# ---------------------------------------------------------------------- crates


class Crate(_Part, frozen=True):
    """How a harvest crate is made [m]; its outer size is the scene's."""

    source: str
    paints: Annotated[tuple[Paint, ...], msgspec.Meta(min_length=1)]
    """Crate by crate, in turn."""
    wall: float
    """Thickness of walls and bottom."""
    slat: float
    """Height of a slat."""
    gap: float
    """Between two slats."""
    post: float
    """Width of the corner posts."""
    rib: float
    """Width of upright ribs."""
    ribs: float
    """Distance between ribs."""
    rim: float
    """Height of the rim."""
    grip: tuple[float, float]
    """Width and height of the hole for a hand below the rim of either end."""
    grid: float
    """Distance between bars of the bottom."""
    bar: float
    """Width of a bar."""


@functools.lru_cache(256)
def crate_shapes(size: tuple[float, float, float], number: int, name: str = "crate") -> tuple[Shape, ...]:
    """A slatted crate of this outer ``size`` [m], origin in the middle of its underside; its inside is free."""
    one = load_toml(find_data_file("figures", name, ".toml"), Crate, AppearanceError)
    t, look = one.wall, _look(one.paints[number % len(one.paints)])
    length, width, height = size
    found: list[Shape] = []

    def add(low, high) -> None:
        low, high = np.asarray(low, float), np.asarray(high, float)
        if (high - low > 1e-6).all():
            found.append(Shape("box", tuple(0.5 * (high - low)), frames.pose(0.5 * (low + high)), *look))

    x, y = 0.5 * length, 0.5 * width
    for half, side, along in ((x, y, 0), (y, x, 1)):  # bars one way, and the other way on top of them
        count = max(round(2.0 * side / one.grid), 1) + 1
        for at in np.linspace(0.5 * one.bar - side, side - 0.5 * one.bar, count):
            order = [1, 0, 2] if along else [0, 1, 2]
            low, high = (-half, at - 0.5 * one.bar, 0.5 * t * along), (half, at + 0.5 * one.bar, 0.5 * t * (along + 1))
            add([low[k] for k in order], [high[k] for k in order])
    shelf = height - one.rim

    for half, side, along in ((x, y, 0), (y, x, 1)):  # two long walls, two ends between them
        for sign in (-1.0, 1.0):
            outer, inner = sign * side, sign * (side - t)
            thin = sign * (side - 0.45 * t)

            def wall(a: float, b: float, low: float, high: float, depth: float, outer=outer, along=along) -> None:
                """From a to b along the wall and from ``low`` to ``high``, out to the outer face."""
                first, second = (a, min(outer, depth), low), (b, max(outer, depth), high)
                order = [1, 0, 2] if along else [0, 1, 2]
                add([first[k] for k in order], [second[k] for k in order])

            reach = half if not along else half - t
            wall(-reach, reach, shelf, height, inner)
            wall(-reach, reach, 0.0, t + one.slat, thin)
            for end in (-1.0, 1.0):
                edges = sorted((end * reach, end * (half - one.post)))
                wall(*edges, 0.0, shelf, inner)
            level = t + one.slat + one.gap
            hole = one.grip[0] / 2.0 if along else 0.0
            while level < shelf - 0.3 * one.gap:
                top = min(level + one.slat, shelf)
                if hole and top > shelf - one.grip[1]:
                    wall(-reach, -hole, level, top, thin)
                    wall(hole, reach, level, top, thin)
                else:
                    wall(-reach, reach, level, top, thin)
                level += one.slat + one.gap
            count = max(round(2.0 * half / one.ribs), 2)
            for at in np.linspace(-half, half, count + 1)[1:-1]:
                ceiling = shelf - one.grip[1] if hole > abs(at) else shelf
                wall(at - one.rib / 2.0, at + one.rib / 2.0, 0.0, ceiling, inner)
    return tuple(found)
