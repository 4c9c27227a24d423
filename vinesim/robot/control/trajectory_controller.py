"""Follows joint trajectories with tolerances, as ``joint_trajectory_controller`` of ros2_control does.

    controller = TrajectoryController(robot, robot.description.groups["arm_left"].joints)
    goal = controller.start(Trajectory(joints, times, positions), time)
    ...
    controller(time)              # each step, before robot.control(time)
    if goal.outcome is Outcome.PATH_TOLERANCE_VIOLATED: ...

Between waypoints, interpolation is cubic if velocities are given, else linear. If the drives cannot follow, they move
within the limits of the URDF, and the tolerances detect the error. A newer trajectory replaces the older one from the
start time of the newer one, which may be in the future. It begins with the position and velocity that the older
trajectory has then. Joints that are not in the newer trajectory follow the older one to its end
(``allow_trajectory_replacement`` of joint_trajectory_controller 6.8).
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Sequence

import numpy as np

from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError, CommandInterface


class Outcome(enum.IntEnum):
    """Result of a goal: error codes of control_msgs/action/FollowJointTrajectory, and two values for which ROS uses
    goal states."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    OLD_HEADER_TIMESTAMP = -3
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5
    CANCELED = -100
    PREEMPTED = -101


class TrajectoryError(CommandError):
    """A trajectory that cannot be executed. ``code`` is the :class:`Outcome` that describes why."""

    def __init__(self, code: Outcome, text: str) -> None:
        super().__init__(text)
        self.code = code


@dataclasses.dataclass(frozen=True, slots=True)
class Tolerance:
    """Largest permitted errors, in the order of the trajectory's joints; infinite where there is no limit."""

    position: np.ndarray
    """[joint] Largest permitted position errors, rad or m."""
    velocity: np.ndarray
    """[joint] Largest permitted velocity errors, rad/s or m/s."""

    @classmethod
    def uniform(cls, count: int, position: float = np.inf, velocity: float = np.inf) -> Tolerance:
        """Returns a tolerance with the same limits for ``count`` joints."""
        return cls(np.full(count, float(position)), np.full(count, float(velocity)))

    def violated(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Returns the indices [k] of joints whose errors in ``position`` or ``velocity`` [joint] exceed the
        tolerance."""
        return np.flatnonzero((np.abs(position) > self.position) | (np.abs(velocity) > self.velocity))


@dataclasses.dataclass(frozen=True, slots=True)
class Trajectory:
    """Waypoints of some joints (trajectory_msgs/JointTrajectory), with the tolerances of a goal."""

    joints: tuple[str, ...]
    times: np.ndarray
    """[point] s after the start, increasing. If the first is not 0, the path begins at the present positions."""
    positions: np.ndarray
    """[point, joint] Positions at the waypoints, rad or m."""
    velocities: np.ndarray | None = None
    """[point, joint] Velocities at the waypoints, rad/s or m/s; None: linear interpolation."""
    start_time: float = 0.0
    """Simulation time [s] of the start; 0: the time at which the trajectory is accepted."""
    path_tolerance: Tolerance | None = None
    """Permitted errors on the path; None: the controller's tolerance."""
    goal_tolerance: Tolerance | None = None
    """Permitted errors at the end; None: the controller's tolerance."""
    goal_time_tolerance: float | None = None
    """[s] Permitted delay of the arrival; 0: unlimited, as in ROS; None: the controller's permitted delay."""


@dataclasses.dataclass(slots=True, eq=False)
class GoalHandle:
    """A trajectory that was accepted, and its result."""

    trajectory: Trajectory
    start_time: float
    """Simulation time [s] at which the trajectory starts."""
    outcome: Outcome | None = None
    """Result; None while the trajectory is being executed."""
    text: str = ""
    """Reason of a failure; empty if the trajectory succeeded."""

    @property
    def is_done(self) -> bool:
        """Whether the trajectory has ended, successfully or not."""
        return self.outcome is not None


@dataclasses.dataclass(slots=True, eq=False)
class _Spline:
    """The path of some of a controller's joints: waypoints with interpolation between them."""

    start: float
    """Simulation time [s] at which the path starts."""
    order: np.ndarray
    """[k] Indices of the joints among those of the controller."""
    times: np.ndarray
    """[knot] Times of the waypoints, s after the start."""
    positions: np.ndarray
    """[knot, k] Positions at the waypoints, rad or m."""
    velocities: np.ndarray | None
    """[knot, k] Velocities at the waypoints, rad/s or m/s; None: linear interpolation."""

    def sample(self, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """Returns positions and velocities [k] at ``elapsed`` [s] after the start. After the end, the joints rest at
        the last waypoint."""
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


LIMIT_SLACK = 1e-3
"""[rad or m] Distance by which a waypoint may be beyond a joint's limits: rounding, and the give of a stop."""
MAX_WAIT = 60.0
"""[s] Longest time for which a trajectory may wait for its start. A later start is a stamp of another clock, such as
the time of day in a simulation that began at 0."""
MAX_SPLINES = 32
"""Largest number of trajectories of one controller that are being executed or wait for their start. Further ones are
refused."""


class TrajectoryController:
    """Moves some joints of a robot along trajectories. A newer trajectory preempts the goal of an older one."""

    def __init__(
        self,
        robot: Robot,
        joints: Sequence[str],
        *,
        path_tolerance: Tolerance | None = None,
        goal_tolerance: Tolerance | None = None,
        goal_time_tolerance: float = 0.0,
    ) -> None:
        """``path_tolerance``, ``goal_tolerance``, ``goal_time_tolerance`` [s]: defaults for trajectories without
        their own tolerances. None: no limit."""
        self.robot = robot
        self.joints = tuple(joints)
        self.indices = robot.joint_indices(self.joints)
        self.path_tolerance = path_tolerance or Tolerance.uniform(len(self.joints))
        self.goal_tolerance = goal_tolerance or Tolerance.uniform(len(self.joints))
        self.goal_time_tolerance = goal_time_tolerance
        self.active_goal: GoalHandle | None = None
        """The goal that is being executed; None if there is none."""
        self._splines: list[_Spline] = []
        """Paths, oldest first. Each joint follows the newest path that has started. The last path is that of the
        active goal."""
        self.desired = robot.setpoint[self.indices].copy()
        self.desired_velocity = np.zeros(len(self.joints))
        """[joint] Velocity at the end of the present step [rad/s or m/s]. :attr:`desired` is the position at that
        time [rad or m]."""

    @property
    def is_moving(self) -> bool:
        """Whether a trajectory is being executed or waits for its start."""
        return bool(self._splines)

    # ------------------------------------------------------------------ commands

    def start(self, trajectory: Trajectory, time: float) -> GoalHandle:
        """Start to follow a trajectory at its start time, or at ``time`` [s] if it has none. The active goal is
        preempted.

        Joints that are not in the trajectory continue as before. Raises :class:`TrajectoryError` and changes nothing if
        the trajectory is invalid.
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
        """Returns the paths that some joints still follow after ``time`` [s], if the joints ``order`` [k] (indices)
        get a new path that starts at ``began`` [s]."""
        kept: list[_Spline] = []
        taken = np.full(len(self.joints), np.inf)  # [joint] time at which a newer spline takes over [s]
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
        """Cancel the active goal and all paths, also those of earlier trajectories, and hold the present positions."""
        if self._splines:
            self._end(Outcome.CANCELED, "it was cancelled")
            self._hold()

    def release(self, text: str) -> None:
        """End the active goal because another controller takes over its joints. ``text``: the reason, with the name
        of that controller."""
        self._end(Outcome.PREEMPTED, text)
        self.active_goal = None
        self._splines = []

    def _validate(self, trajectory: Trajectory, time: float) -> np.ndarray:
        """Returns the indices [joint] of the trajectory's joints among those of the controller. Raises
        :class:`TrajectoryError` if the trajectory is invalid."""
        name = self.robot.name
        t = trajectory
        unknown = [joint for joint in t.joints if joint not in self.joints]
        if unknown or len(set(t.joints)) < len(t.joints) or not t.joints:
            raise TrajectoryError(
                Outcome.INVALID_JOINTS,
                f"{name}: trajectory for {', '.join(t.joints) or 'no joints'}; name joints among "
                f"{', '.join(self.joints)}, each at most once",
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
        if t.start_time > time + MAX_WAIT:
            raise TrajectoryError(
                Outcome.INVALID_GOAL,
                f"{name}: trajectory starts at {t.start_time:.2f} s, {t.start_time - time:.0f} s from now; stamp it "
                f"with the time of /clock, at most {MAX_WAIT:g} s ahead, or with 0 to start at once",
            )
        order = np.array([self.joints.index(joint) for joint in t.joints])
        self._check_limits(t, self.indices[order])
        return order

    def _check_limits(self, trajectory: Trajectory, joints: np.ndarray) -> None:
        """Raise :class:`TrajectoryError` if a waypoint is beyond the limits of one of the robot's ``joints`` [k].

        A joint that was pushed beyond a limit may begin there.
        """
        robot = self.robot
        here = robot.rigid.joint_measurements(robot.name)[0][joints]
        lower = np.minimum(robot.lower_limit[joints], here) - LIMIT_SLACK
        upper = np.maximum(robot.upper_limit[joints], here) + LIMIT_SLACK
        beyond = np.argwhere((trajectory.positions < lower) | (trajectory.positions > upper))
        if len(beyond):
            point, column = beyond[0].tolist()
            joint = joints[column]
            raise TrajectoryError(
                Outcome.INVALID_GOAL,
                f"{robot.name}: point {point} moves {trajectory.joints[column]} to "
                f"{trajectory.positions[point, column]:.4f}, its limits are {robot.lower_limit[joint]:.4f} and "
                f"{robot.upper_limit[joint]:.4f}; give a position between them",
            )

    # ------------------------------------------------------------------ each step

    def __call__(self, time: float) -> None:
        """Command the set-points of the step that starts at ``time`` [s], and check the errors after the previous step.

        The desired state is the one at the end of the step, because the joints are measured then.
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
        # Oldest first, so that a spline that a newer one has replaced does not take over again when the newer one ends.
        while self._splines and time + dt >= self._splines[0].start + self._splines[0].times[-1]:
            if len(self._splines) == 1 and self.active_goal is not None:
                break
            self._splines.pop(0)

    def _judge(self, goal: GoalHandle, time: float, wanted: np.ndarray, rate: np.ndarray) -> bool:
        """Check the errors of a goal against its tolerances. ``wanted``, ``rate`` [joint]: desired positions and
        velocities. Returns False if the goal has failed."""
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
        """Returns, for ``time`` + ``ahead`` [s], the desired positions and velocities [joint], and whether each
        joint follows a path [joint]."""
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
        """End a goal with an error of one joint, and hold the present positions."""
        name = goal.trajectory.joints[joint]
        self._end(outcome, f"{name} is off by {error[joint]:.4f} and {slip[joint]:.4f} a second, {when}")
        self._hold()

    def _hold(self) -> None:
        """Drop all paths and hold their joints at the present positions."""
        order = np.unique(np.concatenate([spline.order for spline in self._splines]))
        active = self.indices[order]
        position = self.robot.rigid.joint_measurements(self.robot.name)[0][active]
        self.robot.command_position(position, active)
        self.desired[order], self.desired_velocity[order] = position, 0.0
        self.active_goal = None
        self._splines = []

    def _end(self, outcome: Outcome, text: str) -> None:
        """Set the result of the active goal, if there is one."""
        if self.active_goal is not None:
            self.active_goal.outcome = outcome
            self.active_goal.text = text


def _reordered(tolerance: Tolerance, order: np.ndarray) -> Tolerance:
    """Returns the tolerance of the joints ``order`` [k]."""
    return Tolerance(tolerance.position[order], tolerance.velocity[order])
