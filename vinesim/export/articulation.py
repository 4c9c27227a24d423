"""Content of a vineyard for other simulators: rigid bodies on hinges with springs, ties, fixed wood, boxes, leaves.

The writers of all formats read these values, so that a body has the same mass, place and springs in each format.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.contact.plant_capsules import plant_capsules
from vinesim.core import frames
from vinesim.export.joint_springs import HingeSprings, hinge_springs
from vinesim.rigid.static_world import CRATE_COLOR, boxes_of, crate_shapes
from vinesim.scene.builder import GRAVITY
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.terrain import Terrain
from vinesim.wires.elastic_supports import arm_compliance, wire_compliance

HINGES = ("twist", "bend_y", "bend_z")
"""Names of the three hinges of a joint, from the parent to the body."""

COLORS = {
    Organ.GROUND: (0.42, 0.36, 0.26, 1.0),
    Organ.POLE: (0.55, 0.55, 0.53, 1.0),
    Organ.WIRE: (0.7, 0.7, 0.72, 1.0),
    Organ.TRUNK: (0.3, 0.22, 0.15, 1.0),
    Organ.ARM: (0.34, 0.25, 0.17, 1.0),
    Organ.CANE: (0.45, 0.5, 0.2, 1.0),
    Organ.LEAF: (0.2, 0.42, 0.12, 1.0),
    Organ.PEDUNCLE: (0.5, 0.62, 0.25, 1.0),
    Organ.BUNCH: (0.3, 0.1, 0.28, 1.0),
    Organ.BOX: CRATE_COLOR,
}
"""Colour (red, green, blue, opacity, from 0 to 1) of each organ."""


@dataclasses.dataclass(frozen=True)
class Capsule:
    """A capsule; a sphere if ``start`` equals ``end``."""

    start: np.ndarray
    end: np.ndarray
    radius: float

    @property
    def is_sphere(self) -> bool:
        """Whether both ends are the same point."""
        return bool((self.start == self.end).all())


@dataclasses.dataclass(frozen=True)
class Leaf:
    """A leaf, drawn as a thin box."""

    pose: np.ndarray
    """[7] Pose of the box's centre in the body's frame."""
    size: np.ndarray
    """[3] m, half of length, width and thickness."""


@dataclasses.dataclass(frozen=True)
class Link:
    """A rigid body of a plant, and the hinges to its parent."""

    name: str
    organ: Organ
    tree: int
    parent: int
    """Index of the parent among all links; -1: the world."""
    pose: np.ndarray
    """[7] Pose in the parent's frame, or in the world, in the drawn shape, where all hinges are at 0."""
    mass: float
    com: np.ndarray
    """[3] m."""
    inertia: np.ndarray
    """[3, 3] kg m^2, about the centre of mass, in the body's axes."""
    axes: np.ndarray
    """[3, 3] Axes of the hinges in the body's frame; ``axes[k]`` is that of hinge k."""
    stiffness: np.ndarray
    """[3] N m/rad."""
    damping: np.ndarray
    """[3] N m s/rad."""
    rest: np.ndarray
    """[3] rad, angles at which the springs are slack."""
    capsules: tuple[Capsule, ...]
    leaves: tuple[Leaf, ...]
    buds: tuple[tuple[str, np.ndarray], ...] = ()
    """Name and pose [7] in the body's frame of each bud of a dormant cane, which points along x."""


@dataclasses.dataclass(frozen=True)
class Tie:
    """A spring between a point of a link and a point of the world; without force in the drawn shape."""

    name: str
    link: int
    point: np.ndarray
    """[3] m, in the link's frame."""
    anchor: np.ndarray
    """[3] m, world."""
    axes: np.ndarray
    """[3, 3] Unit vectors in the world; the first is along the wire."""
    stiffness: np.ndarray
    """[3] N/m along each axis."""
    damping: np.ndarray
    """[3] N s/m."""


@dataclasses.dataclass(frozen=True)
class FixedPiece:
    """A piece of a pole, wire, trunk or arm."""

    name: str
    organ: Organ
    capsule: Capsule


@dataclasses.dataclass(frozen=True)
class Crate:
    """A picking box: an open crate that moves freely."""

    name: str
    pose: np.ndarray
    mass: float
    walls: tuple[tuple[np.ndarray, np.ndarray, float], ...]
    """Pose [7] and half sizes [3] m of bottom and walls, and the mass [kg] of each."""


@dataclasses.dataclass(frozen=True)
class Vineyard:
    """Everything that is exported."""

    name: str
    links: tuple[Link, ...]
    ties: tuple[Tie, ...]
    fixed: tuple[FixedPiece, ...]
    crates: tuple[Crate, ...]
    timestep: float
    """[s] Step at which springs that are explicit in position are stable."""
    gravity: float
    friction: float
    terrain: Terrain | None
    """Uneven ground; None: the plane z = 0."""


def describe(
    model: Model, *, name: str, leaves: bool, orthogonal: bool, gravity: float = -float(GRAVITY[2]), friction: float
) -> Vineyard:
    """Returns the vineyard of a model in its drawn shape. Each bunch is one rigid body.

    Wires and arms do not move: their elasticity is in series with the springs of the ties and roots that they hold.

    Args:
        model: the vineyard.
        name: name of the scene.
        leaves: whether the links have leaves.
        orthogonal: whether the hinges of a joint must be orthogonal, see :func:`hinge_springs`.
        gravity: gravitational acceleration [m/s^2].
        friction: friction coefficient of all contacts.
    """
    kept = np.arange(len(model.body_mass)) - model.tree_first[model.body_tree] < model.tree_core[model.body_tree]
    kept &= ~model.is_spare()
    mass, com, inertia = _rigid_bunches(model)
    compliance = np.zeros((len(kept), 3, 3))
    roots, amount, _, axis = arm_compliance(model)
    compliance[roots] = amount[:, None, None] * axis[:, :, None] * axis[:, None, :]
    springs = hinge_springs(
        model.joint_settled, model.joint_stiffness, model.joint_damping, compliance, orthogonal=orthogonal
    )
    links = _links(model, np.flatnonzero(kept), mass, com, inertia, springs, leaves)
    number = np.cumsum(kept) - 1
    return Vineyard(
        terrain=model.terrain,
        name=name,
        links=links,
        ties=_ties(model, number),
        fixed=tuple(
            FixedPiece(f"{Organ(organ).name.lower()}_{i}", Organ(organ), Capsule(start, end, radius))
            for i, (organ, start, end, radius) in enumerate(
                zip(
                    model.fixed_organ.tolist(),
                    model.fixed_start.astype(float),
                    model.fixed_end.astype(float),
                    model.fixed_radius.astype(float).mean(1).tolist(),
                    strict=True,
                )
            )
        ),
        crates=_crates(model),
        timestep=_timestep(links),
        gravity=gravity,
        friction=friction,
    )


def _rigid_bunches(model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns mass [body], centre of mass [body, 3] and inertia about it [body, 3, 3], with the berry clusters of each
    bunch fused to its body in the drawn shape."""
    mass = model.body_mass.astype(float)
    com = model.body_com.astype(float)
    inertia = model.body_inertia.astype(float)[:, :, None] * np.eye(3)
    clustered = np.flatnonzero(model.bunch_clusters > 0)
    pose = model.forward_kinematics(model.joint_settled.astype(float))
    for bunch in clustered.tolist():
        body = int(model.bunch_body[bunch])
        first = int(model.bunch_cluster[bunch])
        parts = np.arange(first, first + int(model.bunch_clusters[bunch]))
        local = np.concatenate([[frames.pose(np.zeros(3))], frames.compose(frames.inverse(pose[body]), pose[parts])])
        m = np.concatenate([[model.bunch_head_mass[bunch]], model.body_mass[parts]]).astype(float)
        own = np.concatenate([[model.bunch_head_com[bunch]], model.body_com[parts]]).astype(float)
        moments = np.concatenate([[model.bunch_head_inertia[bunch]], model.body_inertia[parts]]).astype(float)
        place = local[:, :3] + frames.rotate(local[:, 3:], own)
        axes = frames.to_matrix(local[:, 3:])
        mass[body] = m.sum()
        com[body] = (m[:, None] * place).sum(0) / mass[body]
        arm = place - com[body]
        square = (arm * arm).sum(1)[:, None, None] * np.eye(3) - arm[:, :, None] * arm[:, None, :]
        inertia[body] = (axes * moments[:, None, :] @ np.swapaxes(axes, 1, 2) + m[:, None, None] * square).sum(0)
    return mass, com, inertia


def _links(
    model: Model,
    bodies: np.ndarray,
    mass: np.ndarray,
    com: np.ndarray,
    inertia: np.ndarray,
    springs: HingeSprings,
    leaves: bool,
) -> tuple[Link, ...]:
    """Returns the links of ``bodies`` [link], whose springs are given for all bodies."""
    joint = np.concatenate(
        [
            model.body_offset.astype(float),
            frames.normalize(frames.multiply(model.body_rest.astype(float), model.joint_settled.astype(float))),
        ],
        -1,
    )
    root = model.body_parent < 0
    joint[root] = frames.compose(model.tree_pose[model.body_tree[root]].astype(float), joint[root])
    number = np.full(len(mass), -1)
    number[bodies] = np.arange(len(bodies))
    shapes = plant_capsules(model)
    capsules: dict[int, list[Capsule]] = {}
    for at in np.flatnonzero(shapes.level < 2).tolist():  # bunches are coarse
        capsules.setdefault(int(shapes.body[at]), []).append(
            Capsule(shapes.start[at].astype(float), shapes.end[at].astype(float), float(shapes.radius[at]))
        )
    blades: dict[int, list[Leaf]] = {}
    for at in range(len(model.leaf_body) if leaves else 0):
        half = float(model.leaf_size[at])
        pose = frames.compose(model.leaf_pose[at].astype(float), frames.pose(np.array([half, 0.0, 0.0])))
        blades.setdefault(int(model.leaf_body[at]), []).append(Leaf(pose, np.array([half, half, 5e-4])))
    nodes = model.nodes
    buds: dict[int, list[tuple[str, np.ndarray]]] = {}
    for node in np.flatnonzero(nodes.bud >= 0).tolist():
        one = f"bud_{int(nodes.bud[node]):05d}", nodes.bud_pose[node].astype(float)
        buds.setdefault(int(nodes.body[node]), []).append(one)
    bunch = {int(body): i for i, body in enumerate(model.bunch_body)}
    made = []
    for body in bodies.tolist():
        organ = Organ(int(model.body_organ[body]))
        parent = int(model.body_parent[body])
        made.append(
            Link(
                name=f"bunch_{bunch[body]}" if body in bunch else f"{organ.name.lower()}_{body}",
                organ=organ,
                tree=int(model.body_tree[body]),
                parent=int(number[parent]) if parent >= 0 else -1,
                pose=joint[body],
                mass=float(mass[body]),
                com=com[body],
                inertia=inertia[body],
                axes=springs.axes[body],
                stiffness=springs.stiffness[body],
                damping=springs.damping[body],
                rest=springs.rest[body],
                capsules=tuple(capsules.get(body, ())),
                leaves=tuple(blades.get(body, ())),
                buds=tuple(buds.get(body, ())),
            )
        )
    return tuple(made)


def _ties(model: Model, number: np.ndarray) -> tuple[Tie, ...]:
    """Returns the ties. ``number``: [body] index of the link of each body. Across a wire, tie and wire are springs in
    series; along the wire the tie alone gives way."""
    made = []
    compliance = wire_compliance(model)
    for i in range(len(model.tie_body)):
        own = float(model.tie_stiffness[i])
        wire = int(model.tie_wire[i])
        along = np.array([1.0, 0.0, 0.0])
        if wire >= 0:
            way = (model.fixed_end[wire] - model.fixed_start[wire]).astype(float)
            along = way / np.linalg.norm(way)
        across = np.cross(along, [0.0, 0.0, 1.0] if abs(along[2]) < 0.9 else [0.0, 1.0, 0.0])
        across /= np.linalg.norm(across)
        share = 1.0 / (1.0 + own * compliance[i])
        scale = np.array([1.0, share, share])
        made.append(
            Tie(
                name=f"tie_{i}",
                link=int(number[model.tie_body[i]]),
                point=model.tie_point[i].astype(float),
                anchor=model.tie_anchor[i].astype(float),
                axes=np.stack([along, across, np.cross(along, across)]),
                stiffness=own * scale,
                damping=float(model.tie_damping[i]) * scale,
            )
        )
    return tuple(made)


def _crates(model: Model) -> tuple[Crate, ...]:
    made = []
    for number, box in boxes_of(model).items():
        walls = crate_shapes(box.size)
        volume = [float(np.prod(wall.size)) for wall in walls]
        parts = tuple(
            (np.asarray(wall.pose, float), np.asarray(wall.size, float), box.mass * share / sum(volume))
            for wall, share in zip(walls, volume, strict=True)
        )
        made.append(Crate(f"box_{number}", np.asarray(box.pose, float), float(box.mass), parts))
    return tuple(made)


MAX_TIMESTEP = 0.005
"""[s] Largest recommended step. GUESSED: contacts of stiff bodies, too, need a step of this size."""
MIN_TIMESTEP = 1e-4
"""[s] Smallest recommended step."""


def _timestep(links: tuple[Link, ...]) -> float:
    """Returns a step [s] at which semi-implicit Euler with implicit damping is stable.

    It is stable for steps up to twice the damping time (damping / stiffness) of each joint whatever its inertia, and up
    to 2 / w for a joint of frequency w. Half the damping time is chosen, or a tenth of 1 / w, where a body's own
    inertia gives a bound of w.
    """
    step = MAX_TIMESTEP
    for link in links:
        stiff = link.stiffness > 0.0
        if not stiff.any():
            continue
        about = np.einsum("ki,ij,kj->k", link.axes, link.inertia, link.axes)[stiff]
        damped = 0.5 * link.damping[stiff] / link.stiffness[stiff]
        step = min(step, float(np.maximum(damped, 0.1 * np.sqrt(about / link.stiffness[stiff])).min()))
    return float(f"{max(step, MIN_TIMESTEP):.1g}")
