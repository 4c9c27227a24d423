"""Runs the controllers of one robot. Each joint obeys only the controller that was commanded last.

A command to one controller ends the goals of all other controllers that move any of its joints. The sender of a goal
gives the goal an id. :meth:`ControllerManager.take_results` returns the results of goals that have ended.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from vinesim.robot.control.gripper_controllers import CONTROLLERS, GripperController
from vinesim.robot.control.trajectory_controller import (
    GoalHandle,
    Outcome,
    Trajectory,
    TrajectoryController,
    TrajectoryError,
)
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.scene.values import ControllerKind, ControllerSpec, GripperState


@dataclasses.dataclass(frozen=True, slots=True)
class GoalResult:
    """Result of a goal that has ended."""

    goal: bytes
    outcome: Outcome
    text: str = ""
    """Reason of a failure; empty if the goal succeeded."""
    gripper: GripperState | None = None
    """State of the gripper, for a goal of a gripper; otherwise None."""


@dataclasses.dataclass(slots=True)
class _ActiveGoal:
    """A goal that is being executed."""

    id: bytes
    trajectory: GoalHandle | None
    """Handle of the trajectory; None for a goal of a gripper."""


class ControllerManager:
    """The controllers of a local robot. Only the physics thread may call its methods."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.specs = {spec.name: spec for spec in robot.description.controllers}
        joints = robot.description.joints
        self.desired = robot.setpoint.copy()
        self.desired_velocity = np.zeros(len(joints))
        """[joint] Velocity that the controllers request in this step [rad/s or m/s]. :attr:`desired` is the
        requested position [rad or m]."""
        self._indices = {spec.name: robot.joint_indices(spec.joints) for spec in self.specs.values()}
        self._owner: list[str | None] = [None] * len(joints)
        """[joint] Name of the controller that moves the joint; None if there is none."""
        self._follows = np.zeros(len(joints), bool)
        """[joint] Whether a trajectory controller moves the joint."""
        self._trajectories: dict[str, TrajectoryController] = {}
        self._grippers: dict[str, GripperController] = {}
        self._goals: dict[str, _ActiveGoal] = {}
        """Active goal of each controller, by name of the controller."""
        self._results: list[GoalResult] = []
        self._gains: dict[str, dict[str, np.ndarray]] = {}
        self._ends = np.full(len(joints), np.inf)
        """[joint] Time at which a velocity or an effort of another controller manager ends [s]; infinite if the
        joint has none."""

    # ------------------------------------------------------------------ goals

    def start_trajectory(self, name: str, trajectory: Trajectory, time: float, goal: bytes | None = None) -> None:
        """Start to follow a trajectory, with the controller ``name``, at ``time`` [s]. ``goal``: id of the goal; None
        if nobody waits for its result. Raises :class:`CommandError` for an unknown controller.

        If the trajectory is invalid, its goal ends at once; without a goal, :class:`TrajectoryError` is raised.
        """
        spec = self._spec(name, ControllerKind.JOINT_TRAJECTORY)
        if name not in self._trajectories:
            self._trajectories[name] = TrajectoryController(self.robot, spec.joints)
        controller = self._trajectories[name]
        before = self._goals.get(name)
        try:
            handle = controller.start(trajectory, time)
        except TrajectoryError as error:
            if goal is None:
                raise
            self._results.append(GoalResult(goal, error.code, str(error)))
            return
        if before is not None:
            self._end(name, Outcome.PREEMPTED, "a newer trajectory took over")
        self._claim(name)
        if goal is not None:
            self._goals[name] = _ActiveGoal(goal, handle)

    def stop_trajectory(self, name: str) -> None:
        """Stop the motion of a trajectory controller, end its goal, and hold its joints."""
        self._spec(name, ControllerKind.JOINT_TRAJECTORY)
        if name in self._trajectories:
            self._trajectories[name].cancel()
            self._take_desired(name)
            self._end(name, Outcome.CANCELED, "an empty trajectory stopped it")

    def start_gripper(self, name: str, position: float, effort: float | None, time: float, goal: bytes) -> None:
        """Start a goal of a gripper. The meaning of ``position`` and ``effort`` depends on its
        :class:`GripperController`."""
        spec = self._spec(name, ControllerKind.GRIPPER)
        try:
            if name not in self._grippers:
                self._grippers[name] = CONTROLLERS[spec.gripper](self.robot, spec.group)
            self._grippers[name].start(position, effort, time)
        except CommandError as error:
            self._results.append(GoalResult(goal, Outcome.INVALID_GOAL, str(error), self._gripper_state(name, time)))
            return
        self._end(name, Outcome.PREEMPTED, "a newer goal took over", time)
        self._claim(name)
        self._goals[name] = _ActiveGoal(goal, None)

    def cancel(self, goal: bytes, time: float) -> None:
        """Cancel a goal and hold its joints. Nothing happens if the goal has ended already."""
        for name, active in list(self._goals.items()):
            if active.id == goal:
                if name in self._trajectories:
                    self._trajectories[name].cancel()
                    self._take_desired(name)
                elif name in self._grippers:
                    self._grippers[name].cancel(time)
                self._end(name, Outcome.CANCELED, "it was cancelled", time)

    def cancel_all(self, time: float) -> None:
        """Cancel all goals and hold their joints."""
        for active in list(self._goals.values()):
            self.cancel(active.id, time)

    def abort_all(self, text: str) -> None:
        """Abort all goals. ``text``: the reason."""
        for name in list(self._goals):
            self._end(name, Outcome.PREEMPTED, text)

    def take_results(self) -> list[GoalResult]:
        """Returns the results of the goals that ended since the last call."""
        results = self._results
        self._results = []
        return results

    # ------------------------------------------------------------------ commands without a goal

    def forward(self, name: str, values: np.ndarray) -> None:
        """Command the joints of a forward controller by ``values`` [joint]: positions, velocities or efforts. NaN
        leaves a joint as it is."""
        spec = self.specs.get(name)
        commands = {
            ControllerKind.FORWARD_POSITION: self.robot.command_position,
            ControllerKind.FORWARD_VELOCITY: self.robot.command_velocity,
            ControllerKind.FORWARD_EFFORT: self.robot.command_effort,
        }
        if spec is None or spec.kind not in commands:
            raise CommandError(f"{self.robot.name} has no forward controller {name!r}")
        self._pass_on(spec, values, commands[spec.kind])

    def command_hardware(
        self,
        name: str,
        joints: Sequence[str],
        position: np.ndarray,
        velocity: np.ndarray,
        effort: np.ndarray,
        time: float,
    ) -> None:
        """Command ``joints`` [k] of a controller of the kind ``topic_based`` at ``time`` [s]. NaN: no command. A joint
        with several commands obeys its position, else its velocity.

        Velocities and efforts end after the controller's timeout; then the joint stops. Positions are held.
        """
        spec = self._spec(name, ControllerKind.TOPIC_BASED)
        if foreign := [joint for joint in joints if joint not in spec.joints]:
            raise CommandError(f"{name} of {self.robot.name} does not move {', '.join(foreign)}")
        indices = self.robot.joint_indices(joints)
        free = np.ones(len(indices), bool)
        end = time + (np.inf if spec.hardware is None else spec.hardware.timeout)
        for values, command, until in (
            (position, self.robot.command_position, np.inf),
            (velocity, self.robot.command_velocity, end),
            (effort, self.robot.command_effort, end),
        ):
            given = free & ~np.isnan(values)
            free &= ~given
            if given.any():
                command(values[given], indices[given])
                self._ends[indices[given]] = until
        self._claim(name, indices[~free])

    def _end_commands(self, time: float) -> None:
        """Stop the joints whose last velocity or effort from another controller manager is too old."""
        late = np.flatnonzero(time > self._ends)
        if len(late):
            self._ends[late] = np.inf
            self.robot.command_velocity(np.zeros(len(late)), late)

    def command_impedance(self, name: str, what: str, values: np.ndarray) -> None:
        """Set the stiffness or damping of an impedance controller's joints, or move its equilibrium. ``what``:
        "stiffness", "damping" or "equilibrium". ``values`` [joint]."""
        spec = self._spec(name, ControllerKind.IMPEDANCE)
        if what == "equilibrium":
            self._pass_on(spec, values, self.robot.command_position)
            return
        joints = self._indices[name]
        if name not in self._gains:
            drives = [self.robot.description.drives[i] for i in joints]
            self._gains[name] = {
                "stiffness": np.array([drive.stiffness for drive in drives]),
                "damping": np.array([drive.damping for drive in drives]),
            }
        gains = self._gains[name] | {what: np.asarray(values, float)}
        self.robot.command_impedance(gains["stiffness"], gains["damping"], joints)
        self._gains[name] = gains

    def command_motor(self, name: str, joint: str, position: float) -> None:
        """Hold the motor of a series elastic joint at ``position`` [rad or m], converted to the joint side."""
        spec = self._spec(name, ControllerKind.SERIES_ELASTIC)
        if joint not in spec.joints:
            raise CommandError(
                f"{name} of {self.robot.name} does not move {joint!r}; it moves {', '.join(spec.joints)}"
            )
        self.robot.command_motor_position([position], [joint])
        self._claim(name, self.robot.joint_indices([joint]))

    # ------------------------------------------------------------------ each step

    def __call__(self, time: float) -> None:
        """Command the set-points of the step that starts at ``time`` [s]. Call this before :meth:`Robot.control`."""
        self._end_commands(time)
        for name, controller in self._trajectories.items():
            active = self._goals.get(name)
            if controller.is_moving:
                controller(time)
                self._take_desired(name)
            if active is not None and active.trajectory is not None and active.trajectory.outcome is not None:
                self._end(name, active.trajectory.outcome, active.trajectory.text)
        for name in list(self._goals):
            state = self._gripper_state(name, time)
            if state is not None and state.is_done:
                self._results.append(GoalResult(self._goals.pop(name).id, Outcome.SUCCESSFUL, "", state))
        np.copyto(self.desired, self.robot.setpoint, where=~self._follows)
        self.desired_velocity[~self._follows] = 0.0

    def _take_desired(self, name: str) -> None:
        """Copy the desired state of a trajectory controller's joints into :attr:`desired` and
        :attr:`desired_velocity`."""
        joints = self._indices[name]
        controller = self._trajectories[name]
        self.desired[joints], self.desired_velocity[joints] = controller.desired, controller.desired_velocity

    def _gripper_state(self, name: str, time: float) -> GripperState | None:
        """Returns the state of a gripper's goal; None if ``name`` is not the controller of a gripper."""
        return self._grippers[name].state(time) if name in self._grippers else None

    # ------------------------------------------------------------------ claims

    def _pass_on(self, spec: ControllerSpec, values: np.ndarray, command: Callable[..., None]) -> None:
        """Command the joints of a controller that have a value other than NaN, and make the controller their owner."""
        if len(values) != len(spec.joints):
            raise CommandError(
                f"{self.robot.name}: {len(values)} values for {spec.name}; give one each for {', '.join(spec.joints)}"
            )
        given = ~np.isnan(values)
        joints = self._indices[spec.name][given]
        command(values[given], joints)
        self._claim(spec.name, joints)

    def _claim(self, name: str, joints: np.ndarray | None = None) -> None:
        """Make a controller the owner of ``joints`` (indices; all its joints unless given). Goals of other
        controllers on these joints are aborted."""
        joints = self._indices[name] if joints is None else joints
        others = {self._owner[j] for j in joints} - {None, name}
        for other in sorted(o for o in others if o is not None):
            if other in self._trajectories:
                self._trajectories[other].release(f"{name} took over")
            self._end(other, Outcome.PREEMPTED, f"{name} took over joints of {other}")
        for j in joints:
            self._owner[j] = name
        if self.specs[name].hardware is None:
            self._ends[joints] = np.inf
        self._follows[joints] = name in self._trajectories

    def _end(self, name: str, outcome: Outcome, text: str, time: float = 0.0) -> None:
        """End the active goal of a controller, if there is one, and keep its result."""
        active = self._goals.pop(name, None)
        if active is not None:
            self._results.append(GoalResult(active.id, outcome, text, self._gripper_state(name, time)))

    def _spec(self, name: str, kind: ControllerKind) -> ControllerSpec:
        """Returns a controller by name. Raises :class:`CommandError` if it does not exist or is of another kind."""
        spec = self.specs.get(name)
        if spec is None or spec.kind is not kind:
            known = ", ".join(one.name for one in self.specs.values() if one.kind is kind) or "none"
            raise CommandError(f"{self.robot.name} has no {kind} controller {name!r}; there are: {known}")
        return spec
