"""What stands in a vineyard and the crates that lie in it, as MuJoCo is told; and who meets whom: collision bits."""

from __future__ import annotations

import mujoco
import numpy as np

from vinesim import frames
from vinesim.physics.parameters import PhysicsParameters
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.values import Shape

FRICTION = 0.8
"""Coulomb coefficient of rubber pads, plastic crates and bark alike."""
ROUGH = [FRICTION, 0.005, 0.0001]
"""The same as MuJoCo wants it: sliding, and its own spinning and rolling, which count in contacts that ask for them."""
CRATE_WALL = 0.012
"""Thickness of a picking box's bottom and walls [m]."""
CRATE_BED_DEPTH = 0.08
"""[m] How far down a crate's bottom goes on for bunches alone. One that falls a metre is four centimetres deeper
after a tick: in the middle of a bottom as thin as it looks, it would be pushed out below.
"""

# what stands, what lies about, and one bit for each actor, so that a robot never meets itself; loose bunches meet the
# thick bed of a crate where all others meet its thin sole; hands of people whom other clients move are guests, whom
# robots do not meet: with what force they push robots is their own clients' to say
GROUND, FIXED, BOX, CRATE_FLOOR, FREE_BUNCH, REMOTE_HAND = (1 << bit for bit in range(6))
FIRST_ACTOR, LAST_ACTOR = 6, 30
"""Positions of the bits of robots and people."""
ALL_BITS = (1 << (LAST_ACTOR + 1)) - 1


def build_static_world(model: Model, parameters: PhysicsParameters) -> mujoco.MjSpec:
    """Ground, poles, trunks and boxes."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = parameters.dt
    spec.option.gravity = [0.0, 0.0, -parameters.gravity]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    # less, and a bunch creeps through the fingers; MuJoCo's noslip stage would hold it too, but piles never rest then
    spec.option.impratio = 1000.0
    # one bad number must not reset the whole world: finish() stops what it belongs to
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    # boxes and bunches that lie still cost nothing; robots, being driven, never sleep
    spec.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    spec.worldbody.add_geom(
        name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=GROUND,
        conaffinity=BOX | CRATE_FLOOR | FREE_BUNCH,
        friction=ROUGH,
    )  # fmt: skip
    thickness = model.fixed_radius.mean(1)
    for piece in np.flatnonzero(np.isin(model.fixed_organ, [Organ.POLE, Organ.TRUNK])):
        spec.worldbody.add_geom(
            name=f"fixed/{piece}", type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=np.concatenate([model.fixed_start[piece], model.fixed_end[piece]]).astype(float),
            size=[float(thickness[piece]), 0, 0], contype=FIXED, conaffinity=0, friction=ROUGH,
        )  # fmt: skip
    for box, pose in enumerate(model.box_pose.astype(float)):
        body = spec.worldbody.add_body(name=f"box/{box}", pos=pose[:3], quat=frames.to_wxyz(frames.normalize(pose[3:])))
        body.add_freejoint(name=f"box/{box}")
        walls = crate_shapes(model.box_size[box])
        volume = [float(np.prod(wall.size)) for wall in walls]
        for wall, share in zip(walls, volume, strict=True):
            sole = wall is walls[0]
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX, size=wall.size, pos=wall.pose[:3], friction=ROUGH,
                mass=float(model.box_mass[box]) * share / sum(volume), contype=CRATE_FLOOR if sole else BOX,
                conaffinity=ALL_BITS & ~FREE_BUNCH if sole else ALL_BITS,
            )  # fmt: skip
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=[*walls[0].size[:2], CRATE_BED_DEPTH / 2], pos=[0.0, 0.0, CRATE_WALL - CRATE_BED_DEPTH / 2],
            friction=ROUGH, mass=0.0, contype=0, conaffinity=FREE_BUNCH,
        )  # fmt: skip
    return spec


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
    return tuple(Shape("box", half, frames.pose(np.array(at)), (0.75, 0.15, 0.12, 1.0)) for half, at in walls)
