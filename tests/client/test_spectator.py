"""The spectator: displays what happens near it, live and in a replay, and changes nothing."""

from __future__ import annotations

import pathlib

import cv2
import numpy as np
import pytest

from tests.client.test_recorder import World
from tests.client.test_replay import recorded_trees
from tests.support.recorded_world import TICK, MinimalClient, vineyard
from vinesim.cli.replay import run as replay
from vinesim.client.client import Client
from vinesim.client.recording.recorder import Recorder
from vinesim.client.recording.replay import ReplayBus
from vinesim.client.spectator import EYE_HEIGHT, FOLLOW_DISTANCE, Spectator, follow_view, standing_view
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.net.codec.control import decode_time, encode_time
from vinesim.net.codec.trees import RESTING
from vinesim.net.recording.mcap_reader import InvalidRecording, Recording, read_recording
from vinesim.net.recording.mcap_writer import RecordingWriter
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description as load_robot
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene


@pytest.fixture(scope="module")
def bent(tmp_path_factory) -> Recording:
    """Ada bends a tree beside Bob and leaves it at rest."""
    world = World(tmp_path_factory.mktemp("bent") / "run.mcap")
    world.run(1.0)
    world.touch()
    world.run(0.3)
    return world.recorded()


def watch(recording: Recording) -> tuple[list[bytes], dict[int, np.ndarray]]:
    """States of all plants of a spectator beside the tree, tick by tick; those of the tree by tick index."""
    bus = ReplayBus(recording, "viewer")
    pose = standing_view(1.5, 0.0, np.pi)
    spectator = Spectator(load_scene("demo"), vineyard(), None, bus, name="viewer", pose=pose, clock=lambda: bus.time)
    bodies = vineyard().bodies_of(0)
    states = []
    tree = {}
    while not bus.ended:
        bus.play(TICK)
        spectator.tick()
        states.append(spectator.physics.state.joint_q.tobytes() + spectator.physics.state.joint_qd.tobytes())
        if 0 in spectator.tree_copies:
            tree[len(states)] = spectator.physics.state.joint_q[bodies].copy()
    return states, tree


@pytest.mark.long
def test_two_replays_move_the_trees_equally(bent):
    (first, tree) = watch(bent)
    (second, _) = watch(bent)
    assert first == second
    assert len(set(first)) > 80
    # the displayed state follows the recorded one
    times = {number: bent.start + number * TICK for number in tree}
    records = recorded_trees(bent)
    errors = []
    for number, displayed in tree.items():
        earlier = [record for record in records if record.time <= times[number] - 0.1]
        if earlier and not earlier[-1].flags[0] & RESTING:
            nearest = min(
                float(np.abs((record.joint_q * displayed).sum(1)).min() - 1.0) ** 2
                for record in records
                if abs(record.time - times[number]) < 0.15
            )
            errors.append(nearest)
    assert len(errors) > 50
    assert max(errors) < 1e-4


def test_a_spectator_owns_nothing_even_when_an_owner_leaves():
    hub = MemoryHub(delay=0.004)
    ada = MinimalClient(hub.bus("ada"), 0.5)
    spectator = MinimalClient(hub.bus("aaa"), 0.6, kind="spectator", joints=0)
    bob = MinimalClient(hub.bus("bob"), 3.0)

    def run(*clients: MinimalClient, seconds: float = 0.5) -> None:
        for _ in range(round(seconds / TICK)):
            hub.advance(TICK)
            for client in clients:
                client.tick(hub.time)

    run(ada, spectator, bob)
    for number in range(30):
        ada.bend(0, 0.02 * number)
        run(ada, spectator, bob, seconds=TICK)
    assert spectator.replicator.owner(0) == "ada"
    bob.moving = spectator.moving = {0}
    ada.bus.close()
    run(spectator, bob)
    # the spectator is nearer and has the lower name
    assert bob.replicator.owner(0) == "bob"
    assert spectator.replicator.owner(0) == "bob"
    assert spectator.environment() == 0


def test_views_stand_and_follow():
    view = standing_view(2.0, 3.0, np.pi / 2)
    np.testing.assert_allclose(frames.rotate(view[3:], np.array([1.0, 0.0, 0.0])), [0.0, 1.0, 0.0], atol=1e-9)
    for yaw in (0.0, 2.5, -1.0):
        robot = frames.pose([1.0, -2.0, 0.0], frames.from_yaw(yaw))
        view = follow_view(robot)
        ahead = frames.rotate(view[3:], np.array([1.0, 0.0, 0.0]))
        assert view[2] == EYE_HEIGHT
        np.testing.assert_allclose(view[:2] + FOLLOW_DISTANCE * ahead[:2], robot[:2], atol=1e-9)


@pytest.fixture(scope="module")
def robot_recording(tmp_path_factory) -> pathlib.Path:
    """Two seconds of a robot that turns its head, with a live spectator."""
    path = tmp_path_factory.mktemp("robot") / "run.mcap"
    hub = MemoryHub(delay=0.004)
    clock = hub.bus("server", live=False)
    clock.declare_queryable("clock/*", lambda payload: encode_time(decode_time(payload)[0], 1e9 + hub.time))
    scene = load_scene("demo")
    model = generate(scene)
    start = spawn_pose(scene, 0)
    picker = Client(
        scene, model, load_robot("vinebot"), hub.bus("picker"), name="picker", pose=start, clock=lambda: hub.time
    )
    view = follow_view(start)
    spectator = Spectator(scene, model, None, hub.bus("viewer"), name="viewer", pose=view, clock=lambda: hub.time)
    with RecordingWriter(path) as recording:
        recorder = Recorder(hub.bus("recorder", live=False), recording, clock=lambda: hub.time)
        picker.robot.command_position([0.5], ["head_1_joint"])
        for _ in range(200):
            hub.advance(TICK)
            picker.tick()
            spectator.tick()
            recorder.step()
        assert set(spectator.remote_actors) == {"picker"}
        assert spectator.replicator.counters.environment.bytes_out == 0
        assert picker.remote_actors == {}  # a spectator has no body
        head = picker.robot.description.joints.index("head_1_joint")
        assert spectator.physics.rigid.joint_measurements("picker")[0][head] == pytest.approx(0.5, abs=0.05)
    return path


def options(file: pathlib.Path, out: pathlib.Path, **changes) -> dict:
    defaults = {
        "connect": None,
        "listen": None,
        "insecure": False,
        "world": "vineyard",
        "speed": 1.0,
        "start": 0.0,
        "end": None,
        "page": None,
        "ros": False,
    }
    return defaults | {"file": file, "out": out, "pose": None, "scene": None, "seed": None} | changes


@pytest.mark.long
def test_a_replay_is_rendered(robot_recording, tmp_path, capsys):
    assert read_recording(robot_recording).metadata.items() >= {"scene": "demo", "seed": "7"}.items()
    assert replay(**options(robot_recording, tmp_path, end=1.5)) == 0
    assert "picker" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir())[:4] == ["depth.png", "depth_mm.png", "labels.png", "rgb.png"]
    labels = cv2.imread(str(tmp_path / "labels.png"))
    white = (labels == 235 * np.array([1, 1, 1])).all(-1) | (labels.min(-1) > 160)
    assert white.sum() > 500  # the robot, in the middle of the picture
    assert (tmp_path / "view_00001.00.png").exists()


def test_another_scene_is_refused(robot_recording, tmp_path):
    with pytest.raises(InvalidRecording, match=r"digest .*: give its --scene and --seed"):
        replay(**options(robot_recording, tmp_path / "out", seed=8))
    assert not (tmp_path / "out").exists()
    with pytest.raises(UsageError, match=r"lasts \d"):
        replay(**options(robot_recording, tmp_path / "out", start=60.0))
