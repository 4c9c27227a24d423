"""simulation_interfaces: services by which test programs pause and step a simulation, and ask what is in it.

Services wait for an answer of the simulation, which is given between two steps; so this node has a thread and a context
of its own. What is not supported says so: result 0, with a text.
"""

from __future__ import annotations

import itertools
import re
import threading
from collections.abc import Callable, Iterable
from typing import Any

from vinesim.ros.commands.types import Entity, EntityCategory, SimulationAction, SimulationReply, SimulationRequest
from vinesim.ros.messages import convert, message_packages
from vinesim.ros.node import Node
from vinesim.ros.publishers.robot import MAP_FRAME

REPLY_TIMEOUT = 10.0
"""[s] A simulation that has not answered by then stands still."""
STEP_TIMEOUT = 1.0
"""[s] More for each step that was asked for: the slowest simulation that is waited for."""
UNSUPPORTED = (
    "SpawnEntity", "SpawnEntities", "DeleteEntity", "SetEntityState", "SetEntityInfo", "ResetSimulation", "LoadWorld",
    "UnloadWorld", "GetSpawnables", "GetNamedPoses", "GetEntityBounds",
)  # fmt: skip
"""Services that answer that they are not supported."""
_REMEDY = "not supported by vinesim; scene, robots and people are options of vinesim client and server"


class SimulationNode(Node):
    """The services, beside a robot's node. ``ask`` sends a request to the simulation; :meth:`answer` takes replies."""

    def __init__(self, name: str, namespace: str, ask: Callable[[SimulationRequest], None]) -> None:
        message_packages.ensure_importable(["simulation_interfaces"])
        self._ask = ask
        self._numbers = itertools.count()
        self._waiting: dict[int, threading.Event] = {}
        self._replies: dict[int, SimulationReply] = {}
        super().__init__(name, namespace, ())

    def answer(self, reply: SimulationReply) -> None:
        """Pass on the simulation's answer; called by any thread."""
        if (waiting := self._waiting.get(reply.number)) is not None:
            self._replies[reply.number] = reply
            waiting.set()

    def _wake(self) -> None:
        for waiting in list(self._waiting.values()):
            waiting.set()

    def _open(self) -> None:
        import simulation_interfaces.srv as services
        from simulation_interfaces.msg import EntityCategory as Category
        from simulation_interfaces.msg import Result, SimulationState, SimulatorFeatures

        self._result, self._state, self._features = Result, SimulationState, SimulatorFeatures
        self._categories = {
            EntityCategory.OBJECT: Category.CATEGORY_OBJECT,
            EntityCategory.ROBOT: Category.CATEGORY_ROBOT,
            EntityCategory.HUMAN: Category.CATEGORY_HUMAN,
            EntityCategory.DYNAMIC_OBJECT: Category.CATEGORY_DYNAMIC_OBJECT,
        }
        served = {
            "GetSimulatorFeatures": self._get_features, "GetSimulationState": self._get_state,
            "SetSimulationState": self._set_state, "StepSimulation": self._step, "GetEntities": self._get_entities,
            "GetEntitiesStates": self._get_states, "GetEntityState": self._get_entity_state,
            "GetEntityInfo": self._get_entity_info, **dict.fromkeys(UNSUPPORTED, self._refuse),
        }  # fmt: skip
        for name, serve in served.items():
            topic = re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()
            self._node.create_service(getattr(services, name), topic, serve)

    # ------------------------------------------------------------------ services

    def _get_features(self, _: Any, response: Any) -> Any:
        known = self._features
        response.features.features = [
            known.ENTITY_CATEGORIES, known.ENTITY_STATE_GETTING, known.ENTITY_INFO_GETTING,
            known.SIMULATION_STATE_GETTING, known.SIMULATION_STATE_SETTING, known.SIMULATION_STATE_PAUSE,
            known.STEP_SIMULATION_SINGLE, known.STEP_SIMULATION_MULTIPLE,
        ]  # fmt: skip
        response.features.custom_info = "pause and step: of a client without a server"
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
            self._fail(response.result, self._result.RESULT_FEATURE_UNSUPPORTED, "vinesim plays and pauses, no more")
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
        return response

    def _refuse(self, _: Any, response: Any) -> Any:
        self._fail(response.result, self._result.RESULT_FEATURE_UNSUPPORTED, _REMEDY)
        return response

    # ------------------------------------------------------------------ the simulation's answers

    def _request(self, action: SimulationAction, result: Any, steps: int = 0) -> SimulationReply | None:
        """Ask the simulation and wait; fills ``result``. None if it refused or did not answer."""
        number, done = next(self._numbers), threading.Event()
        self._waiting[number] = done
        try:
            self._ask(SimulationRequest(number, action, steps))
            done.wait(REPLY_TIMEOUT + STEP_TIMEOUT * min(steps, 1000))
        finally:
            del self._waiting[number]
        reply = self._replies.pop(number, None)
        if reply is None:
            self._fail(result, self._result.RESULT_OPERATION_FAILED, "the simulation did not answer")
        elif reply.refusal:
            self._fail(result, self._result.RESULT_INCORRECT_STATE, reply.refusal)
            return None
        else:
            self._time = reply.time
            result.result = self._result.RESULT_OK
        return reply

    def _fail(self, result: Any, code: int, text: str) -> None:
        result.result, result.error_message = code, text

    def _filtered(self, filters: Any, result: Any) -> list[Entity]:
        """The entities that a filter leaves, none if it asks for what is not supported."""
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
            entity for entity in found
            if wanted.search(entity.name) and (not categories or self._categories[entity.category] in categories)
        ]  # fmt: skip

    def _named(self, name: str, result: Any) -> Entity | None:
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
