"""A recording of a robot that turns its head and picks a bunch, for replays in pages."""

from __future__ import annotations

import pathlib

from vinesim.cli.replay import make_page_replay
from vinesim.client.client import Client
from vinesim.client.page.page_replay import PageReplay
from vinesim.client.recording.recorder import Recorder
from vinesim.client.tasks.start_poses import find_reachable_bunch, spawn_pose
from vinesim.net.codec.control import decode_time, encode_time
from vinesim.net.recording.mcap_reader import read_recording
from vinesim.net.recording.mcap_writer import RecordingWriter
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene

PICKED_AT = 1.5
LENGTH = 2.5
"""[s] of the recording."""


def record_a_pick(path: pathlib.Path) -> int:
    """Write a recording of the scene ``demo``; the bunch that is picked."""
    hub = MemoryHub(delay=0.004)
    scene = load_scene("demo")
    clock = hub.bus("server", live=False)
    clock.declare_queryable("clock/*", lambda asked: encode_time(decode_time(asked)[0], 1e6 + hub.time))
    model = generate(scene)
    start = spawn_pose(scene, 0)
    bunch = find_reachable_bunch(model, start)
    client = Client(
        scene,
        model,
        load_description("vinebot"),
        hub.bus("picker"),
        name="picker",
        pose=start,
        clock=lambda: hub.time,
    )
    with RecordingWriter(path) as recording:
        recorder = Recorder(hub.bus("recorder", live=False), recording, clock=lambda: hub.time, everything=True)
        client.robot.command_position([0.5], ["head_1_joint"])
        for step in range(round(LENGTH / client.physics.dt)):
            if step == round(PICKED_AT / client.physics.dt):
                client.physics.pick(bunch)
            hub.advance(client.physics.dt)
            client.tick()
            recorder.step()
    return bunch


def replay_of_a_pick(path: pathlib.Path) -> tuple[PageReplay, int]:
    """Write a recording and open it for pages; the bunch that is picked."""
    bunch = record_a_pick(path)
    return make_page_replay(read_recording(path)), bunch
