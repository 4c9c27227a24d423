"""Remote robots that join without delaying a tick or changing the state of others."""

from __future__ import annotations

import concurrent.futures
import errno
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from tests.support.contact_scenes import cane
from vinesim.client.remote.spawner import RemoteSpawner, resolve_description
from vinesim.core import frames
from vinesim.net.codec.control import Hello
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.sidecar import encode_sidecar
from vinesim.robot.description.urdf import DescriptionError
from vinesim.robot.drives.robot_instance import RemoteRobot
from vinesim.scene.builder import assemble
from vinesim.scene.values import RobotUpdate
from vinesim.world import Physics


class DeferredExecutor(concurrent.futures.Executor):
    """An executor that runs its work when the test calls ``work``."""

    def __init__(self) -> None:
        self.waiting: list[tuple[Callable, concurrent.futures.Future]] = []

    def submit(self, work: Callable) -> concurrent.futures.Future:
        future: concurrent.futures.Future = concurrent.futures.Future()
        self.waiting.append((work, future))
        return future

    def work(self) -> None:
        for work, future in self.waiting:
            try:
                future.set_result(work())
            except ValueError as error:
                future.set_exception(error)
        self.waiting.clear()


@pytest.fixture(scope="module")
def vinebot() -> RobotDescription:
    return load_description("vinebot")


def hello(description: RobotDescription, name: str = "guest", **change) -> Hello:
    defaults = {
        "robot": description.name,
        "urdf": description.urdf,
        "joints": len(description.joints),
        "index": 7,
        "sidecar": encode_sidecar(description.base_limits, description.groups),
    }
    return Hello(name, **{**defaults, **change})


def update_at(description: RobotDescription, x: float) -> RobotUpdate:
    position = description.home.copy()
    position[0] += 0.05
    return RobotUpdate("guest", 0.0, frames.pose([x, 0.0, 0.0]), np.zeros(6), position, np.zeros_like(position))


def world(description: RobotDescription) -> Physics:
    physics = Physics(assemble([cane((5.0, 5.0, 1.0), radius=0.005)]))
    physics.rigid.add_robot(description.to_spec("host", 1, frames.pose([0.0, 3.0, 0.0])))
    return physics


def test_no_tick_waits_for_a_robot_that_joins(vinebot):
    physics = world(vinebot)
    deferred = DeferredExecutor()
    spawner = RemoteSpawner(physics.rigid, vinebot, deferred)
    spawner.enqueue(hello(vinebot))
    for tick in range(5):
        assert spawner.spawn({"guest": update_at(vinebot, 0.1 * tick)}).get("guest") is None
        physics.step()
    assert physics.rigid.robots == ("host",)
    deferred.work()
    guest = spawner.spawn({"guest": update_at(vinebot, 0.5)}).get("guest")
    assert guest is not None
    assert guest.name == "guest"
    assert "guest" not in spawner
    position, velocity, *_ = physics.rigid.joint_measurements("guest")
    np.testing.assert_allclose(position, update_at(vinebot, 0.5).position, atol=1e-12)
    assert not velocity.any()
    assert physics.rigid.base_state("guest")[0][0] == pytest.approx(0.5)


def test_no_tick_waits_for_a_robot_that_leaves(vinebot):
    """Its copy stays until the world without it is compiled; then the others have the bits of a removal at once. Who
    comes back under the name meanwhile gets a body of its own."""
    waiting = world(vinebot)
    at_once = world(vinebot)
    deferred = DeferredExecutor()
    spawner = RemoteSpawner(waiting.rigid, vinebot, deferred)
    pose = frames.pose([0.0, 0.0, 0.0])
    for physics in (waiting, at_once):
        physics.rigid.add_robot(vinebot.to_spec("guest", 7, pose))
        physics.step()
    copy = RemoteRobot(waiting.rigid, vinebot, "guest", 7, pose, is_in_world=True)
    spawner.remove("guest", copy)
    assert spawner.spawn({}) == {}
    assert spawner.removed() == []
    for physics in (waiting, at_once):
        physics.step()
    assert waiting.rigid.robots == ("host", "guest")
    deferred.work()
    assert spawner.spawn({}) == {}
    assert spawner.removed() == ["guest"]
    at_once.rigid.remove_robot("guest")
    for physics in (waiting, at_once):
        for _ in range(3):
            physics.step()
        assert physics.rigid.robots == ("host",)
    assert waiting.rigid.mj_data.qpos.tobytes() == at_once.rigid.mj_data.qpos.tobytes()
    assert spawner.spawn({}) == {}
    assert not deferred.waiting


def test_a_robot_that_comes_back_before_its_copy_was_removed_is_placed_anew(vinebot):
    physics = world(vinebot)
    deferred = DeferredExecutor()
    spawner = RemoteSpawner(physics.rigid, vinebot, deferred)
    pose = frames.pose([0.0, -3.0, 0.0])
    physics.rigid.add_robot(vinebot.to_spec("guest", 7, pose))
    spawner.remove("guest", RemoteRobot(physics.rigid, vinebot, "guest", 7, pose, is_in_world=True))
    spawner.enqueue(hello(vinebot))
    updates = {"guest": update_at(vinebot, 1.0)}
    assert spawner.spawn(updates) == {}
    deferred.work()
    guest = spawner.spawn(updates)["guest"]
    assert spawner.removed() == ["guest"]
    assert physics.rigid.robots == ("host", "guest")
    assert np.allclose(physics.rigid.base_state("guest")[0][:3], (1.0, 0.0, 0.0))
    physics.step()
    guest.remove()
    assert physics.rigid.robots == ("host",)


def test_a_prepared_and_an_immediate_join_give_the_same_bits(vinebot):
    def run(prepared: bool) -> bytes:
        physics = world(vinebot)
        physics.rigid.command("host", vinebot.home + 0.2)
        draft = (
            physics.rigid.compile_with(vinebot.to_spec("guest", 7, frames.pose([1.0, 0.0, 0.0]))) if prepared else None
        )
        for _ in range(20):
            physics.step()
        if draft is None:
            physics.rigid.add_robot(vinebot.to_spec("guest", 7, frames.pose([1.0, 0.0, 0.0])))
        else:
            assert physics.rigid.adopt(draft)
        for _ in range(20):
            physics.step()
        return physics.rigid.mj_data.qpos.tobytes() + physics.rigid.mj_data.qvel.tobytes()

    assert run(True) == run(False)


def test_a_world_that_changed_during_compilation_is_compiled_again(vinebot):
    physics = world(vinebot)
    deferred = DeferredExecutor()
    spawner = RemoteSpawner(physics.rigid, vinebot, deferred)
    spawner.enqueue(hello(vinebot))
    update = update_at(vinebot, 0.0)
    spawner.spawn({"guest": update}).get("guest")
    deferred.work()
    physics.rigid.add_robot(vinebot.to_spec("other", 2, frames.pose([0.0, -3.0, 0.0])))
    assert spawner.spawn({"guest": update}).get("guest") is None
    assert physics.rigid.robots == ("host", "other")
    assert spawner.spawn({"guest": update}).get("guest") is None
    deferred.work()
    assert spawner.spawn({"guest": update}).get("guest") is not None
    assert physics.rigid.robots == ("host", "other", "guest")


def test_an_actor_that_leaves_before_being_ready_is_not_spawned(vinebot):
    physics = world(vinebot)
    deferred = DeferredExecutor()
    spawner = RemoteSpawner(physics.rigid, vinebot, deferred)
    spawner.enqueue(hello(vinebot))
    spawner.spawn({"guest": update_at(vinebot, 0.0)}).get("guest")
    spawner.cancel("guest")
    deferred.work()
    assert "guest" not in spawner
    assert physics.rigid.robots == ("host",)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"joints": 3}, "announces 3 joints"),
        ({"urdf": "<robot name='x'/>", "robot": "x"}, "cannot be shown"),
        ({"urdf": "no xml", "robot": "../../tmp/x"}, "cannot be shown"),
    ],
)
def test_a_robot_that_cannot_be_loaded_is_logged_once(vinebot, caplog, change, reason):
    physics = world(vinebot)
    spawner = RemoteSpawner(physics.rigid, vinebot)
    spawner.enqueue(hello(vinebot, **change))
    assert spawner.spawn({"guest": update_at(vinebot, 0.0)}).get("guest") is None
    assert "guest" not in spawner
    (record,) = caplog.records
    assert reason in record.getMessage()
    physics.step()
    assert physics.rigid.robots == ("host",)


def test_a_robot_name_from_the_network_is_not_a_path(vinebot, tmp_path, monkeypatch):
    """The robot name in a hello names a file, which must stay in its folder."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    text = vinebot.urdf.replace("<robot ", "<!-- another --><robot ", 1)
    found = resolve_description(hello(vinebot, urdf=text, robot="../escaped"), vinebot)
    assert found.joints == vinebot.joints
    assert list(tmp_path.rglob("*")) == []


def test_a_robot_name_from_the_network_opens_no_pipe_and_no_file_of_the_folder(vinebot, tmp_path, monkeypatch):
    """``-`` means the standard input for ``--robot`` only, and ``other.urdf`` may be a file of the user."""
    (tmp_path / "other.urdf").write_text(vinebot.urdf)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("vinesim.client.remote.stranger.load_description", lambda file, **options: (file, options))
    for name in ("-", "other.urdf"):
        file, options = resolve_description(hello(vinebot, urdf="<robot/>", robot=name), vinebot)
        assert options["is_remote"]
        assert file.parent != tmp_path


def test_a_robot_of_another_client_has_the_gains_that_its_sender_gave_it(vinebot):
    """The sender's TOML file does not exist here: groups, gains and limits come with the hello."""
    stiffer = {
        name: msgspec.structs.replace(group, stiffness=tuple(1234.0 for _ in group.joints))
        for name, group in vinebot.groups.items()
    }
    base = msgspec.structs.replace(vinebot.base_limits, effort=(500.0, 300.0))
    there = hello(vinebot, sidecar=encode_sidecar(base, stiffer))
    found = resolve_description(there, vinebot)
    assert found is not vinebot
    assert found.base_limits == base
    assert found.joints == vinebot.joints
    grouped = {joint for group in stiffer.values() for joint in group.joints}
    assert {drive.stiffness for drive in found.drives if drive.joint in grouped} == {1234.0}
    np.testing.assert_allclose(found.home, vinebot.home)
    assert resolve_description(hello(vinebot), vinebot) is vinebot


def with_group(vinebot: RobotDescription, **change) -> str:
    name, group = next(iter(vinebot.groups.items()))
    return encode_sidecar(vinebot.base_limits, {name: msgspec.structs.replace(group, **change)})


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (lambda _: "{", "truncated"),
        (lambda _: '{"cameras": [], "unknown": 1}', "unknown"),
        (lambda _: " " * (1 << 17), "B; send at most"),
        (
            lambda robot: with_group(
                robot,
                joints=("no such joint",),
                stiffness=None,
                damping=None,
                armature=None,
                series_stiffness=None,
                series_damping=None,
                home=None,
            ),
            "no driven joint",
        ),
        (lambda robot: with_group(robot, stiffness=(1e300,) * 9), "stiffness"),
        (lambda robot: with_group(robot, damping=(-1.0,) * 9), "damping"),
    ],
)
def test_a_sidecar_that_no_robot_has_is_refused(vinebot, text, reason):
    with pytest.raises(DescriptionError, match=reason):
        resolve_description(hello(vinebot, sidecar=text(vinebot)), vinebot)


def test_a_sidecar_from_the_network_names_no_sensor_file(vinebot):
    """Sensors act where the robot is simulated; a file name in their place is not read."""
    sidecar = '{"cameras": [{"name": "x", "frame": "base_link", "type": "../../etc/passwd"}], "groups": {}}'
    found = resolve_description(hello(vinebot, sidecar=sidecar), vinebot)
    assert all("passwd" not in camera.type for camera in found.sensors_of("camera"))


def test_a_full_disk_costs_the_robot_that_joins_and_not_the_tick(vinebot, monkeypatch, caplog):
    physics = world(vinebot)
    spawner = RemoteSpawner(physics.rigid, None)
    spawner.enqueue(hello(vinebot, robot="other", urdf=vinebot.urdf.replace("vinebot", "other")))

    def full(*_: object, **__: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_text", full)
    assert spawner.spawn({"guest": update_at(vinebot, 2.0)}) == {}
    assert "guest" not in spawner
    assert "the robot of guest cannot be shown" in caplog.text
    physics.step()
