"""The human model: shapes of every part of a person of a given height, fingers included."""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from typing import Any

import msgspec
import numpy as np

from vinesim import frames
from vinesim.scene.appearance.lofts import build_shapes
from vinesim.scene.appearance.shapes import AppearanceError, Paint, Point, ShapeSpec, Table, check_spec, rod_shape
from vinesim.scene.data_files import find_data_file
from vinesim.scene.toml_loader import load_toml
from vinesim.scene.values import Shape

FINGERS = ("thumb", "index", "middle", "ring", "little")
"""In the order of ``HumanPose.left_fingers``."""
PHALANGES = 3


class Finger(Table, frozen=True):
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


class Limbs(Table, frozen=True):
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


class HumanFile(Table, frozen=True):
    source: str
    height: float
    paints: dict[str, Paint]
    parts: dict[str, tuple[ShapeSpec, ...]]
    limbs: Limbs
    fingers: dict[str, Finger]
    finger_paint: str


@dataclasses.dataclass(frozen=True, eq=False)
class HumanModel:
    """Shapes of a person of one height [m], by part, and the joints between the tracked parts."""

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
    """The human model of this height [m], from ``data/figures``; :class:`AppearanceError` if it cannot be read."""
    file = _load_file(find_data_file("figures", name, ".toml"))
    scale = height / file.height
    parts: dict[str, tuple[Shape, ...]] = {}
    for part, specs in file.parts.items():
        sides = ((part, False),) if not part.startswith("left_") else ((part, False), (f"right_{part[5:]}", True))
        for link, mirror in sides:
            parts[link] = tuple(s for p in specs for s in build_shapes(p, file.paints, scale, mirror))
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
                parts[f"{side}_{FINGERS[number]}_{k + 1}"] = (bone,)
    limbs = msgspec.convert(_scaled(msgspec.to_builtins(file.limbs), scale), Limbs)
    every = [file.fingers[finger] for finger in FINGERS] * 2
    return HumanModel(
        parts=parts, limbs=limbs, root=np.array(roots), length=scale * np.array([f.lengths for f in every]),
        bent=np.array([f.bent for f in every]),
    )  # fmt: skip


@functools.cache
def _load_file(path: pathlib.Path) -> HumanFile:
    """The checked content of a file; one for people of all heights."""
    file = load_toml(path, HumanFile, AppearanceError)
    for part, specs in file.parts.items():
        for i, spec in enumerate(specs):
            check_spec(file.paints, spec, f"{path}: parts.{part}[{i}]")
    return file


def _scaled(value: Any, scale: float) -> Any:
    """All numbers of nested tables and lists times ``scale``."""
    if isinstance(value, dict):
        return {key: _scaled(one, scale) for key, one in value.items()}
    return [scale * one for one in value] if isinstance(value, (list, tuple)) else scale * value
