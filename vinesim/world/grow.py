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
        self.bodies.append(
            {"parent": parent, "offset": np.asarray(offset, float), "rest": np.asarray(rest, float), **fields}
        )
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
            raise ValueError(
                f"rod of length {length} m, radius {radius} m, {pieces} pieces, {wood}: all must be positive"
            )
        h = length / pieces
        edges = radius[0] + (radius[1] - radius[0]) * np.arange(pieces + 1) / pieces
        first = (np.arange(pieces) == 0) & (clamped is None or clamped)
        masses, inertias, stiffnesses = section(h, edges[:-1], edges[1:], wood.modulus, wood.density, first, wood.shear)
        if not first[0]:  # the joint lies between like neighbours: the section of the piece's middle stands for both
            middle = 0.5 * (edges[0] + edges[1])
            stiffnesses[0] = section(h, middle, middle, wood.modulus, wood.density, False, wood.shear)[2]
        numbers = []
        for i in range(pieces):
            turn = frames.IDENTITY if bends is None else bends[i]
            if i == 0:
                at = (
                    offset
                    if offset is not None
                    else ((0, 0, 0) if parent < 0 else (self.bodies[parent]["length"], 0, 0))
                )
                turn = frames.multiply(rest, turn)
            else:
                at = (h, 0.0, 0.0)
            parent = self.add(
                parent, offset=at, rest=turn, organ=int(organ), mass=masses[i], com=(h / 2, 0, 0), length=h,
                radius=(edges[i], edges[i + 1]), inertia=inertias[i], stiffness=stiffnesses[i],
                damping=wood.damping * stiffnesses[i],
            )  # fmt: skip
            numbers.append(parent)
        return numbers

    def settle(self) -> None:
        """Choose rest rotations so that the shape drawn so far is the equilibrium under gravity: see :func:`settle`."""
        model = settle(assemble([self]))
        for body, rest, settled in zip(self.bodies, model.body_rest, model.joint_settled, strict=True):
            body["rest"], body["settled"] = rest.astype(float), settled.astype(float)


def section(
    length: np.ndarray | float,
    start: np.ndarray | float,
    end: np.ndarray | float,
    modulus: np.ndarray | float,
    density: float,
    clamped: np.ndarray | bool,
    shear: float | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mass [...], moments of inertia [..., 3] and joint stiffness [..., 3] of rod pieces with radii start and end [m].

    The joint sits at the start and bends with the section there; ``clamped`` doubles it (half an element to a wall).
    """
    length, start, end, modulus = np.broadcast_arrays(length, start, end, modulus)
    middle = 0.5 * (start + end)
    mass = density * np.pi * length * (start * start + start * end + end * end) / 3.0
    across = mass * (length * length / 12.0 + middle * middle / 4.0)
    inertia = np.stack([0.5 * mass * middle * middle, across, across], -1)
    area_moment = np.pi * start**4 / 4.0 * np.where(clamped, 2.0, 1.0) / length
    bend = modulus * area_moment
    twist = (modulus / 2.6 if shear is None else shear) * 2.0 * area_moment
    return mass, inertia, np.stack([twist, bend, bend], -1)


def settle(model: Model) -> Model:
    """Turn rest rotations that hold the *drawn* shape into slack ones, so that the drawn shape is the equilibrium.

    The spring must carry the weight hanging below each joint, so it is turned by theta = torque / stiffness (in joint
    axes), and ``joint_settled`` turns it back: drawn = rest * settled. Writes both fields and returns the model.
    """
    if not (model.joint_stiffness > 0.0).all():
        body = int(np.flatnonzero((model.joint_stiffness <= 0.0).any(1))[0])
        raise ValueError(
            f"body {body} has joint stiffness {model.joint_stiffness[body]}; all must be positive to carry weight"
        )
    drawn = frames.normalize(model.body_rest.astype(float))
    world = model.forward(np.broadcast_to(frames.IDENTITY, drawn.shape))
    depth, parent = model.depth(), model.body_parent
    force = model.body_mass[:, None].astype(float) * GRAVITY
    moment = np.cross(frames.rotate(world[:, 3:], model.body_com.astype(float)), force)
    for level in range(int(depth.max(initial=0)), 0, -1):
        here = np.flatnonzero(depth == level)
        above = parent[here]
        np.add.at(force, above, force[here])
        np.add.at(moment, above, moment[here] + np.cross(world[here, :3] - world[above, :3], force[here]))
    settled = np.broadcast_to(frames.IDENTITY, drawn.shape)
    local = frames.rotate(frames.conjugate(world[:, 3:]), moment)
    for _ in range(60):  # the joint's axes depend on the answer; the map contracts for theta below ~1 rad
        before = settled
        settled = frames.exp(frames.rotate(settled, local) / model.joint_stiffness)
        if np.abs(settled - before).max(initial=0.0) < 1e-12:
            break
    model.body_rest[:] = frames.multiply(drawn, frames.conjugate(settled))
    model.joint_settled[:] = settled
    return model


def assemble(trees: list[Tree], **others: np.ndarray) -> Model:
    """One :class:`Model` of all trees; ``others`` are whole arrays of the rest (``fixed_start=...``)."""
    counts = {
        "tree": len(trees),
        "body": sum(len(t.bodies) for t in trees),
        "bunch": sum(len(t.bunches) for t in trees),
        "leaf": sum(len(t.leaves) for t in trees),
        "fixed": len(others.get("fixed_start", ())),
        "tie": len(others.get("tie_body", ())),
        "box": len(others.get("box_pose", ())),
    }
    model = Model.allocate(**counts)
    first = bunch = leaf = 0
    for number, tree in enumerate(trees):
        model.tree_first[number], model.tree_size[number] = first, len(tree.bodies)
        model.tree_core[number] = len(tree.bodies)
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
