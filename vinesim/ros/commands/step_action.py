"""The action simulate_steps (simulation_interfaces/SimulateSteps): steps of a paused simulation, each reported.

A goal is executed by the simulation, and its handle waits without a thread of its own: the node goes on serving.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import rclpy.node
from rclpy.action.server import CancelResponse, ServerGoalHandle

from vinesim.ros.commands.actions import RESULT_TIMEOUT, DeferredActionServer, end_goal
from vinesim.ros.commands.types import (
    GoalStatus,
    SimulationAction,
    SimulationReply,
    SimulationRequest,
    StepProgress,
)

NAME = "simulate_steps"
"""Topic, relative to the node's namespace."""


class StepAction:
    """The action server. Every goal is accepted: only an accepted one has a result that says why it was not done."""

    def __init__(
        self,
        node: rclpy.node.Node,
        ask: Callable[[SimulationRequest], None],
        numbers: Iterator[int],
        result: Callable[[SimulationReply], Any],
    ) -> None:
        """``ask`` sends a request to the simulation, with the next of the ``numbers``; ``result`` makes a
        simulation_interfaces/Result of its answer, which :meth:`answer` takes."""
        from simulation_interfaces.action import SimulateSteps

        self._type = SimulateSteps
        self._ask = ask
        self._numbers = numbers
        self._result = result
        self._goals: dict[int, ServerGoalHandle] = {}
        """Goals that are being executed, by the number of their request."""
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
        """Tell a goal's client how far it is, or how it ended; nothing happens if the goal is not known."""
        if isinstance(reply, StepProgress):
            if (handle := self._goals.get(reply.number)) is not None:
                feedback = self._type.Feedback(completed_steps=reply.completed, remaining_steps=reply.remaining)
                handle.publish_feedback(feedback)
        elif (handle := self._goals.pop(reply.number, None)) is not None:
            status = GoalStatus.ABORTED if reply.refusal else GoalStatus.SUCCEEDED
            result = self._type.Result(result=self._result(reply))
            self._server.notify_execute(handle, partial(end_goal, status, result))
