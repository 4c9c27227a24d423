"""The human model: shapes of every part of a person of a given height and outfit, fingers included."""

from __future__ import annotations

import dataclasses
import functools
import pathlib
import zlib
from typing import Any

import msgspec
import numpy as np

from vinesim.core import frames
from vinesim.core.data_files import find_data_file
from vinesim.core.toml_loader import load_toml
from vinesim.scene.appearance.lofts import build_shapes
from vinesim.scene.appearance.shapes import AppearanceError, Paint, Point, ShapeSpec, Table, check_spec, rod_shape
from vinesim.scene.values import Shape

FINGERS = ("thumb", "index", "middle", "ring", "little")
"""Names of the fingers in the order of ``HumanPose.left_fingers``."""
PHALANGES = 3


class Finger(Table, frozen=True):
    """Dimensions of a straight finger of the left hand."""

    root: Point
    """[m] Position of the knuckle in the palm's frame."""
    spread: float
    """Rotation of the finger about the palm's normal [rad], positive to the left."""
    roll: float
    """Rotation of the hinge axes about the finger [rad]."""
    lengths: Point
    """Lengths of the phalanges [m]."""
    radii: tuple[float, float, float, float]
    """Radii at the knuckle, both joints and the tip [m]."""
    bent: Point
    """Angle of each hinge when the finger is bent all the way [rad]."""


class Limbs(Table, frozen=True):
    """Joints and lengths of the limbs between tracked parts [m]."""

    shoulder: Point
    """Left shoulder in the chest's frame."""
    upper_arm: float
    forearm: float
    wrist: Point
    """Left wrist in the palm's frame."""
    elbow: Point
    """Preferred direction of the left elbow, in the chest's axes."""
    neck: float
    """Height of the lower end of the neck in the chest's frame."""
    nape: Point
    """Upper end of the neck in the head's frame."""


class HumanFile(Table, frozen=True):
    source: str
    height: float
    paints: dict[str, Paint]
    outfits: dict[str, dict[str, Point]]
    """Colour [sRGB, 0 to 1] of each paint by the paint's name, for each outfit by the outfit's name."""
    parts: dict[str, tuple[ShapeSpec, ...]]
    limbs: Limbs
    fingers: dict[str, Finger]
    finger_paint: str


@dataclasses.dataclass(frozen=True, eq=False)
class HumanModel:
    """Shapes of a person of one height [m], by part, and the joints between the tracked parts."""

    parts: dict[str, tuple[Shape, ...]]
    """Shapes by link, for example ``head``, ``chest``, ``left_hand``, ``left_upper_arm``, ``left_index_1``."""
    limbs: Limbs
    root: np.ndarray
    """[finger, 7] pose of the first phalanx in the palm's frame; fingers of the left hand, then of the right."""
    length: np.ndarray
    """[finger, phalanx] m, length of each phalanx."""
    bent: np.ndarray
    """[finger, phalanx] rad, angle of each hinge when the finger is fully bent."""


def outfit_names(name: str = "worker") -> tuple[str, ...]:
    """Returns the names of the outfits that people can wear."""
    return tuple(_load_file(find_data_file("figures", name, ".toml")).outfits)


def outfit_of(actor: str, name: str = "worker") -> str:
    """Returns the outfit of an actor that has not chosen one. It is computed from the actor's name, so it is equal on
    all clients."""
    outfits = outfit_names(name)
    return outfits[zlib.crc32(actor.encode()) % len(outfits)]


@functools.lru_cache(64)
def load_human_model(height: float, name: str = "worker", outfit: str = "") -> HumanModel:
    """Returns the human model of ``height`` [m] in an outfit (empty: the first outfit in the file), from
    ``data/figures``.

    Raises :class:`AppearanceError` if the file cannot be read or has no such outfit.
    """
    outfits = _load_file(find_data_file("figures", name, ".toml")).outfits
    if outfit and outfit not in outfits:
        raise AppearanceError(f"outfit {outfit!r} is unknown; give one of: {', '.join(outfits)}")
    colours = outfits[outfit or next(iter(outfits))]
    model, paints = _build_model(height, name)
    parts = {
        part: tuple(
            dataclasses.replace(shape, rgba=(*colours[paint], 1.0)) if paint in colours else shape
            for shape, paint in zip(shapes, paints[part], strict=True)
        )
        for part, shapes in model.parts.items()
    }
    return dataclasses.replace(model, parts=parts)


@functools.lru_cache(16)
def _build_model(height: float, name: str) -> tuple[HumanModel, dict[str, list[str]]]:
    """Returns the human model of ``height`` [m], and for each part the paint names of its shapes.

    All outfits share the meshes of this model; :func:`load_human_model` sets the colours.
    """
    file = _load_file(find_data_file("figures", name, ".toml"))
    scale = height / file.height
    parts: dict[str, tuple[Shape, ...]] = {}
    paints: dict[str, list[str]] = {}
    for part, specs in file.parts.items():
        sides = ((part, False),) if not part.startswith("left_") else ((part, False), (f"right_{part[5:]}", True))
        for link, mirror in sides:
            built = [build_shapes(spec, file.paints, scale, mirror) for spec in specs]
            parts[link] = tuple(shape for shapes in built for shape in shapes)
            paints[link] = [one for spec, shapes in zip(specs, built, strict=True) for one in _paints_of(spec, shapes)]
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
                bone = rod_shape((0, 0, 0), (length, 0, 0), r, scale, paint)
                link = f"{side}_{FINGERS[number]}_{k + 1}"
                parts[link] = (bone,)
                paints[link] = [file.finger_paint]
    limbs = msgspec.convert(_scaled(msgspec.to_builtins(file.limbs), scale), Limbs)
    every = [file.fingers[finger] for finger in FINGERS] * 2
    model = HumanModel(
        parts=parts,
        limbs=limbs,
        root=np.array(roots),
        length=scale * np.array([f.lengths for f in every]),
        bent=np.array([f.bent for f in every]),
    )
    return model, paints


def _paints_of(spec: ShapeSpec, shapes: list[Shape]) -> list[str]:
    """Returns the paint name of each of the ``shapes`` that were built from ``spec``.

    A loft has one shape for each paint. A spec with a twin has all shapes twice.
    """
    names = [spec.paint] if isinstance(spec.paint, str) else list(dict.fromkeys(spec.paint))
    return names * (len(shapes) // len(names))


@functools.cache
def _load_file(path: pathlib.Path) -> HumanFile:
    """Returns the checked content of a figure file, which is used for people of all heights."""
    file = load_toml(path, HumanFile, AppearanceError)
    for part, specs in file.parts.items():
        for i, spec in enumerate(specs):
            check_spec(file.paints, spec, f"{path}: parts.{part}[{i}]")
    for outfit, colours in file.outfits.items():
        if missing := colours.keys() - file.paints:
            raise AppearanceError(
                f"{path}: outfits.{outfit}.{min(missing)} is no paint; give some of: {', '.join(file.paints)}"
            )
    if not file.outfits:
        raise AppearanceError(f"{path}: outfits is empty; give one, which may be without colours of its own")
    return file


def _scaled(value: Any, scale: float) -> Any:
    """Returns nested tables and lists with all numbers multiplied by ``scale``."""
    if isinstance(value, dict):
        return {key: _scaled(one, scale) for key, one in value.items()}
    return [scale * one for one in value] if isinstance(value, (list, tuple)) else scale * value
