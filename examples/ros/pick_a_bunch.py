"""Picks a bunch and puts it into a box. The robot is controlled through ROS only.

    vinesim client --role robot --scene harvest          # in one terminal
    python examples/ros/pick_a_bunch.py                  # in another

This is an ordinary ROS 2 node. The poses of bunches and boxes come from /tf_environment, the state of the robot from
/tf, /joint_states and /robot_description. The robot is moved by follow_joint_trajectory, gripper_cmd and cmd_vel, like
the real one. The driving assumes the alley of the scene harvest. Ctrl-C cancels the goals and ends the program.
"""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from xml.etree import ElementTree

import numpy as np
import rclpy
from control_msgs.action import FollowJointTrajectory, GripperCommand
from geometry_msgs.msg import TwistStamped
from rclpy.action import ActionClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import JointTrajectoryPoint

DEPTH = 0.06  # m from a bunch's upper end down to the grasp, at which the cutter is at the stalk
# m, position of the bunch in the base's frame during the pick
AHEAD = 0.88
ASIDE = 0.28
OPEN = 0.15  # m between the fingers: their largest opening, since a bunch may be 0.13 m wide
ALLEY = (1.36, 1.75, 0.8, 6.7)  # m: ranges of y and x in which the base may stand and turn
LANE = 1.06  # m: y of the base next to a box
DRAWN_IN = (0.45, 0.12, 1.20)  # m: position of the left hand while the base drives, in the base's frame
UP = np.array([0.0, 0.0, 1.0])


class StopRequest(Exception):
    """SIGINT (Ctrl-C) or SIGTERM has arrived."""


# ---------------------------------------------------------------- poses are matrices [4, 4]


def pose(position, rotation: np.ndarray | None = None) -> np.ndarray:
    """Returns the pose with a position [3] m and a rotation matrix [3, 3], by default none."""
    matrix = np.eye(4)
    matrix[:3, 3] = position
    if rotation is not None:
        matrix[:3, :3] = rotation
    return matrix


def rotation(v) -> np.ndarray:
    """Returns the rotation matrix [3, 3] of a rotation vector [3] rad."""
    angle = float(np.linalg.norm(v))
    x, y, z = np.asarray(v) / (angle or 1.0)
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * k @ k


def rotation_vector(r: np.ndarray) -> np.ndarray:
    """Returns the rotation vector [3] rad of a rotation matrix [3, 3] by less than half a turn."""
    twice = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])  # 2 sin(angle) times the axis
    sine = 0.5 * float(np.linalg.norm(twice))
    angle = float(np.arctan2(sine, 0.5 * (np.trace(r) - 1.0)))
    return twice * (0.5 * angle / sine if sine > 1e-9 else 0.5)


def yaw_of(matrix: np.ndarray) -> float:
    return float(np.arctan2(matrix[1, 0], matrix[0, 0]))


def wrap(angle: float) -> float:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def poses_of(message: TFMessage) -> dict[str, np.ndarray]:
    """Returns the poses in a message, by child frame id."""
    found = {}
    for t in message.transforms:
        p = t.transform.translation
        q = t.transform.rotation
        v = np.array([q.x, q.y, q.z])
        norm = float(np.linalg.norm(v))
        angle = 2.0 * np.arctan2(norm, q.w)
        found[t.child_frame_id] = pose([p.x, p.y, p.z], rotation(v * (angle / norm if norm > 1e-12 else 2.0)))
    return found


# ---------------------------------------------------------------- the robot


class Robot:
    """State of the robot and its surroundings from the topics, and the robot's actions."""

    def __init__(self, node: rclpy.node.Node, stop: threading.Event) -> None:
        self.node = node
        self.stop = stop
        self.joints: dict[str, float] = {}
        self.frames: dict[str, np.ndarray] = {}  # pose in the parent's frame, by frame id
        self.environment: dict[str, np.ndarray] = {}
        self.urdf: list[str] = []
        self.clients: dict[str, ActionClient] = {}
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(String, "/robot_description", lambda m: self.urdf.append(m.data), latched)
        node.create_subscription(JointState, "/joint_states", self._take_joints, 10)
        node.create_subscription(TFMessage, "/tf", lambda m: self.frames.update(poses_of(m)), 10)
        node.create_subscription(TFMessage, "/tf_environment", self._take_environment, 10)
        self.velocity = node.create_publisher(TwistStamped, "/mobile_base_controller/cmd_vel", 10)
        print("waiting for the topics of a robot", flush=True)
        needs = {
            "/robot_description": lambda: self.urdf,
            "/joint_states": lambda: self.joints,
            "transform from odom to base_footprint": lambda: "base_footprint" in self.frames,
            "transform from map to odom": lambda: "odom" in self.frames,
            "/tf_environment": lambda: self.environment,
        }
        for what, is_there in needs.items():
            self.until(is_there, 60.0, what)
        self.home = dict(self.joints)

    def _take_joints(self, message: JointState) -> None:
        self.joints = dict(zip(message.name, message.position, strict=True))

    def _take_environment(self, message: TFMessage) -> None:
        self.environment = poses_of(message)

    def check(self) -> None:
        """Raise StopRequest if the program is to end; long computations call this function, too."""
        if self.stop.is_set():
            raise StopRequest

    def spin(self, seconds: float) -> None:
        """Receive messages for a time [s]. Raises StopRequest if the program is to end."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self.check()
            rclpy.spin_once(self.node, timeout_sec=min(left, 0.1))

    def until(self, done, timeout: float, what: str) -> None:
        """Receive messages until ``done()`` returns True. Raises RuntimeError after ``timeout`` [s]."""
        end = time.monotonic() + timeout
        while not done():
            self.spin(0.01)
            if time.monotonic() > end:
                raise RuntimeError(f"no {what} of the robot for {timeout:.0f} s")

    def base(self) -> np.ndarray:
        """Returns the pose of the base in the map."""
        return self.frames["odom"] @ self.frames["base_footprint"]

    def act(self, *goals) -> list:
        """Send goals (action, name, goal) at the same time. Returns their results when all goals have ended."""
        handles = []
        try:
            for action, name, goal in goals:
                if name not in self.clients:
                    self.clients[name] = ActionClient(self.node, action, name)
                self.until(self.clients[name].server_is_ready, 60.0, f"action server {name}")
                answer = self.clients[name].send_goal_async(goal)
                self.until(answer.done, 60.0, f"answer of {name}")
                if not answer.result().accepted:
                    raise RuntimeError(f"{name} refused the goal")
                handles.append(answer.result())
            results = [handle.get_result_async() for handle in handles]
            self.until(lambda: all(result.done() for result in results), 120.0, "result")
        except StopRequest:
            for handle in handles:
                handle.cancel_goal_async()
            raise
        return [result.result().result for result in results]

    def grip(self, side: str, opening: float, effort: float = 0.0) -> GripperCommand.Result:
        """Move a gripper to an opening [m]. ``effort``: largest effort of each finger [N]; 0: the drive's own limit."""
        goal = GripperCommand.Goal()
        goal.command.position = opening
        goal.command.max_effort = effort
        return self.act((GripperCommand, f"/gripper_{side}_controller/gripper_cmd", goal))[0]


class Joint:
    """One joint of a URDF."""

    def __init__(self, element: ElementTree.Element) -> None:
        def numbers(tag: str, attribute: str, default: str) -> np.ndarray:
            found = element.find(tag)
            return np.array((default if found is None else found.get(attribute, default)).split(), float)

        self.name = element.get("name", "")
        self.kind = element.get("type")
        self.parent = element.find("parent").get("link")
        roll, pitch, yaw = numbers("origin", "rpy", "0 0 0")
        turn = rotation([0.0, 0.0, yaw]) @ rotation([0.0, pitch, 0.0]) @ rotation([roll, 0.0, 0.0])
        self.origin = pose(numbers("origin", "xyz", "0 0 0"), turn)
        self.axis = numbers("axis", "xyz", "1 0 0")
        self.lower, self.upper, self.velocity = (
            float(numbers("limit", what, "0")[0]) for what in ("lower", "upper", "velocity")
        )


class Arm:
    """One arm with the lift. It moves the hand along straight lines, by damped inverse kinematics of the URDF."""

    def __init__(self, robot: Robot, side: str) -> None:
        self.robot = robot
        self.side = side
        by_child = {
            element.find("child").get("link"): Joint(element)
            for element in ElementTree.fromstring(robot.urdf[-1]).findall("joint")
        }
        self.chain: list[Joint] = []  # from the base to the hand
        link = f"gripper_{side}_grasping_link"
        while link != "base_footprint":
            self.chain.insert(0, by_child[link])
            link = by_child[link].parent
        moving = [joint for joint in self.chain if joint.kind != "fixed"]
        self.names = [joint.name for joint in moving]
        self.parts = {part: [name for name in self.names if name.startswith(part)] for part in ("torso", f"arm_{side}")}
        self.lower = np.array([joint.lower for joint in moving]) + 0.01
        self.upper = np.array([joint.upper for joint in moving]) - 0.01
        self.velocity = np.array([joint.velocity for joint in moving])
        self.home = np.array([robot.home[name] for name in self.names])

    def positions(self) -> np.ndarray:
        """Returns the present positions of the joints [m, rad]."""
        return np.array([self.robot.joints[name] for name in self.names])

    def place(self) -> np.ndarray:
        """Returns the present position [3] m of the hand in the base's frame."""
        return self.hand(self.positions())[0][:3, 3]

    def hand(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the pose of the hand in the base's frame for joint positions ``q``, and its Jacobian [6, joint]."""
        here = np.eye(4)
        axes = []
        values = iter(q)
        for joint in self.chain:
            here = here @ joint.origin
            if joint.kind == "fixed":
                continue
            axes.append((joint.kind, here[:3, :3] @ joint.axis, here[:3, 3]))
            value = next(values)
            slides = joint.kind == "prismatic"
            here = here @ (pose(value * joint.axis) if slides else pose([0.0, 0.0, 0.0], rotation(value * joint.axis)))
        columns = [
            np.r_[axis, 0.0, 0.0, 0.0] if kind == "prismatic" else np.r_[np.cross(axis, here[:3, 3] - place), axis]
            for kind, axis, place in axes
        ]
        return here, np.array(columns).T

    def solve(self, goal: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Returns joint positions for a pose of the hand in the base's frame, searched from ``q``. Of several
        solutions, it is one near the home positions. Raises RuntimeError if the hand cannot reach the pose."""
        off = np.zeros(6)
        for count in range(60):
            self.robot.check()
            here, jacobian = self.hand(q)
            off = np.r_[goal[:3, 3] - here[:3, 3], rotation_vector(goal[:3, :3] @ here[:3, :3].T)]
            if np.linalg.norm(off[:3]) < 5e-4 and np.linalg.norm(off[3:]) < 5e-3:
                return q
            damping = 1e-6 + 0.02 * float(off @ off)
            free = np.ones(len(q))  # 0 for joints at their limits: the other joints do the motion
            step = np.zeros(len(q))
            for _ in range(3):
                part = jacobian * free
                inverse = part.T @ np.linalg.inv(part @ part.T + damping * np.eye(6))
                rest = (np.eye(len(q)) - inverse @ part) @ (0.1 * 0.7**count * free * (self.home - q))
                step = inverse @ off + rest
                free[(q + step < self.lower) | (q + step > self.upper)] = 0.0
            q = np.clip(q + step * min(1.0, 0.3 / np.abs(step).max()), self.lower, self.upper)
        raise RuntimeError(f"the hand stays {np.linalg.norm(off[:3]):.3f} m and {np.linalg.norm(off[3:]):.2f} rad off")

    def move(self, position, turn: np.ndarray, speed: float = 0.2) -> None:
        """Move the hand in a straight line to a position [3] m and an orientation [3, 3] in the base's frame."""
        q = self.positions()
        start, _ = self.hand(q)
        way = np.asarray(position) - start[:3, 3]
        away = rotation_vector(turn @ start[:3, :3].T)
        duration = max(np.linalg.norm(way) / speed, np.linalg.norm(away) / 0.8, 0.3)
        shares = np.linspace(0.0, 1.0, max(3, round(duration / 0.25)) + 1)[1:]
        path = [q]
        for share in shares:
            goal = pose(start[:3, 3] + share * way, rotation(share * away) @ start[:3, :3])
            path.append(self.solve(goal, path[-1]))
        steps = np.diff(path, axis=0)
        duration = max(duration, (np.abs(steps) / self.velocity).max() * len(steps) * 1.3)
        self.follow(np.array(path), np.r_[0.0, shares * duration])

    def move_home(self) -> None:
        """Move the joints to their positions at the start of the program."""
        path = np.array([self.positions(), self.home])
        self.follow(path, np.array([0.0, max((np.abs(path[1] - path[0]) / self.velocity).max() * 2.0, 0.5)]))

    def follow(self, path: np.ndarray, times: np.ndarray) -> None:
        """Move the joints through the positions [point, joint] at ``times`` [point] s, from the present position on."""
        velocities = np.gradient(path, times, axis=0)
        velocities[-1] = 0.0
        goals = []
        for group, joints in self.parts.items():
            columns = [self.names.index(name) for name in joints]
            goal = FollowJointTrajectory.Goal()
            goal.trajectory.joint_names = list(joints)
            for t, place, rate in zip(times[1:], path[1:], velocities[1:], strict=True):
                point = JointTrajectoryPoint(positions=place[columns].tolist(), velocities=rate[columns].tolist())
                point.time_from_start.sec, point.time_from_start.nanosec = divmod(round(t * 1e9), 10**9)
                goal.trajectory.points.append(point)
            goals.append((FollowJointTrajectory, f"/{group}_controller/follow_joint_trajectory", goal))
        for result in self.robot.act(*goals):
            if result.error_code:
                raise RuntimeError(result.error_string)


def command(robot: Robot, linear: float, angular: float, seconds: float = 0.04) -> None:
    """Command a velocity of the base [m/s, rad/s] and wait for a time."""
    twist = TwistStamped()
    twist.twist.linear.x = linear
    twist.twist.angular.z = angular
    robot.velocity.publish(twist)
    robot.spin(seconds)


def back_off(robot: Robot) -> None:
    """Drive backwards for two seconds, 0.6 m."""
    for _ in range(40):
        command(robot, -0.3, 0.0, 0.05)


def drive(robot: Robot, place: np.ndarray | None, heading: float | None) -> None:
    """Turn towards a place [2] m, drive there, and turn to a heading [rad]. Raises RuntimeError if the base is
    stuck."""
    seen: list[np.ndarray] = []

    def advance(linear: float, angular: float) -> None:
        command(robot, linear, angular)
        seen.append(robot.base()[:2, 3])
        if len(seen) > 100 and np.linalg.norm(seen[-1] - seen[-100]) < 0.01:
            back_off(robot)
            raise RuntimeError("something is in the way of the base")

    def turn_to(course: float) -> None:
        while abs(error := wrap(course - yaw_of(robot.base()))) > 0.01:
            command(robot, 0.0, float(np.clip(1.5 * error, -0.4, 0.4)))

    if place is not None and np.linalg.norm(place - robot.base()[:2, 3]) > 0.03:
        turn_to(float(np.arctan2(*(place - robot.base()[:2, 3])[::-1])))
        while np.linalg.norm(away := place - robot.base()[:2, 3]) > 0.02:
            error = wrap(float(np.arctan2(away[1], away[0])) - yaw_of(robot.base()))
            if abs(error) > 1.5:  # the base has passed the place
                break
            advance(float(min(0.4, 0.8 * np.linalg.norm(away) + 0.03)), float(np.clip(2.0 * error, -0.4, 0.4)))
    if heading is not None:
        turn_to(heading)
    for _ in range(10):
        command(robot, 0.0, 0.0)


# ---------------------------------------------------------------- the task


def bunches_by_room(robot: Robot) -> list[tuple[str, str, np.ndarray, float]]:
    """Returns possible picks: bunch, side, and place [2] m and heading [rad] of the base. Bunches with most room
    between them and other bunches come first."""
    bunches = {name: frame for name, frame in robot.environment.items() if name.startswith("bunch")}
    middles = np.array([frame[:3, 3] + 0.08 * frame[:3, 0] for frame in bunches.values()])  # x points down the rachis
    here = robot.base()[:2, 3]
    found = []
    for name, frame in bunches.items():
        robot.check()
        hold = frame[:3, 3] + DEPTH * frame[:3, 0]
        if not 1.34 < hold[2] < 1.68 or frame[2, 0] > -0.95:
            continue
        for heading in np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False):
            turn = rotation(heading * UP)
            for side, hand in (("left", 1.0), ("right", -1.0)):
                place = (hold - turn @ [AHEAD, hand * ASIDE, 0.0])[:2]
                if ALLEY[0] < place[1] < ALLEY[1] and ALLEY[2] < place[0] < ALLEY[3]:
                    local = (middles - hold) @ turn  # in axes of the base
                    beyond = np.maximum(np.array([-0.45, -0.11, -0.15]) - local, local - np.array([0.06, 0.11, 0.15]))
                    apart = np.sort(np.linalg.norm(np.maximum(beyond, 0.0), axis=1))[1]  # the first is the bunch itself
                    far = np.linalg.norm(place - here)
                    found.append((min(apart, 0.12) - 0.01 * far, name, side, place, heading))
    found.sort(key=lambda entry: -entry[0])
    return [entry[1:] for entry in found]


def pick(robot: Robot, name: str, side: str, place: np.ndarray, heading: float) -> None:
    """Pick one bunch. If that fails, draw the hand back and raise RuntimeError."""
    drive(robot, place, heading)
    arm = Arm(robot, side)
    level = np.eye(3)
    drawn_in = np.array(DRAWN_IN) * [1.0, 1.0 if side == "left" else -1.0, 1.0]

    def grasp_point() -> np.ndarray:
        robot.spin(0.2)
        if name not in robot.environment:
            raise RuntimeError("the bunch fell")
        bunch = np.linalg.inv(robot.base()) @ robot.environment[name]
        return bunch[:3, 3] + DEPTH * bunch[:3, 0]

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
        arm.move(arm.place() - back - [0.0, 0.0, 0.03], level, speed=0.15)
        arm.move(drawn_in, level)
    except RuntimeError:
        robot.grip(side, OPEN)
        arm.move(arm.place() - back, level)
        arm.move(drawn_in, level)
        raise


def put_into_box(robot: Robot, side: str) -> None:
    """Drive next to the nearest box, with the box on the hand's side, and put the held bunch into it."""
    boxes = [frame for name, frame in robot.environment.items() if name.startswith("box")]
    box = min(boxes, key=lambda frame: float(np.linalg.norm(frame[:2, 3] - robot.base()[:2, 3])))
    ahead = -1.0 if side == "left" else 1.0  # the boxes are at smaller y, to the left of a robot that faces -x
    lane = np.array([box[0, 3] - ahead * 0.10, LANE])
    heading = 0.0 if ahead > 0.0 else np.pi
    drive(robot, np.array([lane[0] - ahead * 0.9, 0.5 * (ALLEY[0] + ALLEY[1])]), None)
    drive(robot, np.array([lane[0] - ahead * 0.6, LANE]), heading)
    drive(robot, lane, heading)
    arm = Arm(robot, side)
    level = np.eye(3)
    down = rotation([0.0, 0.5 * np.pi, 0.0])
    middle = (np.linalg.inv(robot.base()) @ box)[:3, 3] + [0.02, 0.0, 0.0]
    over = middle + 0.80 * UP
    low = middle + 0.22 * UP
    arm.move(over, level)
    arm.move(over, down)
    arm.move(low, down, speed=0.15)
    if not robot.grip(side, OPEN).reached_goal:
        raise RuntimeError("the hand does not open")
    arm.move(over, down)
    arm.move(over, level)
    arm.move(np.array(DRAWN_IN) * [1.0, -ahead, 1.0], level)
    arm.move_home()
    back_off(robot)
    drive(robot, np.array([robot.base()[0, 3], 0.5 * (ALLEY[0] + ALLEY[1])]), None)


def harvest(robot: Robot) -> int:
    """Pick the first bunch that can be picked. Returns the exit code."""
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
                break
            continue
        print(f"{name}: in the box", flush=True)
        return 0
    if not tried:
        print("no bunch is within reach of the alley: is this the scene harvest?")
    return 1


def main() -> int:
    # Ctrl-C and SIGTERM only set a flag, so that the node can still publish and cancel goals while it ends.
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("picker")
    try:
        return harvest(Robot(node, stop))
    except RuntimeError as failure:
        print(failure)
        return 1
    except StopRequest:
        return 0
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    sys.exit(main())
