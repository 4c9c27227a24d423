"""Requests of ROS to a client's simulation: pause, single steps, reset, and what is in the world."""

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
)

MAX_STEPS = 100_000
"""Steps that one request may ask for."""


class SimulationControl:
    """Answers requests between the steps of one client; any thread may :meth:`put` them.

    Only a client without a server pauses: others would see its actors stand still and take their objects.
    """

    def __init__(self, client: Client, reply: Callable[[SimulationReply], None]) -> None:
        self._client, self._reply = client, reply
        self._editor = WorldEditor(client)
        self._requests: collections.deque[SimulationRequest] = collections.deque()
        self._stepping: SimulationRequest | None = None
        """A request whose steps are being simulated."""

    def put(self, request: SimulationRequest) -> None:
        """Add a request."""
        self._requests.append(request)

    def __call__(self) -> None:
        """Answer what can be answered now; call it between two steps."""
        client = self._client
        if self._stepping is not None:
            if client.steps_before_pause:
                return
            self._answer(self._stepping)
            self._stepping = None
        while self._requests and self._stepping is None:
            self._serve(self._requests.popleft())

    def _serve(self, request: SimulationRequest) -> None:
        try:
            result = self._do(request)
        except RequestRefused as error:
            self._answer(request, refusal=str(error), kind=error.kind)
        else:
            if self._stepping is None:
                self._answer(request, **result)

    def _do(self, request: SimulationRequest) -> dict[str, Any]:
        """Do what can be done at once; what the answer says beside time and pause."""
        editor, arguments = self._editor, request.entity or EntityArguments("")
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
            case SimulationAction.PLAY | SimulationAction.PAUSE | SimulationAction.STEP:
                self._play(request)
        return {}

    def _play(self, request: SimulationRequest) -> None:
        """Play, pause, or begin to step."""
        client = self._client
        if client.world_time.is_shared:
            text = "a client of a shared world cannot pause; start it without --connect"
            raise RequestRefused(Refusal.INCORRECT_STATE, text)
        if request.action is not SimulationAction.STEP:
            client.steps_before_pause = 0 if request.action is SimulationAction.PAUSE else None
        elif client.steps_before_pause is None:
            raise RequestRefused(Refusal.INCORRECT_STATE, "the simulation runs; pause it first")
        elif not 1 <= request.steps <= MAX_STEPS:
            raise RequestRefused(Refusal.FAILED, f"{request.steps} steps; give 1 to {MAX_STEPS}")
        else:
            client.steps_before_pause, self._stepping = request.steps, request

    def _answer(self, request: SimulationRequest, **values: Any) -> None:
        client = self._client
        now = client.physics.time + client.world_time.offset
        self._reply(SimulationReply(request.number, now, client.steps_before_pause is not None, **values))
