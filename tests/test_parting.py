"""From vine to hand: momentum, the grasp, the fall, and a peduncle that parts when pulled too hard."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from touch_scenes import bunch_scene, cane, grasp, gripper

from vinesim import frames
from vinesim.physics.step import Physics
from vinesim.world.grow import assemble
from vinesim.world.ids import Organ


def momentum(physics: Physics, name: str) -> np.ndarray:
    """Linear momentum [3] of one free body of the rigid world, kg m/s."""
    world, data = physics.rigid.world, physics.rigid.data
    mujoco.mj_fwdPosition(world, data)
    mujoco.mj_comVel(world, data)
    velocity, body = np.zeros(6), data.body(name).id
    mujoco.mj_objectVelocity(world, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
    lever = data.xipos[body] - data.xpos[body]
    return world.body_mass[body] * (velocity[3:] + np.cross(velocity[:3], lever))


def test_a_cut_bunch_keeps_its_momentum_and_falls():
    model, body, _ = bunch_scene()
    physics = Physics(model)
    physics.plants.wake(0)
    physics.state.joint_qd[body] = 0.3, -1.0, 2.0
    physics.state.joint_qd[4] = 0.0, 0.5, 0.3
    for _ in range(7):
        physics.step()
    physics.plants.kinematics()
    pose, velocity = physics.state.body_q[body].astype(float), physics.state.body_qd[body].astype(float)
    com = frames.rotate(pose[3:], model.body_com[body].astype(float))
    before = 0.5 * (velocity[:3] + np.cross(velocity[3:], com))
    physics.pick(0)
    np.testing.assert_allclose(momentum(physics, "loose/0"), before, atol=1e-6)
    assert np.linalg.norm(before) > 0.01
    view = physics.view()
    assert not view.bunch_attached[0]
    assert [(link.name, link.organ, link.index) for link in view.links] == [("bunch/0", Organ.BUNCH, 0)]
    np.testing.assert_allclose(view.link_q[0], view.body_q[body], atol=1e-5)
    height = view.link_q[0, 2]
    for _ in range(300):
        physics.step()
    assert physics.view().link_q[0, 2] < height - 1.0
    assert physics.view().link_q[0, 2] > 0.0
    with pytest.raises(ValueError, match="picked already"):
        physics.pick(0)


def test_the_vine_springs_up_without_its_bunch():
    model, body, _ = bunch_scene()
    physics = Physics(model)
    tip = body - 3
    low = physics.view().body_q[tip, 2]
    physics.pick(0)
    for _ in range(1500):
        physics.step()
    assert physics.view().body_q[tip, 2] > low + 0.05
    assert np.isfinite(physics.view().body_q).all()


def test_a_bunch_cut_in_the_grasp_stays_in_it():
    model, _, middle = bunch_scene()
    physics = Physics(model)
    physics.add_robot(gripper(middle))
    for tick in range(290):
        physics.rigid.command("grip", grasp(0.01 * tick)[0])
        physics.step()
    squeeze = physics.rigid.read("grip")[3][2]
    hand = physics.rigid.link_pose("grip", "hand")[2]
    physics.pick(0)
    start = physics.rigid.link_q()[-1, :3].copy()
    heights = []
    for _ in range(200):
        physics.step()
        heights.append(physics.view().link_q[-1, 2] - physics.rigid.link_pose("grip", "hand")[2])
    assert physics.rigid.read("grip")[3][2] == pytest.approx(squeeze, rel=0.02)
    assert abs(heights[-1] - heights[0]) < 1e-4  # over 2 s
    assert np.linalg.norm(physics.rigid.link_q()[-1, :3] - start) < 3e-3
    # the lift now carries the bunch's weight, which its peduncle no longer does
    assert physics.rigid.read("grip")[3][1] == pytest.approx(-0.5 * 9.81, rel=0.02)
    assert hand == pytest.approx(physics.rigid.link_pose("grip", "hand")[2], abs=3e-3)
    assert not physics.plants.state.bunch_attached[0]


def test_a_peduncle_parts_when_it_is_pulled_harder_than_it_holds():
    model, _, middle = bunch_scene()
    model.bunch_pull[0] = 12.0
    physics = Physics(model)
    physics.add_robot(gripper(middle, effort=80.0))
    picked_at, pulls = None, []
    for tick in range(400):
        target, _ = grasp(0.01 * min(tick, 130))
        target[1] = -0.002 * max(tick - 150, 0)  # down and down
        physics.rigid.command("grip", target)
        physics.step()
        pulls.append(float(np.linalg.norm(physics.plants.joint_wrench(model.bunch_body)[0, :3])))
        if physics.partings:
            picked_at = tick
            break
    assert picked_at is not None
    assert picked_at > 155
    assert min(pulls[-3:-1]) > 12.0  # the third tick too strong, after which it hangs no more
    assert max(pulls[:150]) < 12.0
    assert physics.rigid.loose == (0,)


def test_a_bunch_dropped_over_a_crate_ends_in_it():
    tree = cane((0.0, 0.0, 0.9), bunch=0.5)
    box = {"box_pose": [[1.0, 0.0, 0.001, 0, 0, 0, 1]], "box_size": [[0.6, 0.4, 0.3]], "box_mass": [[2.0]]}
    model = assemble([tree], **box)
    physics = Physics(model)
    for _ in range(20):
        physics.step()
    physics.pick(0)
    for _ in range(400):
        physics.step()
    links = {link.name: pose for link, pose in zip(physics.rigid.links(), physics.rigid.link_q(), strict=True)}
    bunch, crate = links["bunch/0"], links["box/0"]
    assert 0.0 < bunch[2] - crate[2] < 0.25
    assert np.abs(bunch[:2] - crate[:2]).max() < 0.3
    assert np.abs(physics.rigid.data.qvel).max() < 0.1
