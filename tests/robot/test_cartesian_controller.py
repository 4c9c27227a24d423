"""Cartesian control of a hand: straight lines, commanded orientation, and task priorities."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.prioritized_ik import solve_prioritized_ik as reference
from vinesim.client.tasks.pruning import ROW_DISTANCE
from vinesim.core import frames
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.control.cartesian_controller import CartesianController, InverseKinematics, axes_of_pose
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.mouth_place import TURNS
from vinesim.robot.tasks.prune import APPROACH, IN_LINE, TURNED
from vinesim.scene.builder import assemble

UP = np.array([0.0, 0.0, 1.0])


def moved(
    hand: CartesianController, goal: np.ndarray, ahead: np.ndarray, up: np.ndarray | None, seconds: float = 6.0
) -> np.ndarray:
    """Move a hand for ``seconds``; positions [tick, 3] m of its tip."""
    robot = hand.robot
    points = []
    for tick in range(round(seconds / 0.01)):
        hand.move_towards(goal, ahead, up, speed=0.3, working_height=float(goal[2]))
        robot.control(0.01 * tick)
        robot.rigid.predict()
        robot.rigid.integrate()
        points.append(hand.tip_position)
    return np.array(points)


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(
    ("goal", "ahead", "up"),
    [((0.8, 0.25, 1.6), (1.0, 0.0, 0.0), UP), ((0.15, 0.58, 0.75), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0))],
    ids=["level, to a bunch", "down, to a box"],
)
def test_a_hand_reaches_its_goal_and_orientation(side: str, goal: tuple, ahead: tuple, up: np.ndarray):
    robot = Robot(RigidWorld(assemble([])), load_description("vinebot"), "anna")
    hand = CartesianController(robot, side)
    target = np.array(goal) * [1.0, 1.0 if side == "left" else -1.0, 1.0]
    moved(hand, target, np.array(ahead), np.array(up))
    assert hand.distance_to(target) < 0.002
    axes = axes_of_pose(robot.frame_pose(hand.tool))
    assert axes[0] @ np.array(ahead) > 0.999
    assert axes[2] @ np.array(up) > 0.999


def test_a_hand_moves_on_a_line_within_its_speed():
    robot = Robot(RigidWorld(assemble([])), load_description("vinebot"), "anna")
    hand = CartesianController(robot, "left", tip_offset=0.03)
    moved(hand, np.array([0.6, 0.25, 1.3]), np.array([1.0, 0.0, 0.0]), UP)
    hand.reset()
    start = hand.tip_position
    goal = np.array([0.8, 0.15, 1.6])
    points = moved(hand, goal, np.array([1.0, 0.0, 0.0]), UP)
    along = frames.normalize(goal - start)
    deviation = (points - start) - ((points - start) @ along)[:, None] * along
    assert np.linalg.norm(deviation, axis=1).max() < 0.01
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).max() / 0.01 < 1.2 * 0.3


@pytest.mark.parametrize("along", [0.25, 0.40])
def test_from_its_home_posture_the_arm_turns_the_blades_down_in_all_directions_of_a_cut(along: float):
    """The start of the way towards a cane at the distance from which a robot prunes."""
    robot = Robot(RigidWorld(assemble([])), load_description("vinebot"), "anna")
    hand = CartesianController(robot, "left")
    cut = np.array([along, ROW_DISTANCE, 1.1])  # the tool is some 7 cm above the cut
    for ahead in frames.rotate(frames.from_yaw(TURNS), np.array([0.0, 1.0, 0.0])):
        moved(hand, cut - APPROACH * ahead, ahead, -UP, seconds=4.0)
        axes = axes_of_pose(robot.frame_pose(hand.tool))
        assert hand.distance_to(cut - APPROACH * ahead) < IN_LINE
        assert axes[0] @ ahead > np.cos(TURNED)
        assert axes[2] @ -UP > np.cos(TURNED)
        fold(hand)


def fold(hand: CartesianController) -> None:
    """Bring the arm to its home posture."""
    robot = hand.robot
    for tick in range(500):
        is_home = hand.move_home(1.0)
        robot.control(0.01 * tick)
        robot.rigid.predict()
        robot.rigid.integrate()
        if is_home:
            break
    np.testing.assert_allclose(robot.setpoint, robot.description.home, atol=1e-9)
    hand.reset()


def solve(
    tasks: list[tuple[np.ndarray, np.ndarray]],
    posture: np.ndarray,
    least: np.ndarray,
    most: np.ndarray,
    weights: np.ndarray,
) -> np.ndarray:
    """Rates for (Jacobian, velocity) of tasks in order, by the compiled inverse kinematics."""
    ik = InverseKinematics(weights, [len(velocity) for _, velocity in tasks])
    ik.jacobian[:] = np.concatenate([jacobian for jacobian, _ in tasks])
    ik.velocity[:] = np.concatenate([velocity for _, velocity in tasks])
    ik.posture_rates[:] = posture
    ik.min_rates[:] = least
    ik.max_rates[:] = most
    return ik.solve().copy()


def test_inverse_kinematics_equals_the_svd_reference() -> None:
    """Random tasks, with joints at their bounds, nearly singular rows and rows that contradict each other."""
    rng = np.random.default_rng(1)
    at_bounds = 0
    for trial in range(300):
        rows = (3, int(rng.integers(1, 6)))
        joints = int(rng.integers(5, 10))
        jacobian = rng.normal(size=(sum(rows), joints))
        velocity = rng.normal(size=sum(rows))
        if trial % 3 == 0:
            jacobian[2] *= 10.0 ** rng.uniform(-6.0, -1.0)
        if trial % 5 == 0:
            jacobian[1] = jacobian[0] + 1e-3 * jacobian[1]
        if trial % 7 == 0:
            jacobian[3] = jacobian[0]
        tasks = [(jacobian[:3], velocity[:3]), (jacobian[3:], velocity[3:])]
        weights = rng.uniform(0.1, 1.0, joints)
        bound = rng.uniform(0.1, 3.0, joints)
        given = (tasks, rng.normal(size=joints), -bound, bound, weights)
        expected = reference(*given)
        np.testing.assert_allclose(solve(*given), expected, atol=1e-8)
        at_bounds += np.count_nonzero(np.abs(np.abs(expected) - bound) < 1e-9)
    assert at_bounds > 300


def test_task_priorities_hold() -> None:
    """First task exact, second as far as it is free, bounds kept: against least squares on the null space."""
    rng = np.random.default_rng(5)
    first = rng.normal(size=(3, 7))
    second = rng.normal(size=(5, 7))
    one = rng.normal(size=3)
    two = rng.normal(size=5)
    posture = rng.normal(size=7)
    far = np.full(7, 1e3)
    rates = solve([(first, one), (second, two)], posture, -far, far, np.ones(7))
    np.testing.assert_allclose(first @ rates, one, atol=1e-9)
    particular = np.linalg.pinv(first) @ one
    null = np.eye(7) - np.linalg.pinv(first) @ first
    best = particular + null @ (np.linalg.pinv(second @ null, rcond=1e-9) @ (two - second @ particular))
    np.testing.assert_allclose(rates, best, atol=1e-9)
    first_only = solve([(first, one)], posture, -far, far, np.ones(7))
    np.testing.assert_allclose(first_only, particular + null @ posture, atol=1e-9)
    bound = np.full(7, 0.9 * np.abs(first_only).max())
    bounded = solve([(first, one)], posture, -bound, bound, np.ones(7))
    assert (np.abs(bounded) <= bound + 1e-9).all()
    np.testing.assert_allclose(first @ bounded, one, atol=1e-9)
