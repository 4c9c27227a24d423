"""Beams to bodies: how a piece of wood becomes mass, inertia and joint springs, and pieces become a :class:`Model`.

A rod of length L cut into n bodies of length h = L/n has a spring EI/h in every joint but the first, which is
2EI/h: half an element lies between the clamp and the first body's middle (with EI/h the tip is 12.8 % off).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from vinesim import frames
from vinesim.world.ids import Organ
from vinesim.world.model import Model

GRAVITY = np.array([0.0, 0.0, -9.81])
"""[m/s^2], world axes."""


@dataclasses.dataclass(frozen=True, slots=True)
class Wood:
    """Material of a rod."""

    modulus: float
    """Flexural modulus E [Pa]."""
    density: float
    """[kg/m^3]"""
    damping: float = 0.0
    """Stiffness-proportional damping beta [s]: joint damping = beta * joint stiffness."""
    shear: float | None = None
    """Shear modulus G [Pa]; E / 2.6 (Poisson 0.3) unless given."""


class Tree:
    """One tree while it grows: a list of bodies, parents before children. Bodies are numbered from 0, the root."""

    def __init__(self, pose: np.ndarray, vine: int = -1) -> None:
        """``pose`` [7]: where the root's joint frame sits in the world."""
        self.pose = np.asarray(pose, float)
        self.vine = vine
        self.bodies: list[dict[str, Any]] = []
        self.bunches: list[dict[str, Any]] = []
        self.leaves: list[dict[str, Any]] = []

    def add(self, parent: int, *, offset: Any = (0.0, 0.0, 0.0), rest: Any = frames.IDENTITY, **fields: Any) -> int:
        """Append one body with explicit :class:`Model` fields (names without prefix); returns its number."""
        if not -1 <= parent < len(self.bodies):
            raise ValueError(f"body {len(self.bodies)} names parent {parent}, which does not stand before it")
        self.bodies.append({"parent": parent, "offset": np.asarray(offset, float), "rest": np.asarray(rest, float), **fields})
        return len(self.bodies) - 1

    def rod(
        self,
        parent: int,
        length: float,
        radius: tuple[float, float],
        wood: Wood,
        pieces: int,
        *,
        organ: Organ = Organ.CANE,
        offset: Any = None,
        rest: Any = frames.IDENTITY,
        bends: np.ndarray | None = None,
        clamped: bool | None = None,
    ) -> list[int]:
        """Grow a (tapered) rod of ``pieces`` bodies and return their numbers.

        ``rest`` turns the first piece against the parent, ``bends`` [pieces, 4] each piece against the one before.
        ``offset`` is the joint in the parent's frame, the parent's tip unless given. ``clamped`` (the default on a
        root and on a fork, where the neighbour is stiff) doubles the first spring.
        """
        if length <= 0.0 or min(radius) <= 0.0 or pieces < 1 or wood.modulus <= 0.0 or wood.density <= 0.0:
            raise ValueError(f"rod of length {length} m, radius {radius} m, {pieces} pieces, {wood}: all must be positive")
        clamped = True if clamped is None else clamped
        h = length / pieces
        numbers = []
        for i in range(pieces):
            start, end = (radius[0] + (radius[1] - radius[0]) * (i + k) / pieces for k in (0, 1))
            middle = 0.5 * (start + end)
            mass = wood.density * np.pi * h * (start * start + start * end + end * end) / 3.0
            # bending at the joint sees the section there; torsion the same
            area_moment = np.pi * start**4 / 4.0 if i else np.pi * (start if clamped else middle) ** 4 / 4.0
            k_bend = wood.modulus * area_moment / h * (2.0 if i == 0 and clamped else 1.0)
            k_twist = (wood.shear or wood.modulus / 2.6) * 2.0 * area_moment / h * (2.0 if i == 0 and clamped else 1.0)
            stiffness = np.array([k_twist, k_bend, k_bend])
            across = mass * (h * h / 12.0 + middle * middle / 4.0)
            turn = frames.IDENTITY if bends is None else bends[i]
            if i == 0:
                at = offset if offset is not None else ((0, 0, 0) if parent < 0 else (self.bodies[parent]["length"], 0, 0))
                turn = frames.multiply(rest, turn)
            else:
                at = (h, 0.0, 0.0)
            parent = self.add(
                parent, offset=at, rest=turn, organ=int(organ), mass=mass, com=(h / 2, 0, 0), length=h, radius=(start, end),
                inertia=(0.5 * mass * middle * middle, across, across), stiffness=stiffness, damping=wood.damping * stiffness,
            )  # fmt: skip
            numbers.append(parent)
        return numbers

    def settle(self) -> None:
        """Choose rest rotations so that the shape drawn so far is the equilibrium under gravity.

        Until now ``rest`` held the drawn rotation. The spring must carry the weight hanging below each joint, so it is
        turned by theta = torque / stiffness (in joint axes), and ``settled`` turns it back: drawn = rest * settled.
        """
        count = len(self.bodies)
        world = np.zeros((count, 7))
        for i, body in enumerate(self.bodies):
            base = self.pose if body["parent"] < 0 else world[body["parent"]]
            world[i] = frames.compose(base, np.concatenate([body["offset"], body["rest"]]))
        force, moment = np.zeros(3 * count).reshape(-1, 3), np.zeros((count, 3))
        for i in reversed(range(count)):
            body = self.bodies[i]
            weight = body["mass"] * GRAVITY
            moment[i] += np.cross(frames.rotate(world[i, 3:], np.asarray(body["com"], float)), weight)
            force[i] += weight
            if body["parent"] >= 0:
                p = body["parent"]
                force[p] += force[i]
                moment[p] += moment[i] + np.cross(world[i, :3] - world[p, :3], force[i])
        for i, body in enumerate(self.bodies):
            base = self.pose if body["parent"] < 0 else world[body["parent"]]
            drawn, settled = body["rest"], frames.IDENTITY
            for _ in range(30):  # the joint's axes depend on the answer; the map contracts for theta below ~1 rad
                rest = frames.multiply(drawn, frames.conjugate(settled))
                axes = frames.multiply(base[3:], rest)
                theta = frames.rotate(frames.conjugate(axes), moment[i]) / body["stiffness"]
                settled = frames.exp(theta)
            body["rest"], body["settled"] = frames.multiply(drawn, frames.conjugate(settled)), settled


def assemble(trees: list[Tree], **others: np.ndarray) -> Model:
    """One :class:`Model` of all trees; ``others`` are whole arrays of the rest (``fixed_start=...``, ``box_pose=...``)."""
    counts = {
        "tree": len(trees),
        "body": sum(len(t.bodies) for t in trees),
        "bunch": sum(len(t.bunches) for t in trees),
        "leaf": sum(len(t.leaves) for t in trees),
        "fixed": len(others.get("fixed_start", ())),
        "box": len(others.get("box_pose", ())),
    }
    model = Model.allocate(**counts)
    first = bunch = leaf = 0
    for number, tree in enumerate(trees):
        model.tree_first[number], model.tree_size[number] = first, len(tree.bodies)
        model.tree_pose[number], model.tree_vine[number] = tree.pose, tree.vine
        for i, body in enumerate(tree.bodies):
            at = first + i
            model.body_tree[at] = number
            model.body_parent[at] = first + body["parent"] if body["parent"] >= 0 else -1
            for key in ("organ", "offset", "rest", "mass", "com", "inertia", "length", "radius"):
                if key in body:
                    getattr(model, f"body_{key}")[at] = body[key]
            for key in ("stiffness", "damping", "settled"):
                if key in body:
                    getattr(model, f"joint_{key}")[at] = body[key]
        for fields in tree.bunches:
            for key, value in fields.items():
                getattr(model, f"bunch_{key}")[bunch] = value + first if key == "body" else value
            bunch += 1
        for fields in tree.leaves:
            for key, value in fields.items():
                getattr(model, f"leaf_{key}")[leaf] = value + first if key == "body" else value
            leaf += 1
        first += len(tree.bodies)
    for name, value in others.items():
        target = getattr(model, name)
        target[:] = np.asarray(value).reshape(target.shape)
    return model.check()
