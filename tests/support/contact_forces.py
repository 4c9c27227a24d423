"""Contact forces on robot links and weights of objects, and a ramp of commands."""

from __future__ import annotations

import mujoco
import numpy as np

from vinesim.world import Physics


def pressed_on_ground(physics: Physics, box: int) -> float:
    """Upward force of the ground on a box [N], from MuJoCo's own contacts: its weight and that of its contents."""
    world = physics.rigid.mj_model
    data = physics.rigid.mj_data
    ground = world.geom("ground").id
    body = world.body(f"box/{box}").id
    total = 0.0
    for i, geoms in enumerate(data.contact.geom):
        if ground in geoms and body in world.geom_bodyid[geoms]:
            force = np.zeros(6)
            mujoco.mj_contactForce(world, data, i, force)
            total += abs(data.contact.frame[i].reshape(3, 3)[:, 2] @ force[:3])
    return total


def force_on(physics: Physics, link: str) -> np.ndarray:
    """[3] N of all contacts with plants on the robot links of this name in the last step."""
    return sum((c.force for c in physics.contacts if c.link == link), np.zeros(3))


def ramp(t: float, start: float, end: float) -> float:
    """0 before ``start``, 1 after ``end``, and linear between."""
    return float(np.clip((t - start) / (end - start), 0.0, 1.0))
