"""Builds bodies from rods (mass, inertia and joint springs of segments), and assembles trees into a :class:`Model`.

The bending of a segment of length h is split into two halves, each a spring of 2EI/h. The spring of a joint is the
series connection of the two halves that meet there. So its stiffness is EI/h within a rod, and 2EI/h at a clamp, where
there is only one half (with EI/h the deflection of the tip would be wrong by 12.8 %). Segments that differ have halves
that differ.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from vinesim.core import frames, portable_math
from vinesim.core.errors import checked_index
from vinesim.core.numbers import as_numbers, is_number, is_whole
from vinesim.scene import berries, plant_parameters, plausibility
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model

GRAVITY = np.array([0.0, 0.0, -9.81])
"""[m/s^2] Gravitational acceleration, world axes."""


MAX_CLUSTERS = 8
"""Largest number of berry clusters of a bunch. A cluster is a group of berries that move as one rigid body."""


@dataclasses.dataclass(frozen=True, slots=True)
class RodMaterial:
    """Linear elastic material of a rod, with damping proportional to stiffness."""

    modulus: float
    """Young's modulus E of bending [Pa]."""
    density: float
    """[kg/m^3] Density of the material."""
    damping: float = 0.0
    """Stiffness-proportional damping beta [s]: joint damping = beta * joint stiffness."""
    shear_modulus: float | None = None
    """Shear modulus G [Pa]; E / 2.6 (Poisson 0.3) unless given."""
    strength: float = 0.0
    """Modulus of rupture [Pa]; 0: the rod never breaks."""
    yield_strength: float = 0.0
    """Stress [Pa] above which the rod keeps a set; 0: none before it cracks."""
    toughness: float = 1e4
    """[J/m^2] Work that breaks a cracked rod through, for each unit of its cross-section."""


@dataclasses.dataclass(frozen=True, slots=True)
class BunchSegments:
    """Bunches [n], each cut across its rachis (the stem inside the bunch) into a chain of segments of equal length. The
    first segment is the head, the other segments are the berry clusters.

    The frame of a segment has its origin on the rachis at the beginning of the segment, and the axes of the bunch.
    ``max`` is the largest number of segments of a bunch. Entries beyond a bunch's own number of segments are zero.
    """

    count: np.ndarray
    """[n] number of segments of each bunch."""
    length: np.ndarray
    """[n] m, length of one segment."""
    mass: np.ndarray
    """[n, max] kg, mass of each segment."""
    com: np.ndarray
    """[n, max, 3] m, centre of mass in the segment's frame."""
    inertia: np.ndarray
    """[n, max, 3] kg m^2, principal moments about the centre of mass."""
    radius: np.ndarray
    """[n, max, 2] m, radius of the bunch's hull at both ends of a segment."""
    stiffness: np.ndarray
    """[n, max, 3] N m/rad, stiffness of the joint at the beginning of a segment. For the head this is the joint to the
    peduncle."""

    def compound(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the properties of whole bunches as rigid bodies: mass [n] kg, centre of mass [n, 3] m, and moments of
        inertia about it [n, 3] kg m^2, in the frame of the first segment."""
        along = self.length[:, None] * np.arange(self.mass.shape[1])
        centre = self.com + along[..., None] * [1.0, 0.0, 0.0]
        mass = self.mass.sum(1)
        com = (self.mass[..., None] * centre).sum(1) / mass[:, None]
        arm = centre - com[:, None]
        square = arm * arm
        inertia = self.inertia + self.mass[..., None] * (square.sum(-1, keepdims=True) - square)
        return mass, com, inertia.sum(1)


def segment_bunches(
    mass: np.ndarray,
    length: np.ndarray,
    radius: np.ndarray,
    berry_count: np.ndarray,
    seed: np.ndarray,
    variety: np.ndarray,
    rachis: plant_parameters.Rachis,
    stem_share: float,
) -> BunchSegments:
    """Cut bunches [n] into a head and four to eight berry clusters (rigid groups of berries). Each segment has the mass
    of its own berries and stems.

    Args:
        mass: [n] kg.
        length: [n] m, length of the hull.
        radius: [n] m, radius of the hull.
        berry_count: [n] number of berries.
        seed: [n] seed that selects the arrangement of berries among the prototypes of :mod:`vinesim.scene.berries`.
        variety: [n] index into :data:`vinesim.scene.berries.VARIETIES`.
        rachis: parameters of the stem inside the bunch.
        stem_share: share of the mass that is stem.
    """
    count = np.clip(np.round(length / rachis.piece.value).astype(int), 5, 1 + MAX_CLUSTERS)
    share, com, inertia = berries.mass_by_segment(berry_count, seed, variety, count)
    number = np.arange(share.shape[1])
    here = number < count[:, None]
    h = length / count
    juice = mass * (1.0 - stem_share)
    stem = np.where(here, (mass * stem_share / count)[:, None], 0.0)
    fruit = juice[:, None] * share
    com = com * length[:, None, None] - (h[:, None] * number)[..., None] * [1.0, 0.0, 0.0]
    inertia = juice[:, None, None] * inertia * (length * length)[:, None, None]
    # the stem is a rod along the axis
    middle = np.where(here, 0.5 * h[:, None], 0.0)[..., None] * [1.0, 0.0, 0.0]
    total = np.where(here, fruit + stem, 1.0)[..., None]
    both = np.where(here[..., None], (fruit[..., None] * com + stem[..., None] * middle) / total, 0.0)
    for m, at in ((fruit, com), (stem, middle)):
        square = (at - both) ** 2
        inertia = inertia + m[..., None] * (square.sum(-1, keepdims=True) - square)
    inertia = inertia + (stem * (h * h / 12.0)[:, None])[..., None] * [0.0, 1.0, 1.0]
    half = 0.5 * length[:, None]
    edges = np.stack([number, number + 1], -1) * h[:, None, None]
    hull = radius[:, None, None] * np.sqrt(np.maximum(1.0 - (edges / half[..., None] - 1.0) ** 2, 0.0))
    thick = 0.5 * rachis.diameter.at(number / count[:, None])
    stiffness = 0.5 * segment_properties(h[:, None], thick, thick, rachis.modulus.value, 1.0)[2]
    return BunchSegments(
        count,
        h,
        np.where(here, fruit + stem, 0.0),
        both,
        np.where(here[..., None], inertia, 0.0),
        np.where(here[..., None], hull, 0.0),
        np.where(here[..., None], stiffness, 0.0),
    )


class TreeBuilder:
    """Builds one kinematic tree of a plant as a list of rigid bodies, parents before children. The root has number 0.

    Berry clusters (rigid groups of berries) are in a separate list, because :func:`assemble` numbers them after all
    other bodies of their tree.
    """

    def __init__(self, pose: np.ndarray, vine: int = -1) -> None:
        """Start a tree without bodies. ``pose`` [7] (m, quaternion xyzw): world pose of the frame in which the joint of
        the root is placed. ``vine``: number of the vine that the tree belongs to, -1 for none.

        Raises :class:`ValueError` if ``pose`` is not a pose.
        """
        self.pose = frames.checked_pose("tree: pose", pose)
        self.vine = vine
        self.bodies: list[dict[str, Any]] = []
        self.clusters: list[dict[str, Any]] = []
        """Berry clusters, bunch by bunch. ``parent`` None stands for the previous cluster in the list."""
        self.bunches: list[dict[str, Any]] = []
        self.leaves: list[dict[str, Any]] = []

    def add_body(
        self, parent: int, *, offset: Any = (0.0, 0.0, 0.0), rest: Any = frames.IDENTITY, **fields: Any
    ) -> int:
        """Append one body and return its number.

        Args:
            parent: number of the parent body; -1: the tree's root frame.
            offset: [3] m, position of the body's joint in the frame of the parent.
            rest: [4] rest orientation (quaternion xyzw) of the body relative to the parent.
            **fields: values of the body's fields in :class:`Model`, named without the prefix ``body_`` or ``joint_``,
                such as ``mass``.

        Raises :class:`ValueError` if the parent is not in the list, for an unknown field, or for a number out of range.
        """
        if not -1 <= parent < len(self.bodies):
            raise ValueError(f"body {len(self.bodies)} names parent {parent}, which does not stand before it")
        _check_fields(len(self.bodies), {"offset": offset, "rest": rest, **fields})
        self.bodies.append(
            {"parent": parent, "offset": np.asarray(offset, float), "rest": np.asarray(rest, float), **fields}
        )
        return len(self.bodies) - 1

    def add_rod(
        self,
        parent: int,
        length: float,
        radius: tuple[float, float],
        material: RodMaterial,
        segments: int,
        *,
        organ: Organ = Organ.CANE,
        offset: Any = None,
        rest: Any = frames.IDENTITY,
        bends: np.ndarray | None = None,
    ) -> list[int]:
        """Append a (tapered) round rod as a chain of ``segments`` bodies and return their numbers.

        The spring of the first joint represents half a segment of this rod. If the parent is a segment of a rod, the
        part of the parent from its middle to the joint is in series with this spring. Each part damps with its own
        material. Raises :class:`ValueError` if a number is not positive.

        Args:
            parent: body on which the rod grows, -1 for a rod clamped at the root frame.
            length: length [m].
            radius: radii at the base and at the tip [m].
            material: material of the whole rod.
            segments: number of bodies.
            organ: organ of the bodies.
            offset: [3] m, position of the joint in the parent's frame; the parent's tip unless given.
            rest: [4] rotation (quaternion xyzw) of the first segment relative to the parent.
            bends: [segments, 4] rotation (quaternion xyzw) of each segment relative to the previous one; straight
                unless given.
        """
        sizes = as_numbers([length, *radius, material.modulus, material.density])
        losses = as_numbers(
            [
                material.damping,
                material.shear_modulus or 0.0,
                material.strength,
                material.yield_strength,
                material.toughness,
            ]
        )
        sound = np.isfinite(sizes).all() and (sizes > 0.0).all() and np.isfinite(losses).all() and (losses >= 0.0).all()
        if not (sound and is_whole(segments) and segments >= 1):
            raise ValueError(
                f"rod of length {length} m, radius {radius} m, {segments} segments, {material}: all must be positive "
                "and finite (damping may be 0), segments a whole number"
            )
        if bends is not None and np.shape(bends) != (segments, 4):
            raise ValueError(f"rod: bends has the shape {np.shape(bends)}; give [{segments}, 4]")
        place = f"rod of {organ.name.lower()} on body {parent}"
        plausibility.check_rod(place, radius)
        plausibility.check(place, "density", material.density)
        plausibility.check(place, "modulus", material.modulus)
        h = length / segments
        edges = radius[0] + (radius[1] - radius[0]) * np.arange(segments + 1) / segments
        masses, inertias, near, far = segment_properties(
            h, edges[:-1], edges[1:], material.modulus, material.density, material.shear_modulus
        )
        above = self.bodies[parent] if 0 <= parent < len(self.bodies) else {}
        if offset is None:
            offset = (above.get("length", 0.0), 0.0, 0.0)
        # compliance of each joint [rad/N m], plain and weighted with damping
        slack = 1.0 / near
        damped = material.damping / near
        slack[1:] += 1.0 / far[:-1]
        damped[1:] += material.damping / far[:-1]
        if "far" in above:
            reach = np.clip(2.0 * offset[0] / above["length"] - 1.0, 0.0, 1.0)
            share = reach * (1.0 / above["far"]) @ frames.to_matrix(np.asarray(rest, float)) ** 2
            slack[0] += share
            damped[0] += above["beta"] * share
        stiffnesses = 1.0 / slack
        dampings = stiffnesses**2 * damped
        numbers = []
        for i in range(segments):
            turn = frames.IDENTITY if bends is None else bends[i]
            if i == 0:
                at = offset
                turn = frames.multiply(rest, turn)
            else:
                at = (h, 0.0, 0.0)
            parent = self.add_body(
                parent,
                offset=at,
                rest=turn,
                organ=int(organ),
                mass=masses[i],
                com=(h / 2, 0, 0),
                length=h,
                radius=(edges[i], edges[i + 1]),
                inertia=inertias[i],
                stiffness=stiffnesses[i],
                damping=dampings[i],
                far=far[i],
                beta=material.damping,
                strength=material.strength,
                yield_strength=material.yield_strength,
                toughness=material.toughness,
            )
            numbers.append(parent)
        return numbers

    def add_bunch(
        self,
        parent: int,
        mass: float,
        *,
        count: int = 90,
        seed: int = 0,
        variety: int = 0,
        rest: Any = frames.IDENTITY,
        offset: Any = None,
        stiffness: Any = None,
        damping: Any = None,
        clusters: bool = True,
        parameters: plant_parameters.VineParameters | None = None,
        **fields: Any,
    ) -> int:
        """Append a bunch that hangs on a segment of peduncle, and return the number of the bunch's body.

        Length and radius of the bunch follow from its mass, number of berries and variety.

        Args:
            parent: the last segment of the peduncle.
            mass: mass of the bunch [kg].
            count: number of berries, 1 to 140, or 200 of a wine grape.
            seed: seed that selects the arrangement of berries among the prototypes of :mod:`vinesim.scene.berries`.
            variety: index into :data:`vinesim.scene.berries.VARIETIES`.
            rest: [4] rotation relative to the parent.
            offset: [3] m, position of the joint in the parent's frame; the parent's tip unless given.
            stiffness: [3] N m/rad, stiffness of the joint; the parent's unless given.
            damping: [3] N m s/rad, damping of the joint; the parent's unless given.
            clusters: whether the bunch can be divided into berry clusters (rigid groups of berries) while actors are
                near.
            parameters: parameters of the rachis; ``data/plants/vine.toml`` unless given.
            **fields: strength of the peduncle, ``pull`` [N] and ``bend`` [N m]; see ``bunch_pull`` and ``bunch_bend``
                of :class:`Model`.

        Raises :class:`ValueError` if the parent is not in the list, or for a number out of range.
        """
        parent = checked_index("body", parent, len(self.bodies))
        variety = checked_index("variety", variety, len(berries.VARIETIES))
        most = berries.most_berries(variety)
        if not (is_number(mass) and mass > 0.0 and is_whole(count) and 1 <= count <= most):
            raise ValueError(f"bunch of {mass} kg, {count} berries; give a finite mass above 0 and 1 to {most} berries")
        if not (is_whole(seed) and 0 <= seed < 2**32):
            raise ValueError(f"bunch on body {parent}: seed is {seed}; give a whole number from 0 to 4294967295")
        for name, value in fields.items():
            if name not in ("pull", "bend"):
                raise ValueError(f"bunch on body {parent} has no field {name!r}; it has: pull, bend")
            if not (is_number(value) and value > 0.0):
                raise ValueError(f"bunch on body {parent}: {name} is {value}; give a finite number above 0")
        plausibility.check(f"bunch on body {parent}", "mass", mass)
        parameters = plant_parameters.load_plant("vine") if parameters is None else parameters
        above = self.bodies[parent]
        berry = berries.VARIETIES[variety]
        share = parameters.bunch.stem_share.value
        size = berry.volume_radius * math.cbrt(mass * (1.0 - share) / (count * berry.mass))
        length, radius = berries.hull_size(np.array(count), np.array(seed), variety) * size
        one = segment_bunches(
            np.array([mass]),
            np.array([length]),
            np.array([radius]),
            np.array([count]),
            np.array([seed]),
            np.array([variety]),
            parameters.rachis,
            share,
        )
        whole, com, inertia = (value[0] for value in one.compound())
        offset = (above["length"], 0.0, 0.0) if offset is None else offset
        body = self.add_body(
            parent,
            offset=offset,
            rest=rest,
            organ=int(Organ.BUNCH),
            mass=whole,
            com=com,
            inertia=inertia,
            length=length,
            radius=(radius, radius),
            stiffness=above["stiffness"] if stiffness is None else stiffness,
            damping=above["damping"] if damping is None else damping,
        )
        bunch = {
            "body": body,
            "length": length,
            "radius": radius,
            "berries": count,
            "seed": seed,
            "variety": variety,
            **fields,
        }
        if clusters:
            n = int(one.count[0]) - 1
            bunch |= {
                "clusters": n,
                "head_mass": one.mass[0, 0],
                "head_com": one.com[0, 0],
                "head_inertia": one.inertia[0, 0],
            }
            for i in range(1, n + 1):
                self.clusters.append(
                    {
                        "parent": None if i > 1 else body,
                        "offset": np.array([one.length[0], 0.0, 0.0]),
                        "rest": frames.IDENTITY,
                        "organ": int(Organ.BUNCH),
                        "mass": one.mass[0, i],
                        "com": one.com[0, i],
                        "inertia": one.inertia[0, i],
                        "length": one.length[0],
                        "radius": one.radius[0, i],
                        "stiffness": one.stiffness[0, i],
                        "damping": parameters.rachis.damping.value * one.stiffness[0, i],
                    }
                )
        self.bunches.append(bunch)
        return body

    def solve_rest_pose(self) -> None:
        """Change the rest rotations of the joints so that the tree is in equilibrium under gravity in the shape that it
        was built with; see :func:`solve_rest_pose`."""
        model = solve_rest_pose(assemble([self]))
        for body, rest, settled in zip(
            [*self.bodies, *self.clusters], model.body_rest, model.joint_settled, strict=True
        ):
            body["rest"], body["settled"] = rest.astype(float), settled.astype(float)


_BODY_FIELDS = ("organ", "offset", "rest", "mass", "com", "inertia", "length", "radius", "drag")
_POSITIVE = ("mass", "inertia", "length")
_NOT_NEGATIVE = ("radius", "stiffness", "damping", "drag", "far", "beta", "strength", "yield_strength", "toughness")
_FIELDS = {"offset", "rest", "organ", "com", "settled", *_POSITIVE, *_NOT_NEGATIVE}


def _check_fields(body: int, fields: dict[str, Any]) -> None:
    """Raise :class:`ValueError` for the first field that is unknown or has an invalid value."""
    for name, given in fields.items():
        if name not in _FIELDS:
            raise ValueError(f"body {body} has no field {name!r}; it has: {', '.join(sorted(_FIELDS))}")
        value = as_numbers(given)
        if not np.isfinite(value).all():
            raise ValueError(f"body {body}: {name} is {given}; give finite numbers")
        if name in _POSITIVE and not (value > 0.0).all():
            raise ValueError(f"body {body}: {name} is {given}; give numbers above 0")
        if name in _NOT_NEGATIVE and not (value >= 0.0).all():
            raise ValueError(f"body {body}: {name} is {given}; give numbers of 0 or more")


def shear_modulus(modulus: Any) -> Any:
    """Returns the shear modulus [...] Pa of wood with Young's modulus [...] Pa, for Poisson's ratio 0.3."""
    return modulus / 2.6


def segment_properties(
    length: np.ndarray | float,
    start: np.ndarray | float,
    end: np.ndarray | float,
    modulus: np.ndarray | float,
    density: float,
    shear: float | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns the properties of tapered round segments of a rod: mass [...] kg, moments of inertia [..., 3] kg m^2, and
    the stiffness of the two halves of a segment.

    Each half is a spring [..., 3] N m/rad with torsion and bending about two axes: first the half at the start of the
    segment, then the half at the end. The spring of a half has the cross-section at that end, where the joint is.

    Args:
        length: [...] m.
        start: [...] m, radius at the beginning of a segment.
        end: [...] m, radius at its end.
        modulus: [...] Pa, Young's modulus.
        density: [kg/m^3].
        shear: shear modulus [Pa]; Young's modulus / 2.6 unless given.
    """
    length, start, end, modulus = np.broadcast_arrays(length, start, end, modulus)
    middle = 0.5 * (start + end)
    mass = density * np.pi * length * (start * start + start * end + end * end) / 3.0
    across = mass * (length * length / 12.0 + middle * middle / 4.0)
    inertia = np.stack([0.5 * mass * middle * middle, across, across], -1)
    halves = []
    for radius in (start, end):
        area_moment = np.pi * portable_math.power(radius, 4) / 2.0 / length
        bend = modulus * area_moment
        twist = (shear_modulus(modulus) if shear is None else shear) * 2.0 * area_moment
        halves.append(np.stack([twist, bend, bend], -1))
    return mass, inertia, halves[0], halves[1]


def solve_rest_pose(model: Model) -> Model:
    """Change the rest rotations of a model so that its *drawn* shape, the shape that the rest rotations describe at the
    call, is in equilibrium under gravity.

    Each spring must carry the weight of the bodies beyond its joint. So the rest rotation is changed by the rotation
    vector theta at which the gradient of theta^T K theta / 2 equals the torque of this weight, and ``joint_settled`` is
    the opposite rotation: drawn = rest * settled. Writes both fields into ``model`` and returns it. The weight of a
    bunch with clusters is the weight of its head and its clusters. Raises :class:`ValueError` if a joint has no
    stiffness.
    """
    if not (model.joint_stiffness > 0.0).all():
        body = int(np.flatnonzero((model.joint_stiffness <= 0.0).any(1))[0])
        raise ValueError(
            f"body {body} has joint stiffness {model.joint_stiffness[body]}; all must be positive to carry weight"
        )
    drawn = frames.normalize(model.body_rest.astype(float))
    world = model.forward_kinematics(np.broadcast_to(frames.IDENTITY, drawn.shape))
    depth = model.depth()
    parent = model.body_parent
    mass = model.body_mass.astype(float)
    com = model.body_com.astype(float)
    fine = model.bunch_clusters > 0
    mass[model.bunch_body[fine]] = model.bunch_head_mass[fine]
    com[model.bunch_body[fine]] = model.bunch_head_com[fine]
    force = mass[:, None] * GRAVITY
    moment = frames.cross(frames.rotate(world[:, 3:], com), force)
    for level in range(int(depth.max(initial=0)), 0, -1):
        here = np.flatnonzero(depth == level)
        above = parent[here]
        np.add.at(force, above, force[here])
        np.add.at(moment, above, moment[here] + frames.cross(world[here, :3] - world[above, :3], force[here]))
    local = frames.rotate(frames.conjugate(world[:, 3:]), moment)
    theta = np.zeros((len(drawn), 3))
    open_joints = np.arange(len(drawn))
    for _ in range(60):  # the joint's middle axes depend on theta; the map contracts for theta below about 1 rad
        before = theta[open_joints]
        torque = _without_curvature(before, frames.rotate(frames.exp(0.5 * before), local[open_joints]))
        theta[open_joints] = after = torque / model.joint_stiffness[open_joints]
        change = np.abs(after - before).max(1, initial=0.0)
        if change.max(initial=0.0) < 1e-12:
            break
        open_joints = open_joints[change > 0.0]  # the other joints have reached a fixed point, to the last bit
    settled = frames.exp(theta)
    model.body_rest[:] = frames.multiply(drawn, frames.conjugate(settled))
    model.joint_settled[:] = settled
    return model


def _without_curvature(theta: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """Returns K theta [n, 3] N m of springs with rotation vectors theta [n, 3] rad that have the torque ``torque`` [n,
    3] N m in middle axes.

    This solves torque = s K theta + (1 - s) n n^T K theta for K theta; see ``spring_torque`` in
    :mod:`vinesim.kernels.plants.forces`.
    """
    half = 0.5 * np.linalg.norm(theta, axis=1, keepdims=True)
    along = theta / np.maximum(2.0 * half, 1e-12)
    share = np.sinc(half / np.pi)
    return share * torque + (1.0 - share) * (along * torque).sum(1, keepdims=True) * along


def assemble(trees: list[TreeBuilder], **others: np.ndarray) -> Model:
    """Returns one :class:`Model` of all trees, in the given order. ``others``: arrays of the model that do not belong
    to trees, by name, for example ``fixed_start``."""
    counts = {
        "tree": len(trees),
        "body": sum(len(t.bodies) + len(t.clusters) for t in trees),
        "bunch": sum(len(t.bunches) for t in trees),
        "leaf": sum(len(t.leaves) for t in trees),
        "fixed": len(others.get("fixed_start", ())),
        "tie": len(others.get("tie_body", ())),
        "box": len(others.get("box_pose", ())),
    }
    model = Model.allocate(**counts)
    first = bunch = leaf = 0
    for number, tree in enumerate(trees):
        size = len(tree.bodies) + len(tree.clusters)
        core = len(tree.bodies)
        model.tree_first[number] = first
        model.tree_size[number] = size
        model.tree_core[number] = core
        model.tree_pose[number] = tree.pose
        model.tree_vine[number] = tree.vine
        for i, body in enumerate([*tree.bodies, *tree.clusters]):
            at = first + i
            parent = i - 1 if body["parent"] is None else body["parent"]
            model.body_tree[at] = number
            model.body_parent[at] = first + parent if parent >= 0 else -1
            for key in (*_BODY_FIELDS, "strength", "yield_strength", "toughness"):
                if key in body:
                    getattr(model, f"body_{key}")[at] = body[key]
            for key in ("stiffness", "damping", "settled"):
                if key in body:
                    getattr(model, f"joint_{key}")[at] = body[key]
        for fields in tree.bunches:
            for key, value in fields.items():
                getattr(model, f"bunch_{key}")[bunch] = value + first if key == "body" else value
            if fields.get("clusters", 0):
                model.bunch_cluster[bunch] = first + core
                core += fields["clusters"]
            bunch += 1
        for fields in tree.leaves:
            for key, value in fields.items():
                getattr(model, f"leaf_{key}")[leaf] = value + first if key == "body" else value
            leaf += 1
        first += size
    for name, value in others.items():
        target = getattr(model, name)
        target[:] = np.asarray(value).reshape(target.shape)
    return model.check()
