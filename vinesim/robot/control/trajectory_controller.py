"""Follows joint trajectories with tolerances, as ``joint_trajectory_controller`` of ros2_control does.

    controller = TrajectoryController(robot, robot.description.groups["arm_left"].joints)
    goal = controller.start(Trajectory(joints, times, positions), time)
    ...
    controller(time)              # each step, before robot.control(time)
    if goal.outcome is Outcome.PATH_TOLERANCE_VIOLATED: ...

Between waypoints the splines are cubic if velocities are given, else linear. Where the drives cannot follow, the limits
of the URDF hold, and the tolerances detect the error. A newer trajectory replaces the older one from its start time on,
which may lie ahead, and begins with the position and velocity that the older one has then; joints that it does not name
follow the older one to its end (``allow_trajectory_replacement`` of joint_trajectory_controller 6.8).
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Sequence

import numpy as np

from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError, CommandInterface


class Outcome(enum.IntEnum):
    """How a goal ended: error codes of control_msgs/action/FollowJointTrajectory, and two for which ROS has goal
    states."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    OLD_HEADER_TIMESTAMP = -3
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5
    CANCELED = -100
    PREEMPTED = -101


class TrajectoryError(CommandError):
    """A trajectory that cannot be followed; ``code`` is its :class:`Outcome`."""

    def __init__(self, code: Outcome, text: str) -> None:
        super().__init__(text)
        self.code = code


@dataclasses.dataclass(frozen=True, slots=True)
class Tolerance:
    """Largest permitted errors, each [joint] in the trajectory's order; infinite where there is no limit."""

    position: np.ndarray
    """[joint] rad or m"""
    velocity: np.ndarray
    """[joint] rad/s or m/s"""

    @classmethod
    def uniform(cls, count: int, position: float = np.inf, velocity: float = np.inf) -> Tolerance:
        """The same for ``count`` joints."""
        return cls(np.full(count, float(position)), np.full(count, float(velocity)))

    def violated(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Indices [k] of the joints whose errors in ``position`` or ``velocity`` [joint] are too large."""
        return np.flatnonzero((np.abs(position) > self.position) | (np.abs(velocity) > self.velocity))


@dataclasses.dataclass(frozen=True, slots=True)
class Trajectory:
    """Waypoints of some joints (trajectory_msgs/JointTrajectory), and tolerances of the goal."""

    joints: tuple[str, ...]
    times: np.ndarray
    """[point] s after the start, increasing; if the first is not 0, the spline begins at the present positions"""
    positions: np.ndarray
    """[point, joint] rad or m"""
    velocities: np.ndarray | None = None
    """[point, joint] rad/s or m/s; None: linear interpolation"""
    start_time: float = 0.0
    """Simulation time [s] at which it starts; 0: when it is accepted."""
    path_tolerance: Tolerance | None = None
    """Permitted errors on the path; None: the controller's."""
    goal_tolerance: Tolerance | None = None
    """Permitted errors at the end; None: the controller's."""
    goal_time_tolerance: float | None = None
    """[s] Permitted delay of the arrival; 0: unlimited, as in ROS; None: the controller's."""


@dataclasses.dataclass(slots=True, eq=False)
class GoalHandle:
    """One accepted trajectory and its result."""

    trajectory: Trajectory
    start_time: float
    """Simulation time [s] of its start."""
    outcome: Outcome | None = None
    """None while it is executed."""
    text: str = ""
    """Why it failed; empty if it did not."""

    @property
    def is_done(self) -> bool:
        """Whether it has ended, successfully or not."""
        return self.outcome is not None


@dataclasses.dataclass(slots=True, eq=False)
class _Spline:
    """The path of some joints of a controller."""

    start: float
    """Simulation time [s]"""
    order: np.ndarray
    """[k] its joints among those of the controller"""
    times: np.ndarray
    """[knot] s after the start"""
    positions: np.ndarray
    """[knot, k]"""
    velocities: np.ndarray | None
    """[knot, k]; None: linear interpolation"""

    def sample(self, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities [k] at ``elapsed`` [s]; at rest beyond its end."""
        knots = self.times
        points = self.positions
        if elapsed >= knots[-1]:
            return points[-1], np.zeros(points.shape[1])
        i = max(int(np.searchsorted(knots, elapsed, side="right")) - 1, 0)
        span = knots[i + 1] - knots[i]
        s = (elapsed - knots[i]) / span
        change = points[i + 1] - points[i]
        if self.velocities is None:
            return points[i] + s * change, change / span
        first = span * self.velocities[i]
        last = span * self.velocities[i + 1]
        square = 3.0 * change - 2.0 * first - last
        cube = first + last - 2.0 * change
        place = points[i] + s * (first + s * (square + s * cube))
        return place, (first + s * (2.0 * square + 3.0 * s * cube)) / span


MAX_SPLINES = 32
"""Trajectories of one controller that are executed or wait for their start; further ones are refused."""


class TrajectoryController:
    """Moves some joints of a robot along trajectories; a newer one preempts the goal of the older."""

    def __init__(
        self,
        robot: Robot,
        joints: Sequence[str],
        *,
        path_tolerance: Tolerance | None = None,
        goal_tolerance: Tolerance | None = None,
        goal_time_tolerance: float = 0.0,
    ) -> None:
        """The tolerances are those of trajectories that have none of their own; None: no limit."""
        self.robot = robot
        self.joints = tuple(joints)
        self.indices = robot.joint_indices(self.joints)
        self.path_tolerance = path_tolerance or Tolerance.uniform(len(self.joints))
        self.goal_tolerance = goal_tolerance or Tolerance.uniform(len(self.joints))
        self.goal_time_tolerance = goal_time_tolerance
        self.active_goal: GoalHandle | None = None
        """The goal that is executed, None if there is none."""
        self._splines: list[_Spline] = []
        """Oldest first; each joint follows the newest that has begun. The last is that of the active goal."""
        self.desired = robot.setpoint[self.indices].copy()
        self.desired_velocity = np.zeros(len(self.joints))
        """[joint] with :attr:`desired`, what it asks for at the end of the step [rad or m, rad/s or m/s]."""

    @property
    def is_moving(self) -> bool:
        """Whether joints follow a trajectory, or one waits for its start."""
        return bool(self._splines)

    # ------------------------------------------------------------------ commands

    def start(self, trajectory: Trajectory, time: float) -> GoalHandle:
        """Follow a trajectory from ``time`` [s], or from its own start; the goal before it is preempted.

        Joints that it does not name go on as before. Raises :class:`TrajectoryError` and changes nothing if the
        trajectory is invalid.
        """
        order = self._validate(trajectory, time)
        began = max(trajectory.start_time, time) if trajectory.start_time > 0.0 else time
        before = self._splines_before(order, began, time)
        active = self.indices[order]
        by_servo = np.isin(self.robot.interface[active], (CommandInterface.POSITION, CommandInterface.VELOCITY))
        here = np.where(
            by_servo, self.robot.setpoint[active], self.robot.rigid.joint_measurements(self.robot.name)[0][active]
        )
        moving = np.zeros(len(order))
        if began <= time:
            if self._splines:
                moving = self.desired_velocity[order]
            self.desired[order], self.desired_velocity[order] = here, moving
        else:
            resting = ~self._sample(time)[2][order]
            self.desired[order[resting]], self.desired_velocity[order[resting]] = here[resting], 0.0
            position, velocity, moved = self._sample(began)
            here = np.where(moved[order], position[order], here)
            moving = np.where(moved[order], velocity[order], 0.0)
        self._end(Outcome.PREEMPTED, "a newer trajectory took over")
        times = trajectory.times
        positions = trajectory.positions
        velocities = trajectory.velocities
        if times[0] > 0.0:
            times = np.concatenate([[0.0], times])
            positions = np.concatenate([here[None], positions])
            velocities = None if velocities is None else np.concatenate([moving[None], velocities])
        self._splines = [*before, _Spline(began, order, times, positions, velocities)]
        self.active_goal = GoalHandle(trajectory, began)
        return self.active_goal

    def _splines_before(self, order: np.ndarray, began: float, time: float) -> list[_Spline]:
        """The splines that some joints follow after ``time`` [s] yet, when joints ``order`` [k] have a new one from
        ``began`` [s] on."""
        kept: list[_Spline] = []
        taken = np.full(len(self.joints), np.inf)  # [joint] when a newer spline takes over [s]
        taken[order] = began
        for spline in reversed(self._splines):
            if (taken[spline.order] > max(time, spline.start)).any():
                kept.insert(0, spline)
                taken[spline.order] = np.minimum(taken[spline.order], spline.start)
        if len(kept) >= MAX_SPLINES:
            text = f"{len(kept)} trajectories are executed or wait for their start; cancel them, or wait"
            raise TrajectoryError(Outcome.INVALID_GOAL, f"{self.robot.name}: {text}")
        return kept

    def cancel(self) -> None:
        """Cancel the goal, and what joints follow yet of earlier ones, and hold the present positions."""
        if self._splines:
            self._end(Outcome.CANCELED, "it was cancelled")
            self._hold()

    def release(self, text: str) -> None:
        """End the goal, as another controller moves its joints from now on; ``text`` says which."""
        self._end(Outcome.PREEMPTED, text)
        self.active_goal = None
        self._splines = []

    def _validate(self, trajectory: Trajectory, time: float) -> np.ndarray:
        """Indices [joint] of the trajectory's joints among the controller's; :class:`TrajectoryError` if invalid."""
        name = self.robot.name
        t = trajectory
        unknown = [joint for joint in t.joints if joint not in self.joints]
        if unknown or len(set(t.joints)) < len(t.joints) or not t.joints:
            raise TrajectoryError(
                Outcome.INVALID_JOINTS,
                f"{name}: trajectory for {', '.join(t.joints) or 'no joints'}; this controller moves each of "
                f"{', '.join(self.joints)} once",
            )
        shape = (len(t.times), len(t.joints))
        for what, values in (("positions", t.positions), ("velocities", t.velocities)):
            if values is not None and np.shape(values) != shape:
                raise TrajectoryError(
                    Outcome.INVALID_GOAL, f"{name}: {what} of shape {np.shape(values)}; {shape} is needed"
                )
            if values is not None and not np.isfinite(values).all():
                raise TrajectoryError(Outcome.INVALID_GOAL, f"{name}: {what} are not finite; give numbers")
        for what, tolerance in (("path", t.path_tolerance), ("goal", t.goal_tolerance)):
            if tolerance is not None and not len(tolerance.position) == len(tolerance.velocity) == len(t.joints):
                raise TrajectoryError(
                    Outcome.INVALID_GOAL,
                    f"{name}: {what} tolerances for {len(tolerance.position)} joints; give one each",
                )
        if len(t.times) == 0 or not np.isfinite(t.times).all() or t.times[0] < 0.0 or (np.diff(t.times) <= 0.0).any():
            raise TrajectoryError(
                Outcome.INVALID_GOAL, f"{name}: waypoints at {list(t.times)} s; give times that increase from 0 on"
            )
        if t.start_time > 0.0 and t.start_time + t.times[-1] < time:
            raise TrajectoryError(
                Outcome.OLD_HEADER_TIMESTAMP,
                f"{name}: trajectory ended at {t.start_time + t.times[-1]:.2f} s, now is {time:.2f} s; send it in time",
            )
        return np.array([self.joints.index(joint) for joint in t.joints])

    # ------------------------------------------------------------------ each step

    def __call__(self, time: float) -> None:
        """Command the set-points of the step that starts at ``time`` [s], and check the errors after the last one.

        The desired state is that of the end of the step, where the joints will be measured.
        """
        if not self._splines:
            return
        goal = self.active_goal
        dt = self.robot.rigid.dt
        wanted, rate, _ = self._sample(time)
        ahead, ahead_rate, moved = self._sample(time, dt)
        self.desired[moved] = ahead[moved]
        self.desired_velocity[:] = np.where(moved, ahead_rate, 0.0)
        if goal is not None and time >= goal.start_time and not self._judge(goal, time, wanted, rate):
            return
        self.robot.command_position(ahead[moved], self.indices[moved])
        # From the oldest on: one that a newer has replaced must not come back when that has ended.
        while self._splines and time + dt >= self._splines[0].start + self._splines[0].times[-1]:
            if len(self._splines) == 1 and self.active_goal is not None:
                break
            self._splines.pop(0)

    def _judge(self, goal: GoalHandle, time: float, wanted: np.ndarray, rate: np.ndarray) -> bool:
        """Check the errors of a goal against the ``wanted`` positions and velocities [joint]; False if it failed."""
        position, velocity, _, _ = self.robot.rigid.joint_measurements(self.robot.name)
        spline = self._splines[-1]
        elapsed = time - goal.start_time
        order = spline.order
        active = self.indices[spline.order]
        error = wanted[order] - position[active]
        slip = rate[order] - velocity[active]
        if elapsed < spline.times[-1]:
            tolerance = goal.trajectory.path_tolerance or _reordered(self.path_tolerance, order)
            if len(off := tolerance.violated(error, slip)):
                self._fail(goal, Outcome.PATH_TOLERANCE_VIOLATED, off[0], error, slip, f"{elapsed:.2f} s on the way")
                return False
            return True
        tolerance = goal.trajectory.goal_tolerance or _reordered(self.goal_tolerance, order)
        off = tolerance.violated(error, slip)
        given = goal.trajectory.goal_time_tolerance
        late = self.goal_time_tolerance if given is None else given
        if not len(off):
            self._end(Outcome.SUCCESSFUL, "")
            self.active_goal = None
        elif late > 0.0 and elapsed > spline.times[-1] + late:
            self._fail(goal, Outcome.GOAL_TOLERANCE_VIOLATED, off[0], error, slip, f"{late:.2f} s after the end")
            return False
        return True

    def _sample(self, time: float, ahead: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions, velocities [joint] so far ``ahead`` of ``time`` [s], and whether each joint follows a spline."""
        position = self.desired.copy()
        velocity = np.zeros(len(self.joints))
        moved = np.zeros(len(self.joints), bool)
        for spline in self._splines:
            if (elapsed := time - spline.start + ahead) >= 0.0:
                position[spline.order], velocity[spline.order] = spline.sample(elapsed)
                moved[spline.order] = True
        return position, velocity, moved

    def _fail(
        self, goal: GoalHandle, outcome: Outcome, joint: int, error: np.ndarray, slip: np.ndarray, when: str
    ) -> None:
        name = goal.trajectory.joints[joint]
        self._end(outcome, f"{name} is off by {error[joint]:.4f} and {slip[joint]:.4f} a second, {when}")
        self._hold()

    def _hold(self) -> None:
        order = np.unique(np.concatenate([spline.order for spline in self._splines]))
        active = self.indices[order]
        position = self.robot.rigid.joint_measurements(self.robot.name)[0][active]
        self.robot.command_position(position, active)
        self.desired[order], self.desired_velocity[order] = position, 0.0
        self.active_goal = None
        self._splines = []

    def _end(self, outcome: Outcome, text: str) -> None:
        if self.active_goal is not None:
            self.active_goal.outcome = outcome
            self.active_goal.text = text


def _reordered(tolerance: Tolerance, order: np.ndarray) -> Tolerance:
    return Tolerance(tolerance.position[order], tolerance.velocity[order])
