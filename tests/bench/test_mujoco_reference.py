from __future__ import annotations

import numpy as np

from vinesim.bench import scenes as scenes
from vinesim.bench.mujoco_reference import MujocoScene
from vinesim.world import Physics


def test_the_mujoco_reference_of_the_contact_bench_has_the_same_contacts() -> None:
    """A bar lifts three canes, a gripper holds the bunch of a fourth: same number of contacts, same body positions."""
    model = scenes.cane_row(4)
    robots = [scenes.bar("bar", 0, 3), scenes.gripper("hand", scenes.bunch_center(3))]
    ours = Physics(model)
    reference = MujocoScene(model, robots)
    for robot in robots:
        ours.add_robot(robot)
    scenes.keep_awake(ours, np.arange(4))
    for tick in range(200):
        for world in (ours, reference):
            ramp = min(1.0, tick / 100)
            world.rigid.command("bar", np.array([0.08 * ramp]))
            world.rigid.command("hand", ramp * np.array([0.04, 0.05, 0.05]))
            world.step()
    assert len(ours.contacts) == reference.plant_contact_count() == 5
    reference_position = np.array([reference.data.body(f"plant/{b}").xpos for b in range(len(model.body_mass))])
    position = ours.state.body_q[:, :3]  # both at the start of the last step
    rest = model.forward_kinematics(model.joint_settled)[:, :3]
    assert np.abs(reference_position - rest).max() > 0.08
    np.testing.assert_allclose(position, reference_position, atol=0.01)  # MuJoCo's contacts yield by millimetres
    assert ours.plants.awake.tolist() == [0, 1, 2, 3]


def test_a_row_of_canes_rests_at_the_drawn_pose() -> None:
    model = scenes.cane_row(2)
    physics = scenes.keep_awake(Physics(model), np.arange(2))
    for _ in range(100):
        physics.step()
    drawn = model.forward_kinematics(model.joint_settled)
    np.testing.assert_allclose(physics.snapshot().body_q[:, :3], drawn[:, :3], atol=1e-4)
    np.testing.assert_allclose(
        drawn[model.bunch_body, :3] - [0, 0, 0.085], [scenes.bunch_center(0), scenes.bunch_center(1)], atol=1e-6
    )
