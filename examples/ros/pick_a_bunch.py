"""Picks a bunch and puts it into a box. The robot is controlled through ROS only.

    vinesim client --role robot --scene harvest          # in one terminal
    python examples/ros/pick_a_bunch.py                  # in another

The poses of bunches and boxes come from /tf_environment, the state of the robot from /tf, /joint_states and
/robot_description. The robot is moved by follow_joint_trajectory, gripper_cmd and cmd_vel, like the real one.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import TwistStamped
from rclpy.action import ActionClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectoryPoint

from vinesim.core import frames
from vinesim.robot.description.loader import load_description
from vinesim.ros.messages import message_packages

message_packages.ensure_importable(["control_msgs", "tf2_msgs"])

from control_msgs.action import FollowJointTrajectory, GripperCommand  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402

DEPTH = 0.06  # m from a bunch's upper end down to the grasp, at which the cutter is at the stalk
# m, position of the bunch in the base's frame during the pick
AHEAD = 0.88
ASIDE = 0.28
OPEN = 0.15  # m between the fingers: their largest opening, since a bunch may be 0.13 m wide
ALLEY = (1.36, 1.75, 0.8, 6.7)  # m: ranges of y and x in which the base may stand and turn
LANE = 1.06  # m: y of the base next to a box
DRAWN_IN = (0.45, 0.12, 1.20)  # m: position of the left hand while the base drives, in the base's frame
UP = np.array([0.0, 0.0, 1.0])


class Robot:
    """State of the robot and its surroundings from the topics, and the robot's actions."""

    def __init__(self) -> None:
        self.node = rclpy.create_node("picker")
        self.joints: dict[str, float] = {}
        self.frames: dict[str, np.ndarray] = {}  # pose [7] in the parent's frame, by frame id
        self.environment: dict[str, np.ndarray] = {}
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        texts: list[str] = []
        self.node.create_subscription(String, "/robot_description", lambda m: texts.append(m.data), latched)
        self.node.create_subscription(JointState, "/joint_states", self._take_joints, 1)
        self.node.create_subscription(TFMessage, "/tf", lambda m: self.frames.update(poses_of(m)), 1)
        self.node.create_subscription(TFMessage, "/tf_environment", self._take_environment, 1)
        self.velocity = self.node.create_publisher(TwistStamped, "/mobile_base_controller/cmd_vel", 1)
        self.until(lambda: texts and self.joints and self.frames and self.environment)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "robot.urdf"
            file.write_text(texts[0])
            self.description = load_description(file)

    def _take_joints(self, message: JointState) -> None:
        self.joints = dict(zip(message.name, message.position, strict=True))

    def _take_environment(self, message) -> None:
        self.environment = poses_of(message)

    def until(self, done, timeout: float = 60.0) -> None:
        """Receive messages until ``done()`` returns True. Raises RuntimeError after ``timeout`` [s]."""
        end = time.monotonic() + timeout
        while not done():
            rclpy.spin_once(self.node, timeout_sec=0.1)
            if time.monotonic() > end:
                raise RuntimeError("the robot did not answer")

    def base(self) -> np.ndarray:
        """Returns the pose [7] of the base in the map."""
        return frames.compose(self.frames["odom"], self.frames["base_footprint"])

    def act(self, *goals) -> list:
        """Send goals (action, name, goal) at the same time. Returns their results when all goals have ended."""
        handles = []
        for action, name, goal in goals:
            client = ActionClient(self.node, action, name)
            self.until(client.server_is_ready)
            answer = client.send_goal_async(goal)
            self.until(answer.done)
            handles.append(answer.result().get_result_async())
        self.until(lambda: all(handle.done() for handle in handles), 120.0)
        return [handle.result().result for handle in handles]

    def grip(self, side: str, opening: float, effort: float = 0.0) -> GripperCommand.Result:
        """Move a gripper to an opening [m]. ``effort``: largest effort of each finger [N]; 0: the drive's own limit."""
        goal = GripperCommand.Goal()
        goal.command.position = opening
        goal.command.max_effort = effort
        return self.act((GripperCommand, f"/gripper_{side}_controller/gripper_cmd", goal))[0]


def poses_of(message) -> dict[str, np.ndarray]:
    """Returns the poses [7] in a TFMessage, by child frame id."""
    return {
        t.child_frame_id: np.array(
            [*(getattr(t.transform.translation, a) for a in "xyz"), *(getattr(t.transform.rotation, a) for a in "xyzw")]
        )
        for t in message.transforms
    }


class Arm:
    """One arm with the lift. It moves the hand along straight lines, by damped inverse kinematics of the URDF."""

    def __init__(self, robot: Robot, side: str) -> None:
        self.robot = robot
        self.side = side
        groups = robot.description.groups
        self.parts = {"torso": groups["torso"].joints, f"arm_{side}": groups[f"arm_{side}"].joints}
        self.names = [name for joints in self.parts.values() for name in joints]
        drives = {drive.joint: drive for drive in robot.description.drives}
        self.lower = np.array([drives[name].lower for name in self.names]) + 0.01
        self.upper = np.array([drives[name].upper for name in self.names]) - 0.01
        self.index = [robot.description.joints.index(name) for name in self.names]
        self.home = np.array([robot.joints[name] for name in self.names])
        self.tool = f"gripper_{side}_grasping_link"

    def hand(self, q: np.ndarray) -> np.ndarray:
        """Returns the pose [7] of the hand in the base's frame for joint positions ``q``."""
        every = np.array([self.robot.joints[name] for name in self.robot.description.joints])
        every[self.index] = q
        return self.robot.description.link_poses(every)[self.tool]

    def solve(self, goal: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Returns joint positions for a pose [7] of the hand in the base's frame, searched from ``q``. Of several
        solutions, it is one near the home positions. Raises RuntimeError if the hand cannot reach the pose."""
        for count in range(60):
            here = self.hand(q)
            off = np.r_[goal[:3] - here[:3], frames.log(frames.multiply(goal[3:], frames.conjugate(here[3:])))]
            if np.linalg.norm(off[:3]) < 5e-4 and np.linalg.norm(off[3:]) < 5e-3:
                return q
            jacobian = np.empty((6, len(q)))
            for i in range(len(q)):
                there = self.hand(q + 1e-4 * np.eye(len(q))[i])
                turn = frames.log(frames.multiply(there[3:], frames.conjugate(here[3:])))
                jacobian[:, i] = np.r_[there[:3] - here[:3], turn] / 1e-4
            damping = 1e-6 + 0.02 * float(off @ off)
            free = np.ones(len(q))  # 0 for joints at their limits: the other joints do the motion
            for _ in range(3):
                part = jacobian * free
                inverse = part.T @ np.linalg.inv(part @ part.T + damping * np.eye(6))
                rest = (np.eye(len(q)) - inverse @ part) @ (0.1 * 0.7**count * free * (self.home - q))
                step = inverse @ off + rest
                free[(q + step < self.lower) | (q + step > self.upper)] = 0.0
            q = np.clip(q + step * min(1.0, 0.3 / np.abs(step).max()), self.lower, self.upper)
        raise RuntimeError(f"the hand stays {np.linalg.norm(off[:3]):.3f} m and {np.linalg.norm(off[3:]):.2f} rad off")

    def move(self, position, turn: np.ndarray, speed: float = 0.2) -> None:
        """Move the hand in a straight line to a position [3] m and an orientation [4] in the base's frame."""
        q = np.array([self.robot.joints[name] for name in self.names])
        start = self.hand(q)
        away = frames.log(frames.multiply(turn, frames.conjugate(start[3:])))
        duration = max(np.linalg.norm(position - start[:3]) / speed, np.linalg.norm(away) / 0.8, 0.3)
        shares = np.linspace(0.0, 1.0, max(3, round(duration / 0.25)) + 1)[1:]
        path = [q]
        for share in shares:
            pose = np.r_[
                start[:3] + share * (position - start[:3]), frames.multiply(frames.exp(share * away), start[3:])
            ]
            path.append(self.solve(pose, path[-1]))
        steps = np.diff(path, axis=0)
        limits = np.array([d.velocity for d in self.robot.description.drives])[self.index]
        duration = max(duration, (np.abs(steps) / limits).max() * len(steps) * 1.3)
        times = shares * duration
        velocities = np.gradient(np.array(path), np.r_[0.0, times], axis=0)
        velocities[-1] = 0.0
        goals = []
        for group, joints in self.parts.items():
            columns = [self.names.index(name) for name in joints]
            goal = FollowJointTrajectory.Goal()
            goal.trajectory.joint_names = list(joints)
            for t, place, rate in zip(times, path[1:], velocities[1:], strict=True):
                point = JointTrajectoryPoint(positions=place[columns].tolist(), velocities=rate[columns].tolist())
                point.time_from_start.sec, point.time_from_start.nanosec = divmod(round(t * 1e9), 10**9)
                goal.trajectory.points.append(point)
            goals.append((FollowJointTrajectory, f"/{group}_controller/follow_joint_trajectory", goal))
        for result in self.robot.act(*goals):
            if result.error_code:
                raise RuntimeError(result.error_string)


def drive(robot: Robot, place: np.ndarray | None, heading: float | None) -> None:
    """Turn towards a place [2] m, drive there, and turn to a heading [rad]. Raises RuntimeError if the base is
    stuck."""
    seen: list[np.ndarray] = []

    def command(linear: float, angular: float) -> None:
        twist = TwistStamped()
        twist.twist.linear.x = linear
        twist.twist.angular.z = angular
        robot.velocity.publish(twist)
        end = time.monotonic() + 0.04
        while time.monotonic() < end:
            rclpy.spin_once(robot.node, timeout_sec=0.01)
        seen.append(robot.base())
        if linear == 0.0:
            seen.clear()
        if len(seen) > 100 and np.linalg.norm(seen[-1][:2] - seen[-100][:2]) < 0.01:
            for _ in range(40):
                twist.twist.linear.x = -0.3
                twist.twist.angular.z = 0.0
                robot.velocity.publish(twist)
                rclpy.spin_once(robot.node, timeout_sec=0.05)
            raise RuntimeError("something is in the way of the base")

    def turn_to(course: float) -> None:
        while abs(error := wrap(course - yaw_of(robot.base()))) > 0.01:
            command(0.0, float(np.clip(1.5 * error, -0.4, 0.4)))

    if place is not None and np.linalg.norm(place - robot.base()[:2]) > 0.03:
        turn_to(float(np.arctan2(*(place - robot.base()[:2])[::-1])))
        while np.linalg.norm(away := place - robot.base()[:2]) > 0.02:
            error = wrap(float(np.arctan2(away[1], away[0])) - yaw_of(robot.base()))
            if abs(error) > 1.5:  # the base has passed the place
                break
            command(float(min(0.4, 0.8 * np.linalg.norm(away) + 0.03)), float(np.clip(2.0 * error, -0.4, 0.4)))
    if heading is not None:
        turn_to(heading)
    for _ in range(10):
        command(0.0, 0.0)


def wrap(angle: float) -> float:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def yaw_of(pose: np.ndarray) -> float:
    return float(2.0 * np.arctan2(pose[5], pose[6]))


def bunches_by_room(robot: Robot) -> list[tuple[str, str, np.ndarray, float]]:
    """Returns possible picks: bunch, side, and place [2] m and heading [rad] of the base. Bunches with most room
    between them and other bunches come first."""
    bunches = {name: pose for name, pose in robot.environment.items() if name.startswith("bunch")}
    axes = {name: frames.rotate(pose[3:], np.array([1.0, 0.0, 0.0])) for name, pose in bunches.items()}
    middles = np.array([pose[:3] + 0.08 * axes[name] for name, pose in bunches.items()])
    found = []
    for name, pose in bunches.items():
        hold = pose[:3] + DEPTH * axes[name]
        if not 1.34 < hold[2] < 1.68 or axes[name][2] > -0.95:
            continue
        for heading in np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False):
            turn = frames.from_yaw(heading)
            for side, hand in (("left", 1.0), ("right", -1.0)):
                place = (hold - frames.rotate(turn, np.array([AHEAD, hand * ASIDE, 0.0])))[:2]
                if ALLEY[0] < place[1] < ALLEY[1] and ALLEY[2] < place[0] < ALLEY[3]:
                    local = frames.rotate(frames.conjugate(turn), middles - hold)
                    beyond = np.maximum(np.array([-0.45, -0.11, -0.15]) - local, local - np.array([0.06, 0.11, 0.15]))
                    apart = np.sort(np.linalg.norm(np.maximum(beyond, 0.0), axis=1))[1]  # the first is the bunch itself
                    far = np.linalg.norm(place - robot.base()[:2])
                    found.append((min(apart, 0.12) - 0.01 * far, name, side, place, heading))
    found.sort(key=lambda entry: -entry[0])
    return [entry[1:] for entry in found]


def pick(robot: Robot, name: str, side: str, place: np.ndarray, heading: float) -> None:
    """Pick one bunch. If that fails, draw the hand back and raise RuntimeError."""
    drive(robot, place, heading)
    arm = Arm(robot, side)
    level = np.array([0.0, 0.0, 0.0, 1.0])

    def grasp_point() -> np.ndarray:
        rclpy.spin_once(robot.node, timeout_sec=0.2)
        if name not in robot.environment:
            raise RuntimeError("the bunch fell")
        bunch = robot.environment[name]
        axis = frames.rotate(bunch[3:], np.array([1.0, 0.0, 0.0]))
        return frames.compose(frames.inverse(robot.base()), np.r_[bunch[:3] + DEPTH * axis, level])[:3]

    back = np.array([0.20, 0.0, 0.0])
    try:
        robot.grip(side, OPEN)
        arm.move(grasp_point() - back, level)
        arm.move(grasp_point(), level, speed=0.1)
        if not robot.grip(side, 0.0, 25.0).stalled:
            raise RuntimeError("nothing between the fingers")
        for _ in range(5):
            cut = robot.act((GripperCommand, f"/cutter_{side}_controller/gripper_cmd", GripperCommand.Goal()))[0]
            if cut.effort > 0.0:
                break
        else:
            raise RuntimeError("the blades cut nothing")
        here = arm.hand(np.array([robot.joints[joint] for joint in arm.names]))[:3]
        arm.move(here - back - [0.0, 0.0, 0.03], level, speed=0.15)
        arm.move(np.array(DRAWN_IN) * [1.0, 1.0 if side == "left" else -1.0, 1.0], level)
    except RuntimeError:
        robot.grip(side, OPEN)
        here = arm.hand(np.array([robot.joints[joint] for joint in arm.names]))[:3]
        arm.move(here - back, level)
        arm.move(np.array(DRAWN_IN) * [1.0, 1.0 if side == "left" else -1.0, 1.0], level)
        raise


def put_into_box(robot: Robot, side: str) -> None:
    """Drive next to the nearest box, with the box on the hand's side, and put the held bunch into it."""
    boxes = [pose for name, pose in robot.environment.items() if name.startswith("box")]
    box = min(boxes, key=lambda pose: float(np.linalg.norm(pose[:2] - robot.base()[:2])))
    ahead = -1.0 if side == "left" else 1.0  # the boxes are at smaller y, to the left of a robot that faces -x
    lane = np.array([box[0] - ahead * 0.10, LANE])
    start = np.array([lane[0] - ahead * 0.9, 0.5 * (ALLEY[0] + ALLEY[1])])
    heading = 0.0 if ahead > 0.0 else np.pi
    drive(robot, np.array([start[0], start[1]]), None)
    drive(robot, np.array([lane[0] - ahead * 0.6, LANE]), heading)
    drive(robot, lane, heading)
    arm = Arm(robot, side)
    level = np.array([0.0, 0.0, 0.0, 1.0])
    down = frames.exp(np.array([0.0, 0.5 * np.pi, 0.0]))
    middle = frames.compose(frames.inverse(robot.base()), box)[:3] + np.array([0.02, 0.0, 0.0])
    over = middle + 0.80 * UP
    low = middle + 0.22 * UP
    arm.move(over, level)
    arm.move(over, down)
    arm.move(low, down, speed=0.15)
    if not robot.grip(side, OPEN).reached_goal:
        raise RuntimeError("the hand does not open")
    arm.move(over, down)


def main() -> int:
    rclpy.init()
    robot = Robot()
    tried: set[str] = set()
    for name, side, place, heading in bunches_by_room(robot):
        if name in tried:
            continue
        tried.add(name)
        print(f"{name}: {side} hand, from ({place[0]:.2f}, {place[1]:.2f})", flush=True)
        try:
            pick(robot, name, side, place, heading)
            try:
                put_into_box(robot, side)
            except RuntimeError as failure:
                print(f"{name}: {failure}; once more", flush=True)
                put_into_box(robot, side)
        except RuntimeError as failure:
            print(f"{name}: {failure}", flush=True)
            if len(tried) == 6:
                return 1
            continue
        print(f"{name}: in the box", flush=True)
        return 0
    return 1


if __name__ == "__main__":
    sys.exit(main())
