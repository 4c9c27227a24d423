"""A person moved by tracked points: they are reached evenly, hands without a controller hang, feet follow."""

import numpy as np
import pytest

from vinesim.avatar import leg_estimator
from vinesim.avatar.gestures import FIST, OPEN_HAND, shears_grip
from vinesim.avatar.tracked_human import TrackedHuman, TrackedPoints
from vinesim.core import frames

DT = 0.01
ROOT = frames.pose(np.array([1.0, 2.0, 0.0]), frames.from_yaw(0.5))


@pytest.fixture
def human():
    return TrackedHuman(ROOT, 1.75, DT)


def test_without_input_it_stands_still(human):
    before = human.pose.points
    for step in range(50):
        np.testing.assert_allclose(human(step * DT).points[1:], before[1:], atol=1e-9)


def test_inputs_at_the_rate_of_a_display_give_the_velocity_of_the_person(human):
    """A hand that moves at 1 m/s, told 50 times a second, moves at 1 m/s in every step once the rate is known."""
    start = human.pose.right.copy()
    head = human.pose.head
    places = []
    for step in range(200):
        if step % 2 == 0:
            hand = start.copy()
            hand[0] += step * DT
            human.take(TrackedPoints(head, None, hand))
        places.append(human(step * DT).right[0])
    speed = np.diff(places[60:]) / DT
    np.testing.assert_allclose(speed, 1.0, atol=0.02)
    assert start[0] + 199 * DT - places[-1] < 0.04, "late by one interval at most"


def test_a_turn_goes_the_short_way(human):
    head = human.pose.head.copy()
    goal = np.concatenate([head[:3], -frames.multiply(frames.from_yaw(0.4), head[3:])])  # the same turn, other sign
    human.take(TrackedPoints(goal))
    yaws = [frames.to_yaw(human(step * DT).head[3:]) for step in range(10)]
    assert np.all(np.diff([frames.to_yaw(head[3:]), *yaws]) > -1e-9)
    assert yaws[-1] == pytest.approx(0.9, abs=1e-6)


def test_a_hand_without_a_controller_hangs_beside_the_person_wherever_it_walks(human):
    below = frames.compose(frames.inverse(human.pose.head), human.pose.left)
    head = frames.pose(np.array([4.0, -1.0, 1.6]), frames.from_yaw(2.0))
    human.take(TrackedPoints(head))
    for step in range(20):
        pose = human(step * DT)
    np.testing.assert_allclose(frames.compose(frames.inverse(pose.head), pose.left), below, atol=1e-9)
    np.testing.assert_allclose(pose.root[:3], [*pose.hips[:2], 0.0])


def test_who_is_put_elsewhere_stands_there_at_once(human):
    """No point of the body is seen, or pushes, on the way; a step later it stands as before."""
    before = human.pose.points[1:]
    for _ in range(3):
        human.take(TrackedPoints(human.pose.head))
        human(0.0)
    head = human.pose.head + np.array([3.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    human.take(TrackedPoints(head))
    for _ in range(60):
        points = human(0.0).points[1:]
        np.testing.assert_allclose(points[:, :3] - before[:, :3], np.tile([3.0, 1.0, 0.0], (6, 1)), atol=1e-9)


@pytest.mark.parametrize("rate", [90.0, 10.0, 2.5])
def test_feet_move_no_faster_than_those_of_a_person(human, rate):
    """At 2.5 inputs a second, as from a slow browser, the head moves by half a metre in a tenth of a second, and stops.
    A foot that jumped would throw away what it hits."""
    head = human.pose.head.copy()
    ahead = frames.rotate(head[3:], np.array([1.0, 0.0, 0.0]))
    steps = np.arange(0.0, 4.0, DT)
    walked = 1.2 * np.clip(steps - 0.5, 0.0, 1.5)
    turned = np.where(steps < 2.5, 0.0, 2.0)
    feet = []
    due = 0.0
    for time, way, yaw in zip(steps, walked, turned, strict=True):
        if time >= due:
            due += 1.0 / rate
            turn = frames.multiply(frames.from_yaw(yaw), head[3:])
            human.take(TrackedPoints(np.concatenate([head[:3] + way * ahead, turn])))
        pose = human(time)
        feet.append(np.stack([pose.left_foot, pose.right_foot]))
    feet = np.array(feet)
    speed = np.linalg.norm(np.diff(feet[..., :2], axis=0), axis=-1) / DT
    turn = frames.multiply(feet[1:, :, 3:], frames.conjugate(feet[:-1, :, 3:]))
    assert 1.2 < speed.max() <= leg_estimator.MAX_FOOT_SPEED + 1e-9
    assert np.linalg.norm(frames.log(turn), axis=-1).max() / DT <= leg_estimator.MAX_FOOT_TURN + 1e-9
    np.testing.assert_allclose(np.diff(feet[..., 2], axis=0), 0.0, atol=0.01)
    middle = feet[-1, :, :2].mean(0)
    np.testing.assert_allclose(middle, pose.hips[:2], atol=leg_estimator.STEP_LENGTH, err_msg="they follow")


def test_closing_a_hand_and_bending_fingers_pass_through(human):
    human.take(TrackedPoints(human.pose.head, None, human.pose.right, (False, True), (OPEN_HAND, FIST)))
    pose = human(0.0)
    assert (pose.left_closed, pose.right_closed) == (False, True)
    assert pose.right_fingers == FIST


def test_the_fingers_of_a_hand_with_shears_are_around_them(human):
    human.take(TrackedPoints(human.pose.head, closed=(True, False), fingers=(FIST, FIST), shears=(True, False)))
    pose = human(0.0)
    assert (pose.left_shears, pose.right_shears) == (True, False)
    assert (pose.left_fingers, pose.right_fingers) == (shears_grip(closed=True), FIST)
