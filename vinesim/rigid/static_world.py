"""The static world as MuJoCo sees it: ground, trellis, wood and crates; and the collision bits of all that is rigid."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import mujoco
import numpy as np

from vinesim.core import frames
from vinesim.scene.materials import Material, materials_of_organs
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.values import RigidBox, Shape

CRATE_WALL = 0.012
"""[m] Thickness of a crate's bottom and walls. GUESSED."""
MIN_STATIC_RADIUS = 0.006
"""[m] Thinner pieces act on rigid bodies as if they were as thick. TUNED: what moves at 0.5 m/s is 5 mm deeper after a
step; with the axis of a wire inside a box, MuJoCo would push the box along the wire's sides instead of off it."""
CRATE_BED_DEPTH = 0.08
"""[m] Depth to which a crate's bottom continues for free bunches alone. DERIVED: a bunch that falls a metre is 4 cm
deeper after a step; in the middle of a bottom as thin as it looks it would be pushed out below."""
CRATE_COLOR = (0.75, 0.15, 0.12, 1.0)

FIRST_FIXED_GEOM = 1
"""MuJoCo's number of the geom of the first fixed piece; the ground has 0, and the other pieces follow."""

GROUND, FIXED, BOX, CRATE_FLOOR, FREE_BUNCH, REMOTE_HAND = (1 << bit for bit in range(6))
"""Collision bits. Free bunches touch the deep bed of a crate, all others its thin floor. Robots do not touch hands of
remote people: the person's own client computes with what force they push."""
_ROBOT_BITS = range(6, 18)
_HUMAN_BITS = range(18, 31)
ROBOTS = sum(1 << bit for bit in _ROBOT_BITS)
HUMANS = sum(1 << bit for bit in _HUMAN_BITS)
"""Collision bits that codes of robots and of people consist of."""
ALL_BITS = (1 << (_HUMAN_BITS[-1] + 1)) - 1
_CODE_WEIGHT = 6


def _codes(bits: range) -> tuple[int, ...]:
    return tuple(sum(1 << bit for bit in code) for code in itertools.combinations(bits, _CODE_WEIGHT))


ROBOT_CODES = _codes(_ROBOT_BITS)
HUMAN_CODES = _codes(_HUMAN_BITS)
"""Collision codes: each actor has one of its own, so that it touches all others, and itself only where that is wanted.

MuJoCo lets two geoms touch if ``contype`` of one and ``conaffinity`` of the other share a bit. An actor has its code
as ``contype`` and all other bits in ``conaffinity``; a robot that touches itself has its code there, too. Codes of one
kind all have six bits, so none contains another: each has a bit that the other has not. 31 bits thus tell 924 robots
and 1716 people apart; a bit for each would do for 25.
"""


def contact_friction(coefficient: float, rolling_arm: float = 0.0001) -> list[float]:
    """Friction of a geom as MuJoCo takes it: sliding [1], torsional [m] and rolling [m]; the last two need condim 4,
    6."""
    return [coefficient, 0.005, rolling_arm]


def geom_user(material: int, *, has_own_friction: bool = False) -> list[float]:
    """User data of a geom: its :class:`Material`, and whether its friction is its own, whatever it touches."""
    return [float(material), float(has_own_friction)]


def boxes_of(model: Model) -> dict[int, RigidBox]:
    """The boxes of a scene as generated, by number."""
    rows = zip(model.box_pose.astype(float), model.box_size.astype(float), model.box_mass.tolist(), strict=True)
    return {number: RigidBox(*row) for number, row in enumerate(rows)}


def build_static_world(
    model: Model, parameters: PhysicsParameters, boxes: Mapping[int, RigidBox] | None = None
) -> mujoco.MjSpec:
    """A world with ground, poles, wires, trunks, arms and crates, and MuJoCo's options.

    ``boxes``: the crates by number; those of the model unless given.
    """
    spec = mujoco.MjSpec()
    _set_options(spec, parameters)
    spec.nuser_geom = len(geom_user(Material.UNKNOWN))
    friction = contact_friction(parameters.friction)
    spec.worldbody.add_geom(
        name="ground",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 1],
        contype=GROUND,
        conaffinity=BOX | CRATE_FLOOR | FREE_BUNCH,
        friction=friction,
        userdata=geom_user(Material.SOIL),
    )
    radius = model.fixed_radius.mean(1)
    material = materials_of_organs(model.fixed_organ)
    for piece in range(len(radius)):
        spec.worldbody.add_geom(
            name=f"fixed/{piece}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=np.concatenate([model.fixed_start[piece], model.fixed_end[piece]]).astype(float),
            size=[float(radius[piece]), 0, 0],
            contype=FIXED,
            conaffinity=0,
            friction=friction,
            margin=max(MIN_STATIC_RADIUS - float(radius[piece]), 0.0),
            userdata=geom_user(material[piece]),
        )
    for number, box in (boxes_of(model) if boxes is None else boxes).items():
        turn = frames.to_wxyz(frames.normalize(box.pose[3:]))
        body = spec.worldbody.add_body(name=f"box/{number}", pos=box.pose[:3], quat=turn)
        body.add_freejoint(name=f"box/{number}")
        _add_crate(body, box.size, box.mass, friction)
    return spec


def _set_options(spec: mujoco.MjSpec, parameters: PhysicsParameters) -> None:
    spec.compiler.degree = False
    spec.option.timestep = parameters.dt
    spec.option.gravity = [0.0, 0.0, -parameters.gravity]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    # less, and a bunch creeps through the fingers; MuJoCo's noslip stage would hold it too, but piles never rest then
    spec.option.impratio = 1000.0
    # one invalid number must not reset the whole world: RigidWorld.integrate() stops the tree that it belongs to
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    # boxes and bunches at rest cost nothing; robots, being driven, never sleep
    spec.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)


def _add_crate(body: mujoco.MjsBody, size: np.ndarray, mass: float, friction: list[float]) -> None:
    """Add the geoms of a crate of outer ``size`` [3] m and ``mass`` [kg], which its walls share by volume."""
    walls = crate_shapes(size)
    volume = [float(np.prod(wall.size)) for wall in walls]
    for wall, share in zip(walls, volume, strict=True):
        is_floor = wall is walls[0]
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=wall.size,
            pos=wall.pose[:3],
            friction=friction,
            mass=mass * share / sum(volume),
            contype=CRATE_FLOOR if is_floor else BOX,
            conaffinity=ALL_BITS & ~FREE_BUNCH if is_floor else ALL_BITS,
            userdata=geom_user(Material.PLASTIC),
        )
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[*walls[0].size[:2], CRATE_BED_DEPTH / 2],
        pos=[0.0, 0.0, CRATE_WALL - CRATE_BED_DEPTH / 2],
        friction=friction,
        mass=0.0,
        contype=0,
        conaffinity=FREE_BUNCH,
        userdata=geom_user(Material.PLASTIC),
    )


def crate_shapes(size: np.ndarray) -> tuple[Shape, ...]:
    """Bottom and four walls of an open box of outer ``size`` [3] m, origin in the middle of its underside."""
    length, width, height = (float(s) / 2 for s in size)
    t = CRATE_WALL / 2
    walls = [
        ((length, width, t), (0.0, 0.0, t)),
        ((length, t, height - t), (0.0, width - t, height + t)),
        ((length, t, height - t), (0.0, t - width, height + t)),
        ((t, width - 2 * t, height - t), (length - t, 0.0, height + t)),
        ((t, width - 2 * t, height - t), (t - length, 0.0, height + t)),
    ]
    return tuple(Shape("box", half, frames.pose(np.array(at)), CRATE_COLOR) for half, at in walls)
