"""Support of objects: parents by contact, rest after half a second without motion in the parent's frame."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.shared_vineyard import BOX, BUNCH, cart, vineyard
from vinesim.core import frames
from vinesim.interaction.support_tracking import SupportTracker
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.world import Physics

DECK = frames.pose([0.0, 0.0, 0.253])


def run(physics: Physics, ticks: int, robot: Robot | None = None, speed: float = 0.0) -> None:
    for _ in range(ticks):
        if robot is not None:
            robot.command_base(speed, 0.0, physics.time)
            robot.control(physics.time)
        physics.step()
        physics.support_tracker.update()


def settle(physics: Physics, limit: int = 800, robot: Robot | None = None) -> None:
    run(physics, 2, robot)
    for _ in range(limit):
        run(physics, 1, robot)
        if not physics.support_tracker.moving:
            return
    pytest.fail("not at rest in time")


def place_in_box(physics: Physics, bunch: int = 0, box: int = 0) -> None:
    physics.pick(bunch)
    pose_in_box = frames.compose(physics.support_tracker.object_state(BOX(box))[0], frames.pose([-0.1, 0.0, 0.07]))
    physics.rigid.place_bunch(bunch, pose_in_box, np.zeros(6))


def test_boxes_start_at_rest_and_a_picked_bunch_moves_until_it_rests():
    physics = Physics(vineyard())
    run(physics, 5)
    assert physics.support_tracker.object_ids.tolist() == [BOX(0), BOX(1)]
    assert physics.support_tracker.moving == []
    physics.pick(0)
    run(physics, 1)
    assert physics.support_tracker.moving == [BUNCH(0)]
    settle(physics)
    assert physics.support_tracker.pose_on_support(BUNCH(0))[0] == ""
    np.testing.assert_allclose(
        physics.support_tracker.pose_on_support(BUNCH(0))[1],
        physics.support_tracker.object_state(BUNCH(0))[0],
        atol=1e-12,
    )


def test_a_bunch_in_a_moving_box_is_at_rest_in_its_frame():
    physics = Physics(vineyard())
    place_in_box(physics)
    settle(physics)
    parent, relative = physics.support_tracker.pose_on_support(BUNCH(0))
    assert parent == "box/0"
    # the box is moved with its contents in small steps
    for _ in range(150):
        for number in (BOX(0), BUNCH(0)):
            pose = physics.support_tracker.object_state(number)[0]
            pose[1] += 0.002
            physics.support_tracker.set_state(number, pose, np.zeros(6))
        run(physics, 1)
    assert physics.support_tracker.moving == [BOX(0)]
    settle(physics)
    moved = physics.support_tracker.pose_on_support(BUNCH(0))[1] - relative
    np.testing.assert_allclose(moved[[0, 1, 3, 4, 5, 6]], 0.0, atol=1e-6)
    assert abs(moved[2]) < 3e-3  # moved in each step, it penetrates the bottom differently than at rest
    pose, _ = physics.support_tracker.to_world("box/0", physics.support_tracker.pose_on_support(BUNCH(0))[1])
    np.testing.assert_allclose(pose[:3], physics.support_tracker.object_state(BUNCH(0))[0][:3], atol=1e-9)


def test_a_box_on_a_robot_rests_in_the_frame_of_its_link():
    physics = Physics(vineyard())
    robot = Robot(physics.rigid, cart(), "anna", pose=frames.pose([-5.0, -3.0, 0.0]))
    physics.support_tracker.set_state(BOX(0), frames.compose(physics.rigid.base_state("anna")[0], DECK), np.zeros(6))
    place_in_box(physics)
    settle(physics, robot=robot)
    assert physics.support_tracker.pose_on_support(BOX(0))[0] == "anna/base_footprint"
    assert physics.support_tracker.pose_on_support(BUNCH(0))[0] == "box/0"
    for _ in range(100):
        run(physics, 1, robot, 0.5)
        assert physics.support_tracker.moving == []
    pose, velocity = physics.support_tracker.to_world(
        "anna/base_footprint", physics.support_tracker.pose_on_support(BOX(0))[1]
    )
    here, speed = physics.support_tracker.object_state(BOX(0))
    np.testing.assert_allclose(pose[:3], here[:3], atol=1e-6)
    np.testing.assert_allclose(velocity[:3], speed[:3], atol=0.02)
    assert here[0] > -4.8
    # its parent leaves with the robot
    physics.remove_robot("anna")
    run(physics, 1)
    assert BOX(0) in physics.support_tracker.moving
    settle(physics)
    assert physics.support_tracker.pose_on_support(BOX(0))[0] == ""
    assert physics.support_tracker.object_state(BOX(0))[0][2] < 0.05


def test_touched_objects_and_their_actors_are_reported():
    physics = Physics(vineyard())
    robot = Robot(physics.rigid, cart(), "anna", pose=frames.pose([-2.72, 0.0, 0.0]))
    run(physics, 20, robot)
    assert physics.support_tracker.touched == []
    touched = set()
    for _ in range(100):
        run(physics, 1, robot, 0.3)
        touched.update(physics.support_tracker.touched)
    assert touched == {(BOX(0), "anna")}
    assert physics.support_tracker.pose_on_support(BOX(0))[0] == "", "a box pushed along the ground has no support"


def test_an_object_rests_after_half_a_second_or_at_once_by_a_record():
    physics = Physics(vineyard())
    tracker: SupportTracker = physics.support_tracker
    rest_steps = physics.parameters.steps(physics.parameters.support_rest_duration)
    tracker.set_state(BOX(0), frames.pose([-2.0, 0.5, 0.001]), np.zeros(6))
    run(physics, 1)
    assert tracker.moving == [BOX(0)]
    ticks = next(i for i in range(2 * rest_steps) if run(physics, 1) or not tracker.moving)
    assert rest_steps - 5 <= ticks <= rest_steps + 10
    tracker.set_state(BOX(1), frames.pose([-2.0, 1.5, 0.0]), np.zeros(6))
    tracker.set_at_rest(BOX(1), "", frames.pose([-2.0, 1.5, 0.0]))
    run(physics, 1)
    assert tracker.moving == []
    tracker.set_moving([BOX(0)])
    assert tracker.moving == [BOX(0)]


def test_a_remote_object_is_blended_and_a_distant_one_placed():
    physics = Physics(vineyard())
    tracker = physics.support_tracker
    start = physics.support_tracker.object_state(BOX(0))[0]
    offset = np.array([0.1, 0.0, 0.2, 0, 0, 0, 0])
    speed = np.array([0.3, 0, 0, 0, 0, 0.1])
    goal = start + offset
    far = start + 20.0 * offset
    tracker.blend_towards([BOX(0)], goal[None], speed[None], np.array([0.2]))
    pose, velocity = tracker.object_state(BOX(0))
    np.testing.assert_allclose(pose[:3], start[:3] + 0.2 * (goal - start)[:3], atol=1e-12)
    np.testing.assert_allclose(velocity, speed, atol=1e-12)
    tracker.blend_towards([BOX(0)], far[None], speed[None], np.array([0.2]))
    np.testing.assert_allclose(tracker.object_state(BOX(0))[0][:3], far[:3], atol=1e-12)


def test_a_remote_object_is_not_pressed_into_what_stops_it():
    """The owner's state is older than the contact: it still falls at 4 m/s, and is below the ground by now. What leads
    away from the ground and along it applies."""
    physics = Physics(vineyard())
    tracker = physics.support_tracker
    tracker.set_state(BOX(0), frames.pose([-2.0, 0.5, 0.0]), np.zeros(6))
    run(physics, 10)
    start = tracker.object_state(BOX(0))[0]
    goal = start + np.array([0.02, 0.0, -0.04, 0, 0, 0, 0])
    for _ in range(10):
        falls = np.array([0.3, 0, -4.0, 0, 0, 0])
        tracker.blend_towards([BOX(0)], goal[None], falls[None], np.array([0.2]))
        pose, velocity = tracker.object_state(BOX(0))
        assert velocity[0] == 0.3
        assert velocity[2] > -0.1
        run(physics, 1)
        assert abs(tracker.object_state(BOX(0))[0][2] - start[2]) < 5e-3
    assert pose[0] > start[0] + 0.015
    tracker.blend_towards([BOX(0)], (start + 0.05)[None], np.array([[0, 0, 1.0, 0, 0, 0]]), np.array([0.2]))
    pose, velocity = tracker.object_state(BOX(0))
    assert pose[2] > start[2] + 0.008
    assert velocity[2] == 1.0


def test_a_new_bunch_can_be_set_moving_at_once():
    """The first free bunch of a world without boxes is known in the tick in which it is picked remotely."""
    tree = TreeBuilder(frames.pose(np.array([0.5, 0.0, 1.5])))
    tree.add_bunch(tree.add_rod(-1, 0.6, (0.006, 0.004), RodMaterial(2e9, 900.0), 6)[-1], 0.4, clusters=False)
    physics = Physics(assemble([tree]))
    physics.support_tracker.update()
    physics.apply_remote_pick(0, frames.pose([0.5, 0.0, 1.0]), np.zeros(6))
    physics.support_tracker.set_moving([BUNCH(0)])
    physics.support_tracker.update()
    assert BUNCH(0) in physics.support_tracker.moving
