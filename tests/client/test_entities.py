"""Entities of a client as simulation_interfaces changes them: spawned, deleted, moved, and the scene set back."""

from __future__ import annotations

import gc
import threading
import weakref

import numpy as np
import pytest

from tests.support.shared_vineyard import World, cart, vineyard
from vinesim.client.client import Client
from vinesim.client.faults import count_faults
from vinesim.client.tasks.entities import BOX_SIZE, WorldEditor
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.ros.commands.types import Entity, EntityArguments, EntityCategory, Refusal, RequestRefused
from vinesim.scene.ids import Organ
from vinesim.scene.spec import load_scene

START = frames.pose([-4.0, 0.5, 0.0], frames.from_yaw(0.3))


class Alone:
    """A client whose world is its own, with two canes, two boxes and a cart."""

    def __init__(self) -> None:
        self.client = Client(load_scene("demo"), vineyard(), cart(), MemoryHub().bus("cart"), name="cart", pose=START)
        self.editor = WorldEditor(self.client)

    def run(self, steps: int = 20) -> None:
        for _ in range(steps):
            self.client.tick()

    def entity(self, name: str) -> Entity:
        return {one.name: one for one in self.editor.entities()}[name]

    @property
    def names(self) -> set[str]:
        return {one.name for one in self.editor.entities()}

    def spawn(self, uri: str, x: float, y: float, z: float = 0.0, name: str = "", **fields) -> str:
        given = EntityArguments(name, frames.pose([x, y, z]), None, uri, allow_renaming=not name, **fields)
        return self.editor.spawn(given)

    def refusal(self, work, *given, **options) -> Refusal:
        with pytest.raises(RequestRefused) as refused:
            work(*given, **options)
        assert len(str(refused.value).splitlines()) == 1
        return refused.value.kind

    @property
    def state(self) -> dict[str, np.ndarray]:
        """All positions and velocities, and what is attached."""
        physics = self.client.physics
        plants = {name: getattr(physics.state, name) for name in ("joint_q", "joint_qd", "body_cut", "bunch_attached")}
        return {"qpos": physics.rigid.mj_data.qpos, "qvel": physics.rigid.mj_data.qvel, **plants}


@pytest.fixture
def world() -> Alone:
    return Alone()


def test_a_spawned_box_is_a_body_that_is_seen_and_carries(world):
    """It falls to the ground and rests there, a bunch that falls into it stays in it; what else moves goes on."""
    before = world.entity("box_0").pose
    assert world.spawn("vinesim:box", 3.0, -2.0, 0.3, "crate") == "crate"
    loose = world.spawn("vinesim:bunch", 3.0, -2.0, 0.6)
    assert world.entity("crate").pose[2] == pytest.approx(0.3)
    world.run(200)
    assert np.abs(world.entity("crate").pose[:3] - [3.0, -2.0, 0.0]).max() < 0.02
    inside = world.entity(loose).pose[:3] - world.entity("crate").pose[:3]
    assert (np.abs(inside[:2]) < 0.5 * np.array(BOX_SIZE[:2])).all()
    assert 0.0 < inside[2] < BOX_SIZE[2]
    assert np.abs(world.entity("box_0").pose - before).max() < 2e-3
    shown = {one.name: one.organ for one in world.client.physics.visuals()}
    assert shown["box/2"] == Organ.BOX
    assert "crate; frame box_2" in world.entity("crate").description


def test_bunches_are_taken_off_their_vines_by_number_or_far_from_robots(world):
    attached = world.client.physics.state.bunch_attached
    assert world.entity("bunch_00000").category == EntityCategory.OBJECT
    assert world.spawn("vinesim:bunch/0", -1.0, -1.5, 1.0, "b0") == "b0"
    assert attached.tolist() == [False, True]
    assert world.entity("b0").category == EntityCategory.DYNAMIC_OBJECT
    assert world.entity("b0").pose[:3] == pytest.approx([-1.0, -1.5, 1.0])
    assert world.refusal(world.spawn, "vinesim:bunch/0", 0, 0) == Refusal.MISSING_ASSETS
    assert world.refusal(world.spawn, "vinesim:bunch/9", 0, 0) == Refusal.MISSING_ASSETS
    assert world.refusal(world.spawn, "vinesim:bunch/x", 0, 0) == Refusal.RESOURCE_PARSE_ERROR
    world.spawn("vinesim:bunch", -1.0, 2.5, 1.0)
    assert not attached.any()
    assert world.refusal(world.spawn, "vinesim:bunch", 0, 0) == Refusal.MISSING_ASSETS
    world.run()


def test_a_spawned_person_stands_moves_and_goes(world):
    name = world.spawn("vinesim:person", 2.0, -3.0, name="anna")
    world.run(3)
    assert world.entity(name).category == EntityCategory.HUMAN
    assert world.entity(name).pose[:2] == pytest.approx([2.0, -3.0], abs=0.05)
    world.editor.set_state(EntityArguments(name, frames.pose([5.0, 4.0, 0.7], frames.from_yaw(1.0))))
    world.run(3)
    assert world.entity(name).pose[:2] == pytest.approx([5.0, 4.0], abs=0.05)
    world.editor.delete(name)
    world.run(3)
    assert name not in world.names
    assert list(world.client.replicators) == ["cart"]


def test_names(world):
    assert world.spawn("vinesim:box", 3.0, 0.0) == "spawned_box_1"
    assert world.spawn("vinesim:box", 4.0, 0.0) == "spawned_box_2"
    assert world.refusal(world.spawn, "vinesim:box", 5.0, 0.0, name="spawned_box_1") == Refusal.NAME_NOT_UNIQUE
    assert world.refusal(world.spawn, "vinesim:box", 5.0, 0.0, name="cart") == Refusal.NAME_NOT_UNIQUE
    for name in ("a/b", "box_7", "bunch_00009", "x" * 49):
        assert world.refusal(world.spawn, "vinesim:box", 5.0, 0.0, name=name) == Refusal.NAME_INVALID
    nameless = EntityArguments("", frames.pose([5.0, 0.0, 0.0]), None, "vinesim:box")
    assert world.refusal(world.editor.spawn, nameless) == Refusal.NAME_INVALID
    taken = EntityArguments("cart", frames.pose([5.0, 0.0, 0.0]), None, "vinesim:box", allow_renaming=True)
    assert world.editor.spawn(taken) == "cart_1"


def test_what_cannot_be_is_refused_with_the_reason(world):
    assert world.refusal(world.spawn, "", 0, 0) == Refusal.NO_RESOURCE
    assert world.refusal(world.spawn, "file:///a.urdf", 0, 0) == Refusal.UNSUPPORTED_FORMAT
    assert world.refusal(world.spawn, "vinesim:box/3", 0, 0) == Refusal.UNSUPPORTED_FORMAT
    assert world.refusal(world.spawn, "vinesim:box", np.nan, 0) == Refusal.INVALID_POSE
    assert world.refusal(world.spawn, "vinesim:box", 1e5, 0) == Refusal.INVALID_POSE
    turned = EntityArguments("box_0", np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5]))
    assert world.refusal(world.editor.set_state, turned) == Refusal.INVALID_POSE
    assert world.refusal(world.editor.set_state, EntityArguments("box_0", None)) == Refusal.INVALID_POSE
    assert world.refusal(world.editor.delete, "missing") == Refusal.NOT_FOUND
    assert world.refusal(world.editor.delete, "bunch_00000") == Refusal.FAILED
    assert world.refusal(world.editor.delete, "cart") == Refusal.UNSUPPORTED
    world.client.script = "--job"
    assert world.refusal(world.editor.reset) == Refusal.INCORRECT_STATE


def test_a_client_of_a_shared_world_changes_nothing():
    shared = World()
    client = shared.join("anna", -4.0, 0.0)
    shared.join("bert", -4.0, 3.0)
    shared.until(lambda: client.remote_actors)
    editor = WorldEditor(client)
    alone = Alone()
    box = EntityArguments("crate", frames.pose([3.0, 0.0, 0.0]), None, "vinesim:box")
    moved = EntityArguments("bert", frames.pose([3.0, 0.0, 0.0]))
    for work, given in ((editor.spawn, box), (editor.delete, "box_0"), (editor.set_state, moved)):
        assert alone.refusal(work, given) == Refusal.INCORRECT_STATE
    assert alone.refusal(editor.reset) == Refusal.INCORRECT_STATE
    with pytest.raises(ValueError, match="cannot be reset"):
        client.reset()


def test_objects_and_robots_are_put_where_a_state_says(world):
    throw = np.array([1.0, 0.0, 2.0, 0.0, 0.0, 0.5])
    world.editor.set_state(EntityArguments("box_1", frames.pose([3.0, -2.0, 1.0]), throw))
    assert world.entity("box_1").velocity == pytest.approx(throw)
    world.run(10)
    x = world.entity("box_1").pose[:3]
    t = 0.1
    g = world.client.physics.parameters.gravity
    assert x == pytest.approx([3.0 + t, -2.0, 1.0 + 2.0 * t - 0.5 * g * t * t], abs=0.01)
    world.editor.set_state(EntityArguments("cart", frames.pose([-6.0, -1.0, 0.4], frames.from_yaw(2.0))))
    world.run(5)
    assert world.entity("cart").pose == pytest.approx(frames.pose([-6.0, -1.0, 0.0], frames.from_yaw(2.0)), abs=1e-3)
    # what get_entity_state tells can be set again, also where a velocity is not known
    state = world.entity("box_0")
    world.editor.set_state(EntityArguments("box_0", state.pose, np.full(6, np.nan)))
    assert world.entity("box_0").pose == pytest.approx(state.pose)


def test_what_lay_in_a_deleted_box_falls_and_others_keep_their_names(world):
    world.spawn("vinesim:bunch/0", -2.0, 0.0, 0.1, "inside")
    world.run(150)
    resting = world.entity("inside").pose[2]
    other = world.entity("box_1").pose
    world.editor.delete("box_0")
    world.run(100)
    assert "box_0" not in world.names
    assert "box/0" not in {one.name for one in world.client.physics.visuals()}
    assert world.entity("inside").pose[2] < resting - 0.005
    assert world.entity("box_1").pose == pytest.approx(other, abs=1e-3)
    world.editor.delete("inside")
    world.run(10)
    assert {"inside", "bunch_00000"}.isdisjoint(world.names)


def use(world: Alone, steps: int = 40) -> None:
    """Drive towards the vines with a moving lift."""
    robot = world.client.robot
    for i in range(steps):
        robot.command_base(0.8, 0.1, world.client.physics.time)
        robot.command_position([0.2 * np.sin(0.1 * i)], ["lift"])
        world.client.tick()


def test_after_a_reset_the_world_goes_as_a_new_one_to_the_bit(world):
    """Trees, cuts, bunches, boxes and the robot are those of a new client; only time goes on."""
    use(world)
    world.client.physics.pick(0)
    world.client.physics.cut(int(world.client.model.tree_first[1]) + 8)
    world.editor.delete("box_1")
    world.spawn("vinesim:person", 0.0, -3.0)
    use(world, 20)
    tick = world.client.physics.tick
    world.editor.reset()
    assert world.client.physics.tick == tick
    assert world.names == {"cart", "box_0", "box_1", "bunch_00000", "bunch_00001"}
    fresh = Alone()
    use(world)
    use(fresh)
    for name, values in fresh.state.items():
        np.testing.assert_array_equal(world.state[name], values, err_msg=name)


def test_a_reset_of_the_state_keeps_what_was_spawned_where_it_was_spawned(world):
    world.spawn("vinesim:box", 3.0, -2.0, name="crate")
    world.spawn("vinesim:person", 5.0, -2.0, name="anna")
    world.spawn("vinesim:bunch/1", 3.0, -2.0, 0.1, "loose")
    world.editor.set_state(EntityArguments("crate", frames.pose([7.0, 7.0, 0.0])))
    world.editor.set_state(EntityArguments("anna", frames.pose([8.0, 7.0, 0.0])))
    world.editor.set_state(EntityArguments("cart", frames.pose([8.0, 0.0, 0.0])))
    world.run()
    world.editor.reset(keep_spawned=True)
    world.run(5)
    assert world.entity("crate").pose[:2] == pytest.approx([3.0, -2.0], abs=0.01)
    assert world.entity("anna").pose[:2] == pytest.approx([5.0, -2.0], abs=0.05)
    assert world.entity("cart").pose[:2] == pytest.approx(START[:2], abs=0.01)
    assert "loose" in world.names
    world.editor.reset(keep_state=True)
    assert world.names == {"cart", "box_0", "box_1", "bunch_00000"}


@pytest.mark.long
def test_resets_leave_nothing_behind(world):
    """Neither the physics before nor threads; counts of faults go on."""
    physics = []
    threads = threading.active_count()
    world.client.physics.grasp_manager.refused_grasps = 3
    for _ in range(3):
        physics.append(weakref.ref(world.client.physics))
        world.spawn("vinesim:person", 3.0, -2.0)
        world.spawn("vinesim:box", 5.0, -2.0)
        world.run(3)
        world.editor.reset()
        world.run(3)
    gc.collect()
    assert [one() for one in physics] == [None] * 3
    assert threading.active_count() == threads
    assert count_faults(world.client)["grasps_refused"] == 3
