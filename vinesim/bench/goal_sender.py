"""A stock ROS node that sends random trajectory goals to a robot, cancels some, preempts some, and checks the results.

``python -m vinesim.bench.goal_sender --goals 50 --cancels 10 --preempts 10`` waits for the controllers of vinebot,
sends one goal after the other, and prints a JSON object for each goal and one at the end. All it knows about the robot
comes from /robot_description and /joint_states.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree

import numpy as np
import rclpy
from rclpy.action.client import ActionClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from vinesim.ros import middleware
from vinesim.ros.messages import message_packages

TIMEOUT = 120.0
"""Time limit of each wait [s]."""
CONTROLLERS = {
    "head_controller": "head_",
    "torso_controller": "torso_",
    "arm_left_controller": "arm_left_",
    "arm_right_controller": "arm_right_",
}
"""Trajectory controllers of vinebot, with the prefix of the names of their joints."""
REACH = 0.3
"""Largest distance of a joint's targets from its position at the beginning [rad, m]."""
SPEED_SHARE = 0.4
"""Largest speed in a goal, as a share of the joints' limits."""
TOLERANCE = 0.01
"""Tolerance of the goals for each joint [rad, m]."""
DELAY = 0.8
"""Time from the sending of a goal to the start of its trajectory [s]."""
FORGOTTEN = 60.0
"""Time after the end of a goal [s]. If a server still knows the goal then, it counts as never forgotten.

An action server keeps a result for 10 s and, like every server of rcl_action, forgets it within 20 s: whenever a goal
ends, the timer restarts with its previous period.
"""
PLACE_STEP = 0.001
"""Time between two points of the splines to which a message is compared [s]."""
MOMENT = 0.4
"""Time after the start of a trajectory at which it is cancelled or preempted [s]."""
UNKNOWN = 0
SUCCEEDED = 4
CANCELED = 5
ABORTED = 6
INVALID_GOAL = -1


@dataclasses.dataclass(frozen=True)
class Plan:
    """Waypoints of one goal."""

    controller: str
    joints: list[str]
    times: np.ndarray
    """Times of the waypoints [point] s after the start."""
    positions: np.ndarray
    """Positions at the waypoints [point, joint] rad, m."""
    velocities: np.ndarray
    """Velocities at the waypoints [point, joint] rad/s, m/s."""

    def at(self, begin: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns positions and velocities [time, joint] of the cubic splines at ``times`` [time] s after the start.

        ``begin``: positions at the start [joint].
        """
        knots = np.r_[0.0, self.times]
        places = np.vstack([begin, self.positions])
        speeds = np.vstack([0.0 * begin, self.velocities])
        i = np.clip(np.searchsorted(knots, times) - 1, 0, len(self.times) - 1)
        h = (knots[i + 1] - knots[i])[:, None]
        s = (times - knots[i])[:, None] / h
        p0 = places[i]
        p1 = places[i + 1]
        m0 = h * speeds[i]
        m1 = h * speeds[i + 1]
        position = (2 * s**3 - 3 * s**2 + 1) * p0 + (s**3 - 2 * s**2 + s) * m0
        position = position + (3 * s**2 - 2 * s**3) * p1 + (s**3 - s**2) * m1
        velocity = (6 * s**2 - 6 * s) * (p0 - p1) + (3 * s**2 - 4 * s + 1) * m0 + (3 * s**2 - 2 * s) * m1
        return position, velocity / h

    def velocity_off(self, begin: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> float:
        """Returns how far a ``velocity`` [joint] is from the velocity of the splines at the point where their position
        is closest to ``position`` [joint].

        Points are matched by position and not by time: the time of a client that is slower than real time skips ahead,
        its physics does not.
        """
        places, velocities = self.at(begin, np.arange(0.0, self.times[-1] + 0.5 * PLACE_STEP, PLACE_STEP))
        away = np.abs(places - position).max(1)
        here = away <= away.min() + 1e-4
        return float(np.abs(velocities[here] - velocity).max(1).min())


def plan(random: np.random.Generator, controller: str, joints: dict[str, Joint], start: np.ndarray) -> Plan:
    """Returns a random goal with one to three waypoints, from ``start`` [joint]; its velocity is zero at the last
    waypoint."""
    own = list(joints.values())
    count = int(random.integers(1, 4))
    lower, upper = (np.array([getattr(one, side) for one in own]) for side in ("lower", "upper"))
    positions = np.clip(
        [one.home for one in own] + random.uniform(-REACH, REACH, (count, len(own))), lower + 0.02, upper - 0.02
    )
    steps = np.diff(np.vstack([start, positions]), axis=0)
    spans = np.maximum((np.abs(steps) / [one.velocity for one in own]).max(1) / SPEED_SHARE * 1.5, 0.4)
    times = np.cumsum(spans)
    velocities = np.zeros_like(positions)
    for i in range(count - 1):
        velocities[i] = 0.5 * (steps[i] / spans[i] + steps[i + 1] / spans[i + 1])
    return Plan(controller, list(joints), times, positions, velocities)


@dataclasses.dataclass
class Joint:
    """Properties of a joint, from the robot description."""

    lower: float
    upper: float
    velocity: float
    home: float


class GoalSender:
    """Node that receives the robot's state and sends goals to its trajectory controllers."""

    def __init__(self) -> None:
        from control_msgs.action import FollowJointTrajectory

        self.node = rclpy.create_node("goal_sender")
        self.stamp = 0.0
        """Time of the robot's world [s]."""
        self.history: list[tuple[float, np.ndarray, np.ndarray]] = []
        """Stamp [s], positions and velocities of all joints in each message since the last goal was sent."""
        self.names: list[str] = []
        self.urdf = ""
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(String, "/robot_description", self._take_description, latched)
        self.node.create_subscription(JointState, "/joint_states", self._take, 100)
        self.node.create_subscription(Clock, "/clock", self._take_time, 1)
        self.joints: dict[str, dict[str, Joint]] = {}
        self.until(lambda: self.urdf and self.history and self.stamp and self._found_joints(), "the robot's joints")
        self.actions = {
            name: ActionClient(self.node, FollowJointTrajectory, f"/{name}/follow_joint_trajectory")
            for name in CONTROLLERS
        }
        for action in self.actions.values():
            self.until(action.server_is_ready, "the controllers")
        self.feedback: list[Any] = []

    def _found_joints(self) -> bool:
        """Returns whether each controller has joints. The description of another robot than vinebot has none of these
        joints."""
        self.joints = {name: self._joints(start) for name, start in CONTROLLERS.items()}
        return all(self.joints.values())

    def _joints(self, start: str) -> dict[str, Joint]:
        found = {}
        for element in ElementTree.fromstring(self.urdf).iterfind("joint"):
            name = element.get("name", "")
            limit = element.find("limit")
            if name.startswith(start) and name in self.names and limit is not None:
                lower, upper, velocity = (float(limit.get(key, "0")) for key in ("lower", "upper", "velocity"))
                found[name] = Joint(lower, upper, velocity, float(self.positions([name])[0]))
        return found

    def _take_description(self, message: String) -> None:
        self.urdf = message.data

    def _take(self, message: JointState) -> None:
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        self.names = list(message.name)
        self.history.append((stamp, np.array(message.position), np.array(message.velocity)))

    def _take_time(self, message: Clock) -> None:
        self.stamp = message.clock.sec + 1e-9 * message.clock.nanosec

    def positions(self, joints: list[str]) -> np.ndarray:
        """Returns the newest positions of ``joints`` [joint] rad, m."""
        return self.history[-1][1][[self.names.index(name) for name in joints]]

    def until(self, done: Callable[[], object], what: str) -> None:
        """Process messages until ``done()`` is true. Raises RuntimeError after :data:`TIMEOUT`. ``what``: text for the
        error that names the awaited event."""
        end = time.monotonic() + TIMEOUT
        while not done():
            rclpy.spin_once(self.node, timeout_sec=0.1)
            if time.monotonic() > end:
                raise RuntimeError(f"waited {TIMEOUT:.0f} s in vain for {what}")

    def wait(self, seconds: float) -> None:
        """Wait for ``seconds`` [s] of the robot's time, until its joint states have reached that time as well."""
        end = self.now() + seconds
        self.until(lambda: self.stamp >= end and self.history[-1][0] >= end, "the robot's time")

    def now(self) -> float:
        """Wait for a new message of /clock and return its time [s]."""
        for _ in range(2):  # one message may have been waiting
            before = self.stamp
            self.until(lambda before=before: self.stamp != before, "the robot's time")
        return self.stamp

    def send(self, one: Plan) -> tuple[Any, float]:
        """Send a goal. Returns its accepted handle, and the stamp of its start [s]."""
        from control_msgs.action import FollowJointTrajectory
        from control_msgs.msg import JointTolerance

        begin = self.now() + DELAY
        goal = FollowJointTrajectory.Goal(trajectory=JointTrajectory(joint_names=one.joints))
        goal.trajectory.header.stamp.sec, goal.trajectory.header.stamp.nanosec = divmod(round(begin * 1e9), 10**9)
        points = []
        for t, position, velocity in zip(one.times, one.positions, one.velocities, strict=True):
            point = JointTrajectoryPoint(positions=position.tolist(), velocities=velocity.tolist())
            point.time_from_start.sec, point.time_from_start.nanosec = divmod(round(t * 1e9), 10**9)
            points.append(point)
        goal.trajectory.points = points
        goal.goal_tolerance = [JointTolerance(name=name, position=TOLERANCE) for name in one.joints]
        goal.goal_time_tolerance.sec = 2
        self.feedback = []
        self.history = self.history[-1:]
        future = self.actions[one.controller].send_goal_async(goal, lambda m: self.feedback.append(m.feedback))
        self.until(future.done, "an answer to a goal")
        handle = future.result()
        if handle is None or not handle.accepted:
            raise RuntimeError(f"{one.controller} refused a goal")
        return handle, begin

    def result(self, handle: Any) -> tuple[int, int, str]:
        """Wait for the result of a goal; return its status, error code and text."""
        future = handle.get_result_async()
        self.until(future.done, "a result")
        answer = future.result()
        return answer.status, answer.result.error_code, answer.result.error_string


def wait_until_forgotten(status: Callable[[Any], int], handles: list[Any], longest: float) -> tuple[int, float]:
    """Poll the ``status`` of ended goals until the server knows none of them, for at most ``longest`` [s].

    Returns the number of goals that are still known, and the time that passed [s].
    """
    begin = time.monotonic()
    while handles := [handle for handle in handles if status(handle) != UNKNOWN]:
        if time.monotonic() > begin + longest:
            break
        time.sleep(0.1)
    return len(handles), time.monotonic() - begin


def judge_goal(sender: GoalSender, one: Plan, begin: float, status: tuple[int, int, str]) -> dict[str, Any]:
    """Check a goal that ran to its end: whether it succeeded, and how far positions and velocities are from it."""
    columns = [sender.names.index(name) for name in one.joints]
    sender.wait(0.2)  # on a busy machine a result comes up to a second before the joint states
    wanted = 0.0
    measured = 0.0
    # the robot stood at the start; the first feedback may be missing on a busy machine
    first = sender.history[0][1][columns]
    for told in sender.feedback:
        desired = np.array(told.desired.positions)
        speed = np.array(told.desired.velocities)
        wanted = max(wanted, one.velocity_off(first, desired, speed))
    stamps = np.array([row[0] for row in sender.history]) - begin
    speeds = np.array([row[2][columns] for row in sender.history])
    for t, velocity in zip(one.times[:-1], one.velocities[:-1], strict=True):
        found = [np.interp(t, stamps, speeds[:, i]) for i in range(len(columns))]
        measured = max(measured, float(np.abs(found - velocity).max()))
    off = float(np.abs(sender.positions(one.joints) - one.positions[-1]).max())
    return {
        "kind": "goal",
        "controller": one.controller,
        "waypoints": len(one.times),
        "text": status[2],
        "right": status[:2] == (SUCCEEDED, 0),
        "off": off,
        "wanted_velocity_off": wanted,
        "velocity_off": measured,
        "fastest": float(np.abs(speeds).max()),
    }


def cancel(sender: GoalSender, one: Plan) -> tuple[dict[str, Any], list[Any]]:
    """Send a goal and cancel it while it moves; check that the joints stop. Returns the row and the goal handles."""
    slow = dataclasses.replace(one, times=one.times * 3.0 / one.times[-1], velocities=0.0 * one.velocities)
    handle, _ = sender.send(slow)
    sender.wait(DELAY + MOMENT)
    answer = handle.cancel_goal_async()
    sender.until(answer.done, "the answer to a cancel")
    accepted = len(answer.result().goals_canceling) == 1
    status, _, text = sender.result(handle)
    sender.wait(0.5)
    stopped = sender.positions(one.joints)
    sender.wait(0.5)
    drift = float(np.abs(sender.positions(one.joints) - stopped).max())
    right = accepted and status == CANCELED
    return {"kind": "cancel", "controller": one.controller, "right": right, "drift": drift, "text": text}, [handle]


def preempt(sender: GoalSender, one: Plan, newer: Plan) -> tuple[dict[str, Any], list[Any]]:
    """Send a goal, and ``newer`` while the first one moves; check that the older is aborted and the newer succeeds.
    Returns the row and the goal handles."""
    slow = dataclasses.replace(one, times=one.times * 3.0 / one.times[-1], velocities=0.0 * one.velocities)
    first, _ = sender.send(slow)
    sender.wait(DELAY + MOMENT)
    second, begin = sender.send(newer)
    older = sender.result(first)
    row = judge_goal(sender, newer, begin, sender.result(second))
    right = row["right"] and older[:2] == (ABORTED, INVALID_GOAL)
    text = f"{older[2]}; {row['text']}".strip("; ")
    return {"kind": "preempt", "controller": one.controller, "right": right, "off": row["off"], "text": text}, [
        first,
        second,
    ]


def main(arguments: list[str] | None = None) -> int:
    """Send the goals and print the results. Returns 0 if all goals could be sent."""
    parser = argparse.ArgumentParser(prog="python -m vinesim.bench.goal_sender", description="Send goals to a robot.")
    for kind, count in (("goals", 50), ("cancels", 10), ("preempts", 10), ("seed", 1)):
        parser.add_argument(f"--{kind}", type=int, default=count)
    given = parser.parse_args(arguments)
    middleware.clear_profile()
    message_packages.ensure_importable(["control_msgs"])
    rclpy.init(args=[])
    sender = GoalSender()
    random = np.random.default_rng(given.seed)
    kinds = ["goal"] * given.goals + ["cancel"] * given.cancels + ["preempt"] * given.preempts
    handles: list[Any] = []
    for number, kind in enumerate(random.permutation(kinds)):
        controller = list(CONTROLLERS)[number % len(CONTROLLERS)]
        joints = sender.joints[controller]

        def draw(controller: str = controller, joints: dict[str, Joint] = joints) -> Plan:
            return plan(random, controller, joints, sender.positions(list(joints)))

        if kind == "goal":
            one = draw()
            handle, begin = sender.send(one)
            row = judge_goal(sender, one, begin, sender.result(handle))
            sent = [handle]
        elif kind == "cancel":
            row, sent = cancel(sender, draw())
        else:
            row, sent = preempt(sender, draw(), draw())
        handles += sent
        _print(row)
    known, seconds = wait_until_forgotten(lambda handle: sender.result(handle)[0], handles, FORGOTTEN)
    _print({"kind": "end", "sent": len(handles), "known": known, "s": seconds})
    sender.node.destroy_node()
    rclpy.shutdown()
    return 0


def _print(row: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(row) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
