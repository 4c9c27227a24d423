"""Requests from ROS to a client's simulation: pause, single steps, reset, and entities of the world."""

from __future__ import annotations

import collections
from collections.abc import Callable
from typing import Any

from vinesim.client.client import Client
from vinesim.client.tasks.entities import WorldEditor
from vinesim.ros.commands.types import (
    EntityArguments,
    Refusal,
    RequestRefused,
    SimulationAction,
    SimulationReply,
    SimulationRequest,
    StepProgress,
)

MAX_STEPS = 100_000
"""Largest number of steps in one request."""


class SimulationControl:
    """Answers requests between the steps of one client; any thread may :meth:`put` requests.

    Only a client without a server may pause. If other clients were present, its actors would stand still for them, and
    they would take over its objects.
    """

    def __init__(self, client: Client, reply: Callable[[SimulationReply | StepProgress], None]) -> None:
        self._client = client
        self._reply = reply
        self._editor = WorldEditor(client)
        self._requests: collections.deque[SimulationRequest] = collections.deque()
        self._stepping: SimulationRequest | None = None
        """Request whose steps are being simulated."""
        self._reported_steps = 0
        """Number of steps of the present request that a :class:`StepProgress` has reported."""

    def put(self, request: SimulationRequest) -> None:
        """Add a request."""
        self._requests.append(request)

    def __call__(self) -> None:
        """Answer all requests that can be answered now. Call it between two steps."""
        self._follow_steps()
        while self._requests:
            self._serve(self._requests.popleft())

    def end_steps(self, reason: str) -> None:
        """End the requested steps that are being simulated, if any, refuse their request, and pause."""
        if (request := self._stepping) is None:
            return
        done = request.steps - (self._client.steps_before_pause or 0)
        self._stepping = None
        self._client.steps_before_pause = 0
        self._answer(request, refusal=f"{reason} after {done} of {request.steps} steps", kind=Refusal.FAILED)

    def _follow_steps(self) -> None:
        """Report the step since the last call, and answer the request after its last step."""
        if (request := self._stepping) is None:
            return
        remaining = self._client.steps_before_pause or 0
        done = request.steps - remaining
        if request.wants_progress and done > self._reported_steps:
            self._reported_steps = done
            self._reply(StepProgress(request.number, done, remaining))
        if not remaining:
            self._stepping = None
            self._answer(request)

    def _serve(self, request: SimulationRequest) -> None:
        if request.action is SimulationAction.CANCEL_STEPS:
            if self._stepping is not None and self._stepping.number == request.number:
                self.end_steps("cancelled")
            return
        try:
            result = self._do(request)
        except RequestRefused as error:
            self._answer(request, refusal=str(error), kind=error.kind)
        else:
            if self._stepping is not request:
                self._answer(request, **result)

    def _do(self, request: SimulationRequest) -> dict[str, Any]:
        """Execute a request that needs no steps. Returns the values of its answer, except the time and whether the
        simulation is paused."""
        editor = self._editor
        arguments = request.entity or EntityArguments("")
        match request.action:
            case SimulationAction.GET_ENTITIES:
                return {"entities": tuple(editor.entities())}
            case SimulationAction.GET_SPAWNABLES:
                return {"spawnables": editor.spawnables}
            case SimulationAction.SPAWN:
                return {"name": editor.spawn(arguments)}
            case SimulationAction.DELETE:
                editor.delete(arguments.name)
            case SimulationAction.SET_ENTITY_STATE:
                editor.set_state(arguments)
            case SimulationAction.RESET:
                editor.reset(keep_state=request.keep_state, keep_spawned=request.keep_spawned)
                self.end_steps("ended by reset")
            case SimulationAction.PLAY | SimulationAction.PAUSE | SimulationAction.STEP:
                self._play(request)
        return {}

    def _play(self, request: SimulationRequest) -> None:
        """Let the simulation run, pause it, or begin to simulate the requested number of steps."""
        client = self._client
        is_step = request.action is SimulationAction.STEP
        if client.world_time.is_shared:
            text = "a client of a shared world cannot pause; start it without --connect"
            # StepSimulation and SimulateSteps define this code for a running simulation
            raise RequestRefused(Refusal.FAILED if is_step else Refusal.INCORRECT_STATE, text)
        if not is_step:
            self.end_steps(f"ended by {request.action}")
            client.steps_before_pause = 0 if request.action is SimulationAction.PAUSE else None
        elif client.steps_before_pause is None:
            raise RequestRefused(Refusal.FAILED, "the simulation runs; pause it first")
        elif self._stepping is not None:
            raise RequestRefused(Refusal.FAILED, "other steps are being simulated; wait for them, or cancel them")
        elif not 1 <= request.steps <= MAX_STEPS:
            raise RequestRefused(Refusal.FAILED, f"{request.steps} steps; give 1 to {MAX_STEPS}")
        else:
            client.steps_before_pause = request.steps
            self._stepping = request
            self._reported_steps = 0

    def _answer(self, request: SimulationRequest, **values: Any) -> None:
        client = self._client
        now = client.physics.time + client.world_time.offset
        self._reply(SimulationReply(request.number, now, client.steps_before_pause is not None, **values))
