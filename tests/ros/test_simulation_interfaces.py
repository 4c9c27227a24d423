"""simulation_interfaces as a test program uses them: pause, step, and what is in the world."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import pytest

from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient

from tests.support.contact_scenes import cane
from tests.support.stock_node import StockNode, wait_until
from vinesim.client.client import Client
from vinesim.client.tasks.simulation_control import SimulationControl
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.ros.simulation_node import SimulationNode
from vinesim.scene.builder import assemble
from vinesim.scene.spec import load_scene


class SimulationInRos:
    """A client with a cane and a robot, its services, and a stock node that calls them."""

    def __init__(self) -> None:
        scene = load_scene("demo")
        model = assemble([cane((50.0, 5.0, 1.0), radius=0.005)])
        bus = MemoryHub().bus("robot")
        pose = spawn_pose(scene, 0)
        self.client = Client(scene, model, load_description("vinebot"), bus, name="robot", pose=pose)
        self.control = SimulationControl(self.client, lambda reply: self.node.answer(reply))
        self.client.between_steps.append(self.control)
        self.node = SimulationNode("robot_simulation", "", self.control.put)
        self.peer = StockNode()
        self._services: dict[str, Any] = {}

    def call(self, service: str, **fields: Any) -> Any:
        """The response of a service by its type's name."""
        import simulation_interfaces.srv as services

        kind = getattr(services, service)
        if service not in self._services:
            name = "".join(f"_{c.lower()}" if c.isupper() else c for c in service).lstrip("_")
            self._services[service] = self.peer.node.create_client(kind, name)
        client = self._services[service]
        wait_until(client.service_is_ready, self.peer.spin, service)
        answer = client.call_async(kind.Request(**fields))
        wait_until(answer.done, self.step, service)
        return answer.result()

    def connect(self) -> ActionClient:
        """A client of the action of steps."""
        from simulation_interfaces.action import SimulateSteps

        found = ActionClient(self.peer.node, SimulateSteps, "simulate_steps")
        wait_until(found.server_is_ready, self.step, "simulate_steps")
        return found

    def send(self, to: ActionClient, steps: int, heard: list[tuple[int, int]]) -> Any:
        """The handle of a goal, which is accepted; ``heard`` takes completed and remaining steps of its feedback."""
        from simulation_interfaces.action import SimulateSteps

        def take(message: Any) -> None:
            heard.append((message.feedback.completed_steps, message.feedback.remaining_steps))

        answer = to.send_goal_async(SimulateSteps.Goal(steps=steps), feedback_callback=take)
        wait_until(answer.done, self.step, "an answer")
        assert answer.result().accepted
        return answer.result()

    def end_of(self, handle: Any) -> tuple[int, int, str]:
        """Status of a goal, code and text of its result."""
        answer = handle.get_result_async()
        wait_until(answer.done, self.step, "a result")
        result = answer.result().result.result
        return answer.result().status, result.result, result.error_message

    def step(self) -> None:
        self.client.tick()
        self.peer.spin(0.002)


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> Iterator[SimulationInRos]:
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("log")))
        found = SimulationInRos()
        with found.node, found.peer:
            yield found


def test_pause_and_single_steps(world: SimulationInRos) -> None:
    """A paused simulation stands still, goes on by exactly as many steps as asked, and plays again."""
    from simulation_interfaces.msg import Result, SimulationState

    physics = world.client.physics
    assert world.call("GetSimulationState").state.state == SimulationState.STATE_PLAYING
    assert world.call("StepSimulation", steps=3).result.result == Result.RESULT_OPERATION_FAILED
    pause = SimulationState(state=SimulationState.STATE_PAUSED)
    assert world.call("SetSimulationState", state=pause).result.result == Result.RESULT_OK
    stood = physics.tick
    for _ in range(10):
        world.step()
    assert physics.tick == stood
    assert world.call("StepSimulation", steps=7).result.result == Result.RESULT_OK
    assert physics.tick == stood + 7
    assert world.call("GetSimulationState").state.state == SimulationState.STATE_PAUSED
    play = SimulationState(state=SimulationState.STATE_PLAYING)
    world.call("SetSimulationState", state=play)
    wait_until(lambda: physics.tick > stood + 20, world.step, "the simulation to play")
    stop = SimulationState(state=SimulationState.STATE_STOPPED)
    refused = world.call("SetSimulationState", state=stop).result
    assert refused.result == Result.RESULT_FEATURE_UNSUPPORTED
    assert "can only play and pause" in refused.error_message


def test_steps_by_the_action_are_told_of_one_by_one(world: SimulationInRos) -> None:
    """Exactly as many as the goal says, and only of a paused simulation."""
    from simulation_interfaces.msg import Result, SimulationState

    physics = world.client.physics
    actions = world.connect()
    heard: list[tuple[int, int]] = []
    runs = world.end_of(world.send(actions, 3, heard))
    assert runs == (GoalStatus.STATUS_ABORTED, Result.RESULT_OPERATION_FAILED, "the simulation runs; pause it first")
    world.call("SetSimulationState", state=SimulationState(state=SimulationState.STATE_PAUSED))
    expected = [(done, 7 - done) for done in range(1, 8)]
    while heard != expected:  # the server may not have found this client's subscription to feedback yet
        heard.clear()
        stood = physics.tick
        end = world.end_of(world.send(actions, 7, heard))
        assert end == (GoalStatus.STATUS_SUCCEEDED, Result.RESULT_OK, "")
        assert physics.tick == stood + 7
        for _ in range(10):
            world.step()
        assert physics.tick == stood + 7
    none = world.end_of(world.send(actions, 0, heard))
    assert none == (GoalStatus.STATUS_ABORTED, Result.RESULT_OPERATION_FAILED, "0 steps; give 1 to 100000")
    assert 33 in world.call("GetSimulatorFeatures").features.features
    world.call("SetSimulationState", state=SimulationState(state=SimulationState.STATE_PLAYING))


def test_steps_by_the_action_end_when_they_are_cancelled(world: SimulationInRos) -> None:
    """Services are answered meanwhile; other steps are refused, and play ends the goal, too."""
    from simulation_interfaces.msg import Result, SimulationState

    physics = world.client.physics
    actions = world.connect()
    pause = SimulationState(state=SimulationState.STATE_PAUSED)
    play = SimulationState(state=SimulationState.STATE_PLAYING)
    world.call("SetSimulationState", state=pause)
    stood = physics.tick
    handle = world.send(actions, 50_000, [])
    wait_until(lambda: physics.tick > stood + 5, world.step, "steps")
    assert "robot" in world.call("GetEntities").entities
    other = world.end_of(world.send(actions, 5, []))
    assert other[:2] == (GoalStatus.STATUS_ABORTED, Result.RESULT_OPERATION_FAILED)
    assert "other steps are being simulated" in other[2]
    assert world.call("StepSimulation", steps=5).result.error_message == other[2]
    cancelled = handle.cancel_goal_async()
    wait_until(cancelled.done, world.step, "the cancel's answer")
    assert len(cancelled.result().goals_canceling) == 1
    status, code, text = world.end_of(handle)
    assert (status, code) == (GoalStatus.STATUS_CANCELED, Result.RESULT_OPERATION_FAILED)
    assert text == f"cancelled after {physics.tick - stood} of 50000 steps"
    stood = physics.tick
    for _ in range(10):
        world.step()
    assert physics.tick == stood
    handle = world.send(actions, 50_000, [])
    world.call("SetSimulationState", state=play)
    status, code, text = world.end_of(handle)
    assert (status, code) == (GoalStatus.STATUS_ABORTED, Result.RESULT_OPERATION_FAILED)
    assert text.startswith("ended by play after ")
    stood = physics.tick
    wait_until(lambda: physics.tick > stood + 20, world.step, "the simulation to play")


def test_entities_and_their_states(world: SimulationInRos) -> None:
    from simulation_interfaces.msg import EntityCategory, EntityFilters, Result

    assert "robot" in world.call("GetEntities").entities
    of_robots = EntityFilters(filter="^ro", categories=[EntityCategory(category=EntityCategory.CATEGORY_ROBOT)])
    found = world.call("GetEntitiesStates", filters=of_robots)
    assert found.entities == ["robot"]
    pose = found.states[0].pose.position
    expected = world.client.robot.rigid.base_state("robot")[0]
    assert (pose.x, pose.y) == pytest.approx(tuple(expected[:2]), abs=1e-6)
    assert found.states[0].header.frame_id == "map"
    state = world.call("GetEntityState", entity="robot")
    assert state.state.pose.orientation.w == pytest.approx(expected[6], abs=1e-6)
    missing = world.call("GetEntityState", entity="missing").result
    assert (missing.result, missing.error_message) == (
        Result.RESULT_NOT_FOUND,
        "no entity 'missing'; get_entities lists them",
    )
    wrong = world.call("GetEntities", filters=EntityFilters(filter="(")).result
    assert "no regular expression" in wrong.error_message


def test_what_is_not_supported_says_so(world: SimulationInRos) -> None:
    from simulation_interfaces.msg import Result

    for service in ("SpawnEntities", "LoadWorld", "SetEntityInfo"):
        result = world.call(service).result
        assert result.result == Result.RESULT_FEATURE_UNSUPPORTED
        assert "not supported by vinesim" in result.error_message
    assert 26 in world.call("GetSimulatorFeatures").features.features  # pause


def test_entities_are_spawned_moved_deleted_and_the_scene_set_back(world: SimulationInRos) -> None:
    """As a test program does it; time goes on over a reset, and what is refused has the code of its service."""
    import simulation_interfaces.srv as services
    from geometry_msgs.msg import Point, Pose, PoseStamped
    from simulation_interfaces.msg import EntityState, Result
    from std_msgs.msg import Header

    def at(x: float, y: float, frame: str = "map") -> dict[str, Any]:
        return {"header": Header(frame_id=frame), "pose": Pose(position=Point(x=x, y=y))}

    listed = world.call("GetSpawnables").spawnables
    assert [one.uri for one in listed] == ["vinesim:box", "vinesim:person", "vinesim:bunch"]
    assert listed[0].spawn_bounds.points[0].z == pytest.approx(0.24)  # upper corner first
    crate = {"name": "crate", "uri": "vinesim:box"}
    spawned = world.call("SpawnEntity", **crate, initial_pose=PoseStamped(**at(9.0, -3.0)))
    assert (spawned.result.result, spawned.entity_name) == (Result.RESULT_OK, "crate")
    again = world.call("SpawnEntity", **crate, initial_pose=PoseStamped(**at(9.0, -3.0)))
    assert again.result.result == services.SpawnEntity.Response.NAME_NOT_UNIQUE
    other = world.call("SpawnEntity", uri="vinesim:box", name="b", initial_pose=PoseStamped(**at(9.0, -3.0, "odom")))
    assert other.result.result == services.SpawnEntity.Response.INVALID_POSE
    inline = world.call("SpawnEntity", name="b", resource_string="<robot/>")
    assert inline.result.result == services.SpawnEntity.Response.UNSUPPORTED_FORMAT

    assert world.call("SetEntityState", entity="crate", state=EntityState(**at(7.0, 2.0))).result.result == 1
    pose = world.call("GetEntityState", entity="crate").state.pose.position
    assert (pose.x, pose.y) == pytest.approx((7.0, 2.0), abs=0.02)
    elsewhere = world.call("SetEntityState", entity="crate", state=EntityState(**at(7.0, 2.0, "odom")))
    assert elsewhere.result.result == services.SetEntityState.Response.INVALID_POSE
    assert world.call("DeleteEntity", entity="missing").result.result == Result.RESULT_NOT_FOUND
    assert world.call("DeleteEntity", entity="robot").result.result == Result.RESULT_FEATURE_UNSUPPORTED
    assert world.call("SetEntityState", entity="robot", state=EntityState(**at(-5.0, 1.0))).result.result == 1

    before = world.call("GetEntityState", entity="robot").state.header.stamp
    for scope in (1, 3, 8):
        assert world.call("ResetSimulation", scope=scope).result.result == Result.RESULT_FEATURE_UNSUPPORTED
    assert world.call("ResetSimulation").result.result == Result.RESULT_OK
    assert "crate" not in world.call("GetEntities").entities
    state = world.call("GetEntityState", entity="robot").state
    start = spawn_pose(world.client.scene, 0)
    assert (state.pose.position.x, state.pose.position.y) == pytest.approx(tuple(start[:2]), abs=0.01)
    assert (state.header.stamp.sec, state.header.stamp.nanosec) > (before.sec, before.nanosec)
    features = set(world.call("GetSimulatorFeatures").features.features)
    assert {0, 1, 11, 14, 20, 22, 23} <= features
    assert not {9, 13, 21, 40, 50} & features


def test_a_client_of_a_shared_world_does_not_pause(world: SimulationInRos) -> None:
    from simulation_interfaces.msg import Result, SimulationState

    world.client.world_time.is_shared = True
    try:
        pause = SimulationState(state=SimulationState.STATE_PAUSED)
        refused = world.call("SetSimulationState", state=pause).result
        assert (refused.result, "cannot pause" in refused.error_message) == (Result.RESULT_INCORRECT_STATE, True)
        steps = world.call("StepSimulation", steps=3).result
        assert (steps.result, steps.error_message) == (Result.RESULT_OPERATION_FAILED, refused.error_message)
    finally:
        world.client.world_time.is_shared = False
