"""MuJoCo's world without actors (ground, trellis, wood and crates), and the collision bits of all rigid bodies."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from vinesim.core import frames
from vinesim.scene.materials import Material, materials_of_organs
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.terrain import Terrain, tilt
from vinesim.scene.values import RigidBox, Shape

CRATE_WALL = 0.012
"""Thickness [m] of a crate's bottom and walls. GUESSED."""
MIN_STATIC_RADIUS = 0.006
"""Smallest radius [m] of fixed pieces in contacts with rigid bodies; thinner pieces are treated as this thick. TUNED: a
body at 0.5 m/s moves 5 mm in a step. If the axis of a wire were inside a box, MuJoCo would push the box along the wire.
"""
CRATE_BED_DEPTH = 0.08
"""Thickness [m] of a crate's bottom in contacts with free bunches. DERIVED: a bunch that has fallen a metre moves 4 cm
in a step; a bottom of the visible thickness would push it out below."""
CRATE_COLOR = (0.75, 0.15, 0.12, 1.0)

FIRST_FIXED_GEOM = 1
"""MuJoCo's number of the geom of the first fixed piece (piece of a pole, wire, trunk or arm). The geoms of the other
pieces follow; the ground has number 0.
"""

HEIGHT_FIELD_DEPTH = 1.0
"""Thickness [m] of the ground below the lowest point of MuJoCo's height field. Its surface alone matters."""
OUTER_PLANE_RISE = 0.02
"""Height [m] of the plane beyond the height field above its highest point, so that MuJoCo reports all that is near the
ground there."""

GROUND, FIXED, BOX, CRATE_FLOOR, FREE_BUNCH, REMOTE_HAND = (1 << bit for bit in range(6))
"""Collision bits. Free bunches collide with the thick bed of a crate, all other bodies with its thin floor. Robots do
not collide with hands of remote people, because the person's own client computes the forces of the hands."""
_ROBOT_BITS = range(6, 18)
_HUMAN_BITS = range(18, 31)
ROBOTS = sum(1 << bit for bit in _ROBOT_BITS)
"""Mask of all collision bits that are used in the codes of robots (:data:`ROBOT_CODES`)."""
HUMANS = sum(1 << bit for bit in _HUMAN_BITS)
"""Mask of all collision bits that are used in the codes of people (:data:`HUMAN_CODES`)."""
ALL_BITS = (1 << (_HUMAN_BITS[-1] + 1)) - 1
_CODE_WEIGHT = 6


def _codes(bits: range) -> tuple[int, ...]:
    return tuple(sum(1 << bit for bit in code) for code in itertools.combinations(bits, _CODE_WEIGHT))


ROBOT_CODES = _codes(_ROBOT_BITS)
"""Collision codes of robots. Each actor has its own code, so that it collides with all other actors, and with itself
only if requested.

MuJoCo lets two geoms collide if ``contype`` of one and ``conaffinity`` of the other share a bit. An actor has its code
as ``contype`` and all other bits in ``conaffinity``; a robot that collides with itself has its code there, too. All
codes have six bits, so each code has a bit that any other code lacks. The 25 bits give codes for 924 robots and 1716
people; one bit for each actor would allow only 25 actors.
"""
HUMAN_CODES = _codes(_HUMAN_BITS)
"""Collision codes of people, see :data:`ROBOT_CODES`."""


def contact_friction(coefficient: float, rolling_arm: float = 0.0001) -> list[float]:
    """Returns MuJoCo's friction of a geom: sliding [1], torsional [m] (used from condim 4), rolling [m] (condim 6)."""
    return [coefficient, 0.005, rolling_arm]


def geom_user(material: int, *, has_own_friction: bool = False) -> list[float]:
    """Returns the user data of a geom: its :class:`Material`, and whether it uses its own friction coefficient in all
    contacts."""
    return [float(material), float(has_own_friction)]


def boxes_of(model: Model) -> dict[int, RigidBox]:
    """Returns the boxes of a generated scene, by number."""
    rows = zip(model.box_pose.astype(float), model.box_size.astype(float), model.box_mass.tolist(), strict=True)
    return {number: RigidBox(*row) for number, row in enumerate(rows)}


def build_static_world(
    model: Model, parameters: PhysicsParameters, boxes: Mapping[int, RigidBox] | None = None
) -> mujoco.MjSpec:
    """Returns the specification of a world with ground, poles, wires, trunks, arms and crates, and MuJoCo's options.

    ``boxes``: the crates by number; by default those of the model.
    """
    spec = mujoco.MjSpec()
    _set_options(spec, parameters)
    spec.nuser_geom = len(geom_user(Material.UNKNOWN))
    friction = contact_friction(parameters.friction)
    ground: dict[str, Any] = {
        "contype": GROUND,
        "conaffinity": BOX | CRATE_FLOOR | FREE_BUNCH,
        "friction": friction,
        "userdata": geom_user(Material.SOIL),
    }
    if model.terrain is None:
        spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], **ground)
    else:
        _add_height_field(spec, model.terrain, ground)
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
    if model.terrain is not None:
        _add_outer_plane(spec, model.terrain, ground)
    for number, box in (boxes_of(model) if boxes is None else boxes).items():
        turn = frames.to_wxyz(frames.normalize(box.pose[3:]))
        body = spec.worldbody.add_body(name=f"box/{number}", pos=box.pose[:3], quat=turn)
        body.add_freejoint(name=f"box/{number}")
        _add_crate(body, box.size, box.mass, friction)
    return spec


def _add_height_field(spec: mujoco.MjSpec, terrain: Terrain, ground: dict[str, Any]) -> None:
    """Add the uneven ground as a height field, whose cells MuJoCo divides into the same triangles as ``terrain``."""
    heights = terrain.nodes()
    low = float(heights.min())
    rise = max(float(heights.max()) - low, 1e-3)
    half = 0.5 * (np.array(terrain.end) - terrain.origin)
    middle = 0.5 * (np.array(terrain.end) + terrain.origin)
    spec.add_hfield(
        name="ground",
        nrow=heights.shape[0],
        ncol=heights.shape[1],
        size=[*half, rise, HEIGHT_FIELD_DEPTH],
        userdata=((heights - low) / rise).ravel().tolist(),
    )
    kind = mujoco.mjtGeom.mjGEOM_HFIELD
    spec.worldbody.add_geom(name="ground", type=kind, hfieldname="ground", pos=[*middle, low], **ground)


def _add_outer_plane(spec: mujoco.MjSpec, terrain: Terrain, ground: dict[str, Any]) -> None:
    """Add an inclined plane above the highest point of the ground. It only tells which bodies may touch the ground
    beyond the height field; their contacts are computed by :mod:`vinesim.rigid.ground_contacts`."""
    along, across = terrain.slope
    spec.worldbody.add_geom(
        name="outer ground",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 1],
        pos=[0.0, 0.0, float(terrain.residual.max()) + OUTER_PLANE_RISE],
        quat=frames.to_wxyz(tilt(0.0, along, across)),
        rgba=[0.0, 0.0, 0.0, 0.0],  # invisible, so that rays pass
        **ground,
    )


def _set_options(spec: mujoco.MjSpec, parameters: PhysicsParameters) -> None:
    spec.compiler.degree = False
    spec.option.timestep = parameters.dt
    spec.option.gravity = [0.0, 0.0, -parameters.gravity]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    # with less, a bunch creeps through the fingers; MuJoCo's noslip stage would prevent it, but then piles never rest
    spec.option.impratio = 1000.0
    # one invalid number must not reset the whole world; RigidWorld.integrate() stops only the tree concerned
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    # boxes and bunches at rest cost no time; robots are driven and never sleep
    spec.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)


def _add_crate(body: mujoco.MjsBody, size: np.ndarray, mass: float, friction: list[float]) -> None:
    """Add the geoms of a crate of outer ``size`` [3] m and ``mass`` [kg]; the mass is distributed by volume."""
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
    """Returns the bottom and four walls of an open box of outer ``size`` [3] m; the origin is in the middle of the
    underside."""
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
