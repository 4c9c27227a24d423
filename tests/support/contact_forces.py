"""Weights of objects, from the contact forces under them."""

from __future__ import annotations

import mujoco
import numpy as np

from vinesim.physics.step import Physics


def pressed_on_ground(physics: Physics, box: int) -> float:
    """Upward force of the ground on a box [N], from MuJoCo's own contacts: its weight, with all that lies in it."""
    world, data = physics.rigid.mj_model, physics.rigid.mj_data
    ground, body = world.geom("ground").id, world.body(f"box/{box}").id
    total = 0.0
    for i, geoms in enumerate(data.contact.geom):
        if ground in geoms and body in world.geom_bodyid[geoms]:
            force = np.zeros(6)
            mujoco.mj_contactForce(world, data, i, force)
            total += abs(data.contact.frame[i].reshape(3, 3)[:, 2] @ force[:3])
    return total
