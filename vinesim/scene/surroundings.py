"""What surrounds the plants of a built model: wires, ties of canes to them, and open boxes.

cane = CaneBuilder(length=1.0, damping_ratio=0.1)
wire = Wire((0.5, -1.0, 1.0), (0.5, 1.0, 1.0), tension=900.0)
model = assemble([cane], wires=[wire], ties=[Tie(tree=0, along=0.5, wire=0)])
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from vinesim.core import frames
from vinesim.core.errors import checked_index
from vinesim.core.numbers import as_numbers, checked_number, checked_vector
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model

Vector = Sequence[float] | np.ndarray


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Box:
    """An open box that plants, robots and other boxes can touch. ``ValueError`` if a number is out of range."""

    position: Vector = (0.0, 0.0, 0.0)
    """[3] m, or [7] position and quaternion xyzw: the middle of its underside."""
    size: Vector = (0.6, 0.4, 0.25)
    """[3] m, outer length, width and height."""
    mass: float = 2.0
    """[kg]"""

    def __post_init__(self) -> None:
        if as_numbers(self.position).shape == (7,):
            frames.checked_pose("box: position", self.position)
        else:
            checked_vector("box: position", self.position, "m")
        if not (checked_vector("box: size", self.size, "m") > 0.0).all():
            raise ValueError(f"box: size is {self.size}; give three lengths above 0 [m]")
        checked_number("box: mass", self.mass, "kg", positive=True)

    @property
    def pose(self) -> np.ndarray:
        """[7] Pose of the middle of its underside."""
        given = as_numbers(self.position)
        return frames.pose(given) if len(given) == 3 else given


@dataclasses.dataclass(frozen=True, eq=False)
class Wire:
    """A straight wire between two fixed points. ``ValueError`` if a number is out of range."""

    start: Vector
    """[3] m"""
    end: Vector
    """[3] m"""
    tension: float = 900.0
    """[N] A force across the wire deflects it as a string of this tension, without mass; 0: it does not deflect."""
    radius: float = 0.0014
    """[m]"""
    stretch: float = 0.0
    """[N/m] Rise of the tension for each metre by which deflection lengthens the wire; 0: the tension is constant."""
    strength: float = 0.0
    """[N] Tension at which the wire breaks; 0: it never breaks."""

    def __post_init__(self) -> None:
        span = checked_vector("wire: end", self.end, "m") - checked_vector("wire: start", self.start, "m")
        if not np.linalg.norm(span) > 1e-6:
            raise ValueError(f"wire: start and end are {self.start}; give two points [m] that differ")
        checked_number("wire: tension", self.tension, "N")
        checked_number("wire: radius", self.radius, "m", positive=True)
        checked_number("wire: stretch", self.stretch, "N/m")
        checked_number("wire: strength", self.strength, "N")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Tie:
    """A spring from a point of a cane to a wire, or to a fixed point of the world. It is slack in the drawn shape.
    ``ValueError`` if a number is out of range."""

    tree: int = 0
    """Index of the cane in the list."""
    along: float
    """[m] Place on the cane's main axis, measured from its base."""
    wire: int | None = None
    """Index of the wire in the list; None: the tie holds the cane where it is drawn."""
    stiffness: float = 2000.0
    """[N/m]"""
    damping: float = 20.0
    """[N s/m]"""
    slip: float = 0.0
    """[N] Force along its wire at which the tie slips; 0: it never slips."""
    strength: float = 0.0
    """[N] Force at which the tie breaks; 0: it never breaks."""

    def __post_init__(self) -> None:
        checked_number("tie: slip", self.slip, "N")
        checked_number("tie: strength", self.strength, "N")
        checked_number("tie: along", self.along, "m")
        checked_number("tie: stiffness", self.stiffness, "N/m", positive=True)
        checked_number("tie: damping", self.damping, "N s/m")


def surroundings(plants: Model, wires: Sequence[Wire], ties: Sequence[Tie], boxes: Sequence[Box]) -> dict[str, Any]:
    """Returns the arrays of a model, by name, for the surroundings of ``plants``. Raises ``ValueError`` for a tie of a
    cane, a place on a cane or a wire that does not exist."""
    for name, kind, given in (("wires", Wire, wires), ("ties", Tie, ties), ("boxes", Box, boxes)):
        for one in given:
            if not isinstance(one, kind):
                raise ValueError(f"{name} contain a {type(one).__name__}; give vinesim.{kind.__name__}")
    arrays: dict[str, Any] = {
        "fixed_start": [wire.start for wire in wires],
        "fixed_end": [wire.end for wire in wires],
        "fixed_radius": [(wire.radius, wire.radius) for wire in wires],
        "fixed_organ": [int(Organ.WIRE)] * len(wires),
        "fixed_index": range(len(wires)),
        "fixed_tension": [wire.tension for wire in wires],
        "fixed_stretch": [wire.stretch for wire in wires],
        "fixed_strength": [wire.strength for wire in wires],
        "box_pose": [box.pose for box in boxes],
        "box_size": [box.size for box in boxes],
        "box_mass": [box.mass for box in boxes],
    }
    poses = plants.forward_kinematics(plants.joint_settled)
    rows = sorted((_tied_body(plants, tie), tie.along, i) for i, tie in enumerate(ties))
    bodies = [body for (body, _), _, _ in rows]
    offsets = np.array([offset for (_, offset), _, _ in rows])
    points = np.zeros((len(rows), 3))
    points[:, 0] = offsets
    tied = [ties[i] for _, _, i in rows]
    for tie in tied:
        if tie.wire is not None:
            checked_index("wire", tie.wire, len(wires))
    anchors = poses[bodies, :3] + frames.rotate(poses[bodies, 3:], points) if rows else np.zeros((0, 3))
    return arrays | {
        "tie_body": bodies,
        "tie_point": points,
        "tie_anchor": anchors,
        "tie_wire": [-1 if tie.wire is None else tie.wire for tie in tied],
        "tie_stiffness": [tie.stiffness for tie in tied],
        "tie_damping": [tie.damping for tie in tied],
        "tie_slip": [tie.slip for tie in tied],
        "tie_strength": [tie.strength for tie in tied],
    }


def main_axis(model: Model, tree: int) -> list[int]:
    """Returns the bodies of a tree's main axis. From its root, it continues with the first child of each body that is a
    segment of cane."""
    bodies = model.bodies_of(tree)
    axis = [bodies.start]
    while True:
        above = model.body_parent[bodies] == axis[-1]
        following = np.flatnonzero(above & (model.body_organ[bodies] == int(Organ.CANE)))
        if len(following) == 0:
            return axis
        axis.append(bodies.start + int(following[0]))


def _tied_body(plants: Model, tie: Tie) -> tuple[int, float]:
    """Returns the body that a tie holds, and the distance [m] from the body's joint."""
    tree = checked_index("tie: tree", tie.tree, len(plants.tree_first))
    axis = main_axis(plants, tree)
    lengths = plants.body_length[axis].astype(float)
    ends = np.cumsum(lengths)
    if tie.along > ends[-1] + 1e-6:
        raise ValueError(f"tie: along is {tie.along}; tree {tree} is {ends[-1]:.3f} m long, give no more")
    piece = min(int(np.searchsorted(ends, tie.along)), len(axis) - 1)
    return axis[piece], min(float(tie.along - (ends[piece] - lengths[piece])), float(lengths[piece]))
