"""Action servers of trajectory controllers and grippers, with the control_msgs actions of ros2_controllers.

A goal is checked here and executed by the client. Its goal handle waits, without its own thread or task, for the result
from the client. A newer goal of a controller ends the older goal, which is aborted.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
import rclpy.node
from rclpy.action.server import ActionServer, CancelResponse, GoalResponse, ServerGoalHandle

from vinesim.ros.commands import convert
from vinesim.ros.commands.subscriptions import CommandQueue
from vinesim.ros.commands.types import (
    CancelGoal,
    GoalResult,
    GoalStatus,
    GripperGoal,
    JointTrajectory,
    SimulationAction,
    SimulationReply,
    SimulationRequest,
    StepProgress,
)
from vinesim.ros.messages.convert import reference_points, stamp
from vinesim.scene.values import ControllerKind, ControllerSpec, RobotSample

log = logging.getLogger(__name__)

RESULT_TIMEOUT = 10
"""[s] Time for which a result is kept for action clients that request it: the default of rcl since Iron."""
MAX_GOALS = 32
"""Largest number of goals of one robot that are executed at the same time. Further goals are rejected."""


class DeferredActionServer(ActionServer):
    """An action server whose accepted goals have the state EXECUTING, but no execution task. The owner of the server
    calls :meth:`notify_execute` with a callback once the result is known."""

    def notify_execute(self, goal_handle: ServerGoalHandle, execute_callback: Callable[..., Any] | None) -> None:
        if execute_callback is not None:
            super().notify_execute(goal_handle, execute_callback)


class ActiveGoal:
    """A goal that was accepted and has no result yet."""

    def __init__(self, server: ActionServer, handle: ServerGoalHandle, command: JointTrajectory | GripperGoal) -> None:
        self.server = server
        self.handle = handle
        self.command = command


class ControllerActions:
    """The action servers of a robot's ``controllers``. Accepted goals are put into ``queue``."""

    def __init__(self, node: rclpy.node.Node, controllers: Sequence[ControllerSpec], queue: CommandQueue) -> None:
        from control_msgs.action import FollowJointTrajectory, GripperCommand

        self._queue = queue
        self._lock = threading.Lock()
        self._goals: dict[bytes, ActiveGoal] = {}
        self._trajectory_type = FollowJointTrajectory
        self._gripper_type = GripperCommand
        for spec in controllers:
            if spec.kind is ControllerKind.JOINT_TRAJECTORY:
                take = partial(convert.trajectory_goal, controller=spec.name, known=spec.joints, renamed=spec.renamed)
                self._serve(node, FollowJointTrajectory, f"{spec.name}/follow_joint_trajectory", take)
            elif spec.kind is ControllerKind.GRIPPER:
                take = partial(convert.gripper_goal, controller=spec.name)
                self._serve(node, GripperCommand, f"{spec.name}/gripper_cmd", take)

    def _serve(
        self, node: rclpy.node.Node, action: Any, name: str, take: Callable[..., JointTrajectory | GripperGoal]
    ) -> None:
        """Create the action server ``name``. ``take`` converts a goal request to a command."""
        server = DeferredActionServer(
            node,
            action,
            name,
            lambda _: action.Result(),
            goal_callback=partial(self._judge, take),
            cancel_callback=self._cancel,
            result_timeout=RESULT_TIMEOUT,
        )
        server.register_handle_accepted_callback(partial(self._begin, server, take))

    # ------------------------------------------------------------------ in the receiving thread

    def _judge(self, take: Callable[..., object], request: Any) -> GoalResponse:
        """Returns whether a goal request is accepted: it must be valid, and fewer than :data:`MAX_GOALS` goals may be
        executing."""
        try:
            take(request, goal=b"")
            if len(self._goals) >= MAX_GOALS:
                raise convert.CommandError(f"{MAX_GOALS} goals are being executed already; wait for one to end")
        except convert.CommandError as error:
            self._queue.refuse(error)
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _begin(
        self, server: ActionServer, take: Callable[..., JointTrajectory | GripperGoal], handle: ServerGoalHandle
    ) -> None:
        """Start to execute an accepted goal: queue its command for the client."""
        goal = bytes(handle.goal_id.uuid)
        command = take(handle.request, goal=goal)
        handle.execute()
        with self._lock:
            self._goals[goal] = ActiveGoal(server, handle, command)
        self._queue.put(command)

    def _cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        """Accept a cancel request and queue it for the client."""
        self._queue.put(CancelGoal(bytes(handle.goal_id.uuid)))
        return CancelResponse.ACCEPT

    # ------------------------------------------------------------------ in the publishing thread

    @property
    def goals(self) -> list[ActiveGoal]:
        """The goals that are being executed."""
        with self._lock:
            return list(self._goals.values())

    def publish_feedback(self, sample: RobotSample) -> None:
        """Publish feedback for all trajectory goals."""
        places = {name: i for i, name in enumerate(sample.joints.names)}
        for goal in self.goals:
            if isinstance(goal.command, JointTrajectory):
                joints = goal.command.joints
                points = reference_points(sample, np.array([places[joint] for joint in joints]))
                message = self._trajectory_type.Feedback(joint_names=list(joints), **points)
                message.header.stamp = stamp(sample.joints.time)
                goal.handle.publish_feedback(message)

    def finish(self, result: GoalResult) -> None:
        """Send the result of a goal to its action client. Nothing happens for an unknown goal."""
        with self._lock:
            goal = self._goals.pop(result.goal, None)
        if goal is None:
            return
        if isinstance(goal.command, JointTrajectory):
            message = self._trajectory_type.Result(error_code=result.code, error_string=result.text)
        else:
            message = self._gripper_type.Result()
            if (gripper := result.gripper) is not None:
                message.position = gripper.position
                message.effort = gripper.effort
                message.stalled = gripper.stalled
                message.reached_goal = gripper.reached_goal
        goal.server.notify_execute(goal.handle, partial(end_goal, result.status, message))


def end_goal(status: GoalStatus, result: Any, handle: ServerGoalHandle) -> Any:
    """Bring a goal handle into its final state and return ``result``. A goal for which a cancel request came too
    late stays succeeded or aborted."""
    if handle.is_cancel_requested and status is not GoalStatus.SUCCEEDED:
        handle.canceled()
    elif status is GoalStatus.SUCCEEDED:
        handle.succeed()
    else:
        handle.abort()
    return result


# The action simulate_steps (simulation_interfaces/SimulateSteps): steps of a paused simulation, with feedback for each.
#
# The simulation executes a goal. The goal handle waits without its own thread, so the node can serve other requests.


NAME = "simulate_steps"
"""Name of the action, relative to the node's namespace."""


class StepAction:
    """The action server of ``simulate_steps``. It accepts every goal, because only an accepted goal has a result
    with the reason of a refusal."""

    def __init__(
        self,
        node: rclpy.node.Node,
        ask: Callable[[SimulationRequest], None],
        numbers: Iterator[int],
        result: Callable[[SimulationReply], Any],
    ) -> None:
        """``ask`` sends a request to the simulation, numbered by the next of ``numbers``. The simulation's replies
        are passed to :meth:`answer`. ``result`` converts a reply to a simulation_interfaces/Result."""
        from simulation_interfaces.action import SimulateSteps

        self._type = SimulateSteps
        self._ask = ask
        self._numbers = numbers
        self._result = result
        self._goals: dict[int, ServerGoalHandle] = {}
        """Goals that are being executed, by the number of their request to the simulation."""
        self._server = DeferredActionServer(
            node,
            SimulateSteps,
            NAME,
            lambda _: SimulateSteps.Result(),
            cancel_callback=self._cancel,
            result_timeout=RESULT_TIMEOUT,
        )
        self._server.register_handle_accepted_callback(self._begin)

    # ------------------------------------------------------------------ in the receiving thread

    def _begin(self, handle: ServerGoalHandle) -> None:
        number = next(self._numbers)
        handle.execute()
        self._goals[number] = handle
        self._ask(SimulationRequest(number, SimulationAction.STEP, int(handle.request.steps), wants_progress=True))

    def _cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        for number, goal in list(self._goals.items()):
            if goal is handle:
                self._ask(SimulationRequest(number, SimulationAction.CANCEL_STEPS))
        return CancelResponse.ACCEPT

    # ------------------------------------------------------------------ in any thread

    def answer(self, reply: SimulationReply | StepProgress) -> None:
        """Publish the progress of a goal as feedback, or send its result. Nothing happens for an unknown goal."""
        if isinstance(reply, StepProgress):
            if (handle := self._goals.get(reply.number)) is not None:
                feedback = self._type.Feedback(completed_steps=reply.completed, remaining_steps=reply.remaining)
                handle.publish_feedback(feedback)
        elif (handle := self._goals.pop(reply.number, None)) is not None:
            status = GoalStatus.ABORTED if reply.refusal else GoalStatus.SUCCEEDED
            result = self._type.Result(result=self._result(reply))
            self._server.notify_execute(handle, partial(end_goal, status, result))
