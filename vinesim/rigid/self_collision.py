"""Which links of a robot touch each other, and which shapes the ground.

Links on both sides of a joint never touch; MuJoCo leaves those out by itself. Links that overlap while the robot stands
in its home pose do so by the shape that their collision hulls were given, not by their motion: such pairs are left out,
as MoveIt's Setup Assistant does. So are the pairs of the ``disable_collisions`` elements that an SRDF file gives.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import mujoco
import numpy as np

from vinesim.rigid.recompile import compile_without_contacts
from vinesim.rigid.static_world import GROUND
from vinesim.scene.values import RobotSpec

HOME_CLEARANCE = 1e-3
"""[m] Links that are nearer than this to each other, or to the ground, in the home pose count as overlapping. GUESSED:
collision shapes are as exact, and servos hold the pose to that."""


def let_links_collide(parsed: mujoco.MjSpec, given: RobotSpec, code: int) -> None:
    """Let the links of a ``parsed`` robot touch each other and the ground; ``code``: its collision code.

    Shapes that are fixed to the base do not touch the ground: the base moves in a plane at its own height.
    """
    alone = parsed.copy()
    for number, geom in enumerate(alone.geoms):
        geom.name = str(number)
        geom.contype = geom.conaffinity = 1
        geom.margin = HOME_CLEARANCE
    ground = alone.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], pos=[0.0, 0.0, -float(given.pose[2])]
    )
    ground.contype = ground.conaffinity = 1
    m = compile_without_contacts(alone)
    geoms = _touching_at_home(m, given)
    bodies = m.geom_bodyid[geoms]
    on_ground = m.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_PLANE
    for row in np.unique(np.sort(bodies[~on_ground.any(1)], axis=1), axis=0).tolist():
        parsed.add_exclude(bodyname1=m.body(row[0]).name, bodyname2=m.body(row[1]).name)
    links = {link.name for link in parsed.bodies}
    for pair in disabled_pairs(given.urdf):
        if links.issuperset(pair):
            parsed.add_exclude(bodyname1=pair[0], bodyname2=pair[1])
    standing = set(geoms[on_ground.any(1)].ravel().tolist())
    for number, geom in enumerate(parsed.geoms):
        geom.conaffinity |= code
        compiled = m.geom(str(number))
        if m.body_weldid[compiled.bodyid[0]] != 0 and compiled.id not in standing:
            geom.conaffinity |= GROUND


def disabled_pairs(urdf: str) -> list[tuple[str, str]]:
    """Pairs of links in the elements ``disable_collisions`` of a URDF, where loading puts those of an SRDF."""
    root = ElementTree.fromstring(urdf)
    return [(pair.get("link1", ""), pair.get("link2", "")) for pair in root.findall("disable_collisions")]


def _touching_at_home(m: mujoco.MjModel, given: RobotSpec) -> np.ndarray:
    """Geoms [pair, 2] that touch in the home pose; ``m``: the robot alone, with its base fixed."""
    d = mujoco.MjData(m)
    for drive, position in zip(given.drives, given.home, strict=True):
        d.joint(drive.joint).qpos[0] = position
    for e in np.flatnonzero(m.eq_type == mujoco.mjtEq.mjEQ_JOINT).tolist():
        polynomial = np.polynomial.Polynomial(m.eq_data[e, :5])
        d.qpos[m.jnt_qposadr[m.eq_obj1id[e]]] = polynomial(d.qpos[m.jnt_qposadr[m.eq_obj2id[e]]])
    mujoco.mj_kinematics(m, d)
    mujoco.mj_comPos(m, d)
    mujoco.mj_collision(m, d)
    return d.contact.geom.reshape(-1, 2).copy()
