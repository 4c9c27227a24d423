"""Rolling resistance of a bunch: its arm is that of the berries on which a bunch lies, and it holds on slopes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from tests.support.contact_scenes import DOWN
from vinesim.core import frames
from vinesim.scene import berry_packing
from vinesim.scene.berries import VARIETIES
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.ids import Organ
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.world import Physics

pytestmark = pytest.mark.slow


def arms_across(position: np.ndarray, radius: np.ndarray) -> list[float]:
    """Of each face on which balls can lie: how far their centre of mass may move across their x axis to either side
    until it is above the edge of the face, in the unit of ``position`` [ball, 3]."""
    weight = radius**3
    centre = weight @ position / weight.sum()
    hull = ConvexHull(position)
    arms = []
    for plane, corners in zip(hull.equations, position[hull.simplices], strict=True):
        normal = plane[:3]
        below = centre - normal * (normal @ centre + plane[3])
        distance = []
        outward = []
        for i in range(3):
            start, end, other = corners[i], corners[(i + 1) % 3], corners[(i + 2) % 3]
            out = np.cross(end - start, normal)
            out /= np.linalg.norm(out)
            out *= -np.sign(out @ (other - start))
            distance.append(float(out @ (start - below)))
            outward.append(out)
        if min(distance) > 0.0:
            across = np.cross(normal, [1.0, 0.0, 0.0])
            across /= np.linalg.norm(across)
            for way in (across, -across):
                arms.append(min(d / (out @ way) for d, out in zip(distance, outward, strict=True) if out @ way > 1e-9))
    return arms


def test_the_arm_is_that_of_packed_berries() -> None:
    """Of all packed bunches of table grapes with 60 to all berries, within 10 %."""
    means = []
    for variety in VARIETIES:
        if variety.style == "table":
            arms = []
            for bunch in berry_packing.prototypes("table"):
                for count in {min(len(bunch.radius), count) for count in (60, 90, 120, 1000)}:
                    arms += arms_across(np.asarray(bunch.position[:count]), np.asarray(bunch.radius[:count]))
            means.append(variety.volume_radius * np.mean(arms))
    assert len(means) > 1
    assert np.mean(means) == pytest.approx(PhysicsParameters().bunch_rolling_arm, rel=0.1)


def lying_bunch() -> Physics:
    """A bunch of 0.6 kg that was picked, fell a few centimetres, and lies on the ground."""
    tree = TreeBuilder(frames.pose(np.array([0.0, 0.0, 0.35])))
    last = tree.add_rod(-1, 0.3, (0.006, 0.006), RodMaterial(5e9, 800.0, 0.01), 4)[-1]
    wood = RodMaterial(3e8, 1000.0, 0.05)
    stalk = tree.add_rod(last, 0.06, (0.0022, 0.0022), wood, 2, organ=Organ.PEDUNCLE, rest=DOWN)
    tree.add_bunch(stalk[-1], 0.6, count=100, seed=4, pull=1e4, bend=1e4)
    tree.solve_rest_pose()
    physics = Physics(assemble([tree]))
    physics.pick(0)
    pull_towards(physics, 12.0, 0.1, 30)
    pull_towards(physics, 0.0, 0.0, 400)
    return physics


def pull_towards(physics: Physics, slope: float, heading: float, steps: int) -> None:
    """Turn gravity so that the ground is a slope [degrees] that falls towards ``heading`` [rad], and step."""
    slope = np.radians(slope)
    down = [np.sin(slope) * np.cos(heading), np.sin(slope) * np.sin(heading), -np.cos(slope)]
    physics.rigid.mj_model.opt.gravity[:] = 9.81 * np.array(down)
    physics.rigid.mj_data.qvel[:] += 1e-4  # nothing sleeps
    for _ in range(steps):
        physics.step()


def test_a_bunch_lies_on_a_slope_of_eight_degrees_and_leaves_one_of_twenty() -> None:
    """In three directions: it settles by less than 15 mm on the first slope, and rolls down the second at least in one.

    With an arm of 4 mm it moved by 30 mm on a slope of 8 degrees.
    """
    settled = []
    left = []
    for heading in (0.0, 1.05, 2.1):
        physics = lying_bunch()
        start = physics.rigid.visual_q()[:, :3].copy()
        pull_towards(physics, 8.0, heading, 300)
        settled.append(np.abs(physics.rigid.visual_q()[:, :3] - start).max())
        pull_towards(physics, 20.0, heading, 300)
        left.append(np.abs(physics.rigid.visual_q()[:, :3] - start).max())
    assert max(settled) < 0.015
    assert max(left) > 0.5
