"""Requests of ROS to a client's simulation: pause, single steps, and what is in the world."""

from __future__ import annotations

import collections
from collections.abc import Callable, Iterator

import numpy as np

from vinesim import frames
from vinesim.client.client import Client
from vinesim.client.remote.remote_human import RemoteHuman
from vinesim.ros.commands.types import Entity, EntityCategory, SimulationAction, SimulationReply, SimulationRequest

MAX_STEPS = 100_000
"""Steps that one request may ask for."""
_UNKNOWN = np.full(6, np.nan)


class SimulationControl:
    """Answers requests between the steps of one client; any thread may :meth:`put` them.

    Only a client without a server pauses: others would see its actors stand still and take their objects.
    """

    def __init__(self, client: Client, reply: Callable[[SimulationReply], None]) -> None:
        self._client, self._reply = client, reply
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
        client = self._client
        if request.action is SimulationAction.GET_ENTITIES:
            self._answer(request, entities=tuple(entities(client)))
            return
        if request.action is SimulationAction.GET_STATE:
            self._answer(request)
            return
        if client.world_time.is_shared:
            self._answer(request, "a client of a shared world cannot pause; start it without --connect")
            return
        if request.action is SimulationAction.STEP:
            if client.steps_before_pause is None:
                self._answer(request, "the simulation runs; pause it first")
            elif not 1 <= request.steps <= MAX_STEPS:
                self._answer(request, f"{request.steps} steps; give 1 to {MAX_STEPS}")
            else:
                client.steps_before_pause, self._stepping = request.steps, request
            return
        client.steps_before_pause = 0 if request.action is SimulationAction.PAUSE else None
        self._answer(request)

    def _answer(self, request: SimulationRequest, refusal: str = "", entities: tuple[Entity, ...] = ()) -> None:
        client = self._client
        now = client.physics.time + client.world_time.offset
        self._reply(SimulationReply(request.number, now, client.steps_before_pause is not None, refusal, entities))


def entities(client: Client) -> Iterator[Entity]:
    """Robots, people, boxes and bunches as this client has them, by name as in ``tf_environment``."""
    physics, rigid = client.physics, client.physics.rigid
    physics.update_kinematics()
    for name in sorted(rigid.actors):
        if name in client.humans or isinstance(client.remote_actors.get(name), RemoteHuman):
            pose = frames.pose(rigid.actor_position(name).astype(float))
            yield Entity(name, EntityCategory.HUMAN, pose, _UNKNOWN)
        else:
            pose, velocity = rigid.base_state(name)
            yield Entity(name, EntityCategory.ROBOT, np.array(pose, float), np.array(velocity, float))
    shown = {visual.name: i for i, visual in enumerate(rigid.visuals())}
    poses = rigid.visual_q()
    for box in range(len(client.model.box_size)):
        yield Entity(f"box_{box}", EntityCategory.DYNAMIC_OBJECT, poses[shown[f"box/{box}"]].copy(), _UNKNOWN)
    attached = physics.state.bunch_attached
    for bunch in range(len(attached)):
        body = client.model.bunch_body[bunch]
        if attached[bunch]:
            pose, velocity = physics.state.body_q[body], physics.state.body_qd[body]
            yield Entity(f"bunch_{bunch:05d}", EntityCategory.OBJECT, pose.astype(float), velocity.astype(float))
        elif (row := shown.get(f"bunch/{bunch}")) is not None:
            yield Entity(f"bunch_{bunch:05d}", EntityCategory.DYNAMIC_OBJECT, poses[row].copy(), _UNKNOWN)
