"""The ROS 2 node of simulation_interfaces: test programs pause, step and reset a simulation, and change its entities.

A service waits for the answer of the simulation, which comes between two steps; so the node has its own receiving
thread. Services that are not supported answer RESULT_FEATURE_UNSUPPORTED (0) with a text.
"""

from __future__ import annotations

import itertools
import re
import threading
import time as wall
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from geometry_msgs.msg import Pose, Twist

from vinesim.ros.commands.actions import StepAction
from vinesim.ros.commands.types import (
    Entity,
    EntityArguments,
    EntityCategory,
    Refusal,
    SimulationAction,
    SimulationReply,
    SimulationRequest,
    StepProgress,
)
from vinesim.ros.messages import convert, message_packages
from vinesim.ros.node import Node
from vinesim.ros.publishers.robot import MAP_FRAME

REPLY_TIMEOUT = 10.0
"""[s] Time within which the simulation must answer a request; after it, the simulation counts as stopped."""
RESET_TIMEOUT = 120.0
"""[s] Time within which the simulation must answer a reset, which takes as long as a start of the physics."""
STEP_TIMEOUT = 1.0
"""[s] Time that is added to :data:`REPLY_TIMEOUT` for each requested step."""
UNSUPPORTED = (
    "SpawnEntities",
    "SetEntityInfo",
    "LoadWorld",
    "UnloadWorld",
    "GetNamedPoses",
    "GetEntityBounds",
)
"""Services that always answer RESULT_FEATURE_UNSUPPORTED."""
_REMEDY = "not supported by vinesim; scene, robots and people are options of vinesim client and server"


_CODES = {
    Refusal.UNSUPPORTED: 0,
    Refusal.NOT_FOUND: 2,
    Refusal.INCORRECT_STATE: 3,
    Refusal.FAILED: 4,
    Refusal.NAME_NOT_UNIQUE: 101,
    Refusal.NAME_INVALID: 102,
    Refusal.UNSUPPORTED_FORMAT: 103,
    Refusal.NO_RESOURCE: 104,
    Refusal.RESOURCE_PARSE_ERROR: 106,
    Refusal.MISSING_ASSETS: 107,
}
"""Result codes of simulation_interfaces by reason of refusal, except for invalid poses."""
INVALID_SPAWN_POSE = 109
"""Result code of spawn_entity for an invalid pose."""
INVALID_POSE = 101
"""Result code of set_entity_state for an invalid pose."""


class SimulationNode(Node):
    """A node with the services and the action of simulation_interfaces, besides a robot's own node.

    ``ask`` sends a request to the simulation; the simulation's replies are passed to :meth:`answer`.
    """

    def __init__(
        self, name: str, namespace: str, ask: Callable[[SimulationRequest], None], *, beside: Node | None = None
    ) -> None:
        message_packages.ensure_importable(["simulation_interfaces"])
        self._ask = ask
        # starts at the clock, so that a late answer to a request of an earlier run matches no number of this one
        self._numbers = itertools.count(wall.monotonic_ns())
        self._waiting: dict[int, threading.Event] = {}
        self._replies: dict[int, SimulationReply] = {}
        super().__init__(name, namespace, (), beside=beside)

    def answer(self, reply: SimulationReply | StepProgress) -> None:
        """Pass a reply of the simulation, or the progress of its steps, to the service or action that waits for it.
        Any thread may call this."""
        waiting = self._waiting.get(reply.number)
        if waiting is not None and isinstance(reply, SimulationReply):
            self._replies[reply.number] = reply
            waiting.set()
        else:
            self._steps.answer(reply)

    def _wake(self) -> None:
        for waiting in list(self._waiting.values()):
            waiting.set()

    def _open(self) -> None:
        import simulation_interfaces.srv as services
        from simulation_interfaces.msg import EntityCategory as Category
        from simulation_interfaces.msg import Result, SimulationState, SimulatorFeatures

        self._result = Result
        self._state = SimulationState
        self._features = SimulatorFeatures
        self._categories = {
            EntityCategory.OBJECT: Category.CATEGORY_OBJECT,
            EntityCategory.ROBOT: Category.CATEGORY_ROBOT,
            EntityCategory.HUMAN: Category.CATEGORY_HUMAN,
            EntityCategory.DYNAMIC_OBJECT: Category.CATEGORY_DYNAMIC_OBJECT,
        }
        served = {
            "GetSimulatorFeatures": self._get_features,
            "GetSimulationState": self._get_state,
            "SetSimulationState": self._set_state,
            "StepSimulation": self._step,
            "GetEntities": self._get_entities,
            "GetEntitiesStates": self._get_states,
            "GetEntityState": self._get_entity_state,
            "GetEntityInfo": self._get_entity_info,
            "GetSpawnables": self._get_spawnables,
            "SpawnEntity": self._spawn,
            "DeleteEntity": self._delete,
            "SetEntityState": self._set_entity_state,
            "ResetSimulation": self._reset,
            **dict.fromkeys(UNSUPPORTED, self._refuse),
        }
        for name, serve in served.items():
            topic = re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()
            self._node.create_service(getattr(services, name), topic, serve)
        self._steps = StepAction(self._node, self._ask, self._numbers, self._result_of)

    # ------------------------------------------------------------------ services

    def _get_features(self, _: Any, response: Any) -> Any:
        known = self._features
        response.features.features = [
            known.SPAWNING,
            known.DELETING,
            known.SPAWNABLES,
            known.ENTITY_STATE_SETTING,
            known.SIMULATION_RESET,
            known.SIMULATION_RESET_STATE,
            known.SIMULATION_RESET_SPAWNED,
            known.ENTITY_CATEGORIES,
            known.ENTITY_STATE_GETTING,
            known.ENTITY_INFO_GETTING,
            known.SIMULATION_STATE_GETTING,
            known.SIMULATION_STATE_SETTING,
            known.SIMULATION_STATE_PAUSE,
            known.STEP_SIMULATION_SINGLE,
            known.STEP_SIMULATION_MULTIPLE,
            known.STEP_SIMULATION_ACTION,
        ]
        response.features.custom_info = (
            "only a client without a server pauses, steps, resets and changes entities; time goes on over a reset; "
            "get_spawnables lists the URIs that can be spawned"
        )
        return response

    def _get_state(self, _: Any, response: Any) -> Any:
        reply = self._request(SimulationAction.GET_STATE, response.result)
        if reply is not None:
            response.state.state = self._state.STATE_PAUSED if reply.is_paused else self._state.STATE_PLAYING
        return response

    def _set_state(self, request: Any, response: Any) -> Any:
        actions = {self._state.STATE_PLAYING: SimulationAction.PLAY, self._state.STATE_PAUSED: SimulationAction.PAUSE}
        if request.state.state in actions:
            self._request(actions[request.state.state], response.result)
        else:
            self._fail(response.result, self._result.RESULT_FEATURE_UNSUPPORTED, "vinesim can only play and pause")
        return response

    def _step(self, request: Any, response: Any) -> Any:
        self._request(SimulationAction.STEP, response.result, steps=int(request.steps))
        return response

    def _get_entities(self, request: Any, response: Any) -> Any:
        response.entities = [entity.name for entity in self._filtered(request.filters, response.result)]
        return response

    def _get_states(self, request: Any, response: Any) -> Any:
        found = self._filtered(request.filters, response.result)
        response.entities = [entity.name for entity in found]
        response.states = [self._entity_state(entity) for entity in found]
        return response

    def _get_entity_state(self, request: Any, response: Any) -> Any:
        if (entity := self._named(request.entity, response.result)) is not None:
            response.state = self._entity_state(entity)
        return response

    def _get_entity_info(self, request: Any, response: Any) -> Any:
        if (entity := self._named(request.entity, response.result)) is not None:
            response.info.category.category = self._categories[entity.category]
            response.info.description = entity.description
        return response

    def _get_spawnables(self, _: Any, response: Any) -> Any:
        from geometry_msgs.msg import Vector3
        from simulation_interfaces.msg import Bounds, Spawnable

        reply = self._request(SimulationAction.GET_SPAWNABLES, response.result)
        for one in () if reply is None else reply.spawnables:
            corners = [Vector3(x=x, y=y, z=z) for x, y, z in (one.high, one.low)]
            bounds = Bounds(type=Bounds.TYPE_BOX, points=corners)
            response.spawnables.append(Spawnable(uri=one.uri, description=one.description, spawn_bounds=bounds))
        return response

    def _spawn(self, request: Any, response: Any) -> Any:
        if request.resource_string:
            text = "no resource strings; get_spawnables lists the URIs that can be spawned"
            self._fail(response.result, response.UNSUPPORTED_FORMAT, text)
            return response
        pose = _read_pose(request.initial_pose.header, request.initial_pose.pose)
        given = EntityArguments(request.name, pose, None, request.uri, request.allow_renaming)
        reply = self._request(SimulationAction.SPAWN, response.result, entity=given)
        response.entity_name = "" if reply is None else reply.name
        return response

    def _delete(self, request: Any, response: Any) -> Any:
        self._request(SimulationAction.DELETE, response.result, entity=EntityArguments(request.entity))
        return response

    def _set_entity_state(self, request: Any, response: Any) -> Any:
        state = request.state
        given = EntityArguments(request.entity, _read_pose(state.header, state.pose), _read_twist(state.twist))
        self._request(SimulationAction.SET_ENTITY_STATE, response.result, entity=given)
        return response

    def _reset(self, request: Any, response: Any) -> Any:
        scope = request.scope or request.SCOPE_ALL
        known = request.SCOPE_STATE | request.SCOPE_SPAWNED
        if scope != request.SCOPE_ALL and scope & ~known:
            text = "time goes on over a reset; give the scope STATE, SPAWNED, both, ALL or DEFAULT"
            self._fail(response.result, self._result.RESULT_FEATURE_UNSUPPORTED, text)
            return response
        self._request(
            SimulationAction.RESET,
            response.result,
            timeout=RESET_TIMEOUT,
            keep_state=not scope & request.SCOPE_STATE,
            keep_spawned=not scope & request.SCOPE_SPAWNED,
        )
        return response

    def _refuse(self, _: Any, response: Any) -> Any:
        self._fail(response.result, self._result.RESULT_FEATURE_UNSUPPORTED, _REMEDY)
        return response

    # ------------------------------------------------------------------ the simulation's answers

    def _request(
        self, action: SimulationAction, result: Any, *, steps: int = 0, timeout: float = REPLY_TIMEOUT, **values: Any
    ) -> SimulationReply | None:
        """Send a request to the simulation and wait for the reply, up to ``timeout`` [s] and :data:`STEP_TIMEOUT` for
        each of the ``steps``. Fills ``result``. Returns None if the simulation refused or did not answer.

        ``values``: further fields of the request.
        """
        number = next(self._numbers)
        done = threading.Event()
        self._waiting[number] = done
        try:
            self._ask(SimulationRequest(number, action, steps, **values))
            done.wait(timeout + STEP_TIMEOUT * min(steps, 1000))
        finally:
            del self._waiting[number]
        reply = self._replies.pop(number, None)
        if reply is None:
            self._fail(result, self._result.RESULT_OPERATION_FAILED, "the simulation did not answer")
        elif reply.refusal:
            pose_code = INVALID_SPAWN_POSE if action is SimulationAction.SPAWN else INVALID_POSE
            self._fail(result, _CODES.get(reply.kind, pose_code), reply.refusal)
            return None
        else:
            self._time = reply.time
            result.result = self._result.RESULT_OK
        return reply

    def _result_of(self, reply: SimulationReply) -> Any:
        """Convert the reply to a step request to a Result message."""
        if reply.refusal:
            return self._result(result=_CODES[reply.kind], error_message=reply.refusal)
        return self._result(result=self._result.RESULT_OK)

    def _fail(self, result: Any, code: int, text: str) -> None:
        """Fill ``result`` with an error code and its text."""
        result.result = code
        result.error_message = text

    def _filtered(self, filters: Any, result: Any) -> list[Entity]:
        """Returns the entities that pass ``filters``. Returns none, and fills ``result`` with an error, if a filter
        is not supported or invalid."""
        if filters.tags.tags or filters.bounds.points:
            self._fail(result, self._result.RESULT_FEATURE_UNSUPPORTED, "no filter by tags or bounds; name a category")
            return []
        try:
            wanted = re.compile(filters.filter)
        except re.error as error:
            text = f"filter {filters.filter!r} is no regular expression: {error}"
            self._fail(result, self._result.RESULT_OPERATION_FAILED, text)
            return []
        reply = self._request(SimulationAction.GET_ENTITIES, result)
        categories = {one.category for one in filters.categories}
        found: Iterable[Entity] = () if reply is None else reply.entities
        return [
            entity
            for entity in found
            if wanted.search(entity.name) and (not categories or self._categories[entity.category] in categories)
        ]

    def _named(self, name: str, result: Any) -> Entity | None:
        """Returns the entity called ``name``. If there is none, fills ``result`` with an error and returns None."""
        reply = self._request(SimulationAction.GET_ENTITIES, result)
        found = next((entity for entity in (() if reply is None else reply.entities) if entity.name == name), None)
        if reply is not None and found is None:
            self._fail(result, self._result.RESULT_NOT_FOUND, f"no entity {name!r}; get_entities lists them")
        return found

    def _entity_state(self, entity: Entity) -> Any:
        from simulation_interfaces.msg import EntityState

        state = EntityState(header=convert.header(self._time, MAP_FRAME))
        convert.set_vector(state.pose.position, entity.pose[:3])
        convert.set_quaternion(state.pose.orientation, entity.pose[3:])
        convert.set_vector(state.twist.linear, entity.velocity[:3])
        convert.set_vector(state.twist.angular, entity.velocity[3:])
        return state


def _read_pose(header: Any, message: Pose) -> np.ndarray | None:
    """Returns a pose [7] m, 1; None if its frame id is neither empty nor the map."""
    x = message.position
    q = message.orientation
    return np.array([x.x, x.y, x.z, q.x, q.y, q.z, q.w]) if header.frame_id in ("", MAP_FRAME) else None


def _read_twist(message: Twist) -> np.ndarray:
    """Returns a twist as [6] m/s, rad/s: linear, then angular velocity."""
    return np.array([getattr(part, axis) for part in (message.linear, message.angular) for axis in "xyz"])
