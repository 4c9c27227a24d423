"""``vinesim replay``: play a recording again."""

from __future__ import annotations

import contextlib
import os
import pathlib
import sys
import threading
import time
from typing import TYPE_CHECKING

import numpy as np

from vinesim.cli.signals import stop_at_signals
from vinesim.core.errors import UsageError, writing
from vinesim.net.codec.control import decode_hello
from vinesim.net.codec.header import MessageError
from vinesim.net.codec.human import decode_pose
from vinesim.net.codec.messages import sender_of
from vinesim.net.recording.mcap_reader import InvalidRecording, Recording, read_recording
from vinesim.net.transport.endpoints import check_exposure

if TYPE_CHECKING:
    from vinesim.client.page.page_replay import PageReplay
    from vinesim.client.recording.replay import ReplayBus
    from vinesim.client.spectator import Spectator
    from vinesim.scene.model import Model
    from vinesim.scene.spec import Scene

POLL = 0.004
"""Wall time between two checks for messages that are due [s]."""


def run(
    *,
    file: pathlib.Path,
    connect: str | None,
    listen: str | None,
    insecure: bool,
    world: str,
    speed: float,
    start: float,
    end: float | None,
    out: pathlib.Path | None,
    page: int | None,
    ros: bool,
    pose: tuple[float, float, float] | None,
    scene: str | None,
    seed: int | None,
) -> int:
    """Play a recording. Returns 0 when its end is reached, or after Ctrl-C."""
    if sum(way is not None for way in (connect, listen, out, page)) + ros != 1:
        raise UsageError(
            "give one of --connect (play to a server), --listen (act as a server), --page (show it in a browser), "
            "--out (pictures) and --ros (topics)"
        )
    if listen is not None:
        check_exposure([listen], insecure=insecure)
    tape = read_recording(file)
    if tape.damage:
        print(tape.damage, file=sys.stderr, flush=True)
    if not tape.messages:
        raise InvalidRecording(f"{file} holds no message: nothing can be replayed")
    if start >= tape.length or (end is not None and end <= start):
        raise UsageError(f"--from {start:g}{'' if end is None else f' --to {end:g}'}: {file} lasts {tape.length:.1f} s")
    stop = stop_at_signals(threading.Event())
    who = ", ".join(tape.actors) or "no actors"
    print(f"{file}: {len(tape.messages)} messages, {tape.length:.1f} s, {who}", file=sys.stderr, flush=True)
    if out is not None:
        return _look(tape, stop, out, pose, scene, seed, speed, start, end)
    if page is not None:
        return _show(tape, stop, page, pose, scene, seed, speed, start, end)
    if ros:
        return _publish(tape, stop, scene, seed, speed, start, end)
    return _tell(tape, stop, connect, listen, world, speed, start, end)


def _tell(
    tape: Recording,
    stop: threading.Event,
    connect: str | None,
    listen: str | None,
    world: str,
    speed: float,
    start: float,
    end: float | None,
) -> int:
    """Play to the clients of a server, or as a server. Returns the exit code."""
    from vinesim.client.recording.replay import Replay
    from vinesim.net.server.server import Server
    from vinesim.net.transport.zenoh_bus import ZenohBus

    with contextlib.ExitStack() as stack:
        if listen is not None:
            server = stack.enter_context(Server(listen))
            connect = server.endpoint
            print(f"listening on {connect}", flush=True)
            while not (server.actors or stop.wait(POLL)):  # begin when the first client has joined
                pass
        assert connect is not None
        endpoint = connect

        def bus(name: str, live: bool = True) -> ZenohBus:
            return ZenohBus(name, connect=endpoint, world=world, live=live)

        teller = stack.enter_context(bus(f"replay-{os.getpid()}", live=False))
        play = Replay(tape, teller, bus, time.monotonic(), speed=speed, start=start, end=end)
        stack.callback(play.close)
        while not (play.ended or stop.wait(POLL)):
            play.step(time.monotonic())
    print(f"{play.sent} messages were sent", file=sys.stderr)
    return 0


def _look(
    tape: Recording,
    stop: threading.Event,
    out: pathlib.Path,
    pose: tuple[float, float, float] | None,
    scene: str | None,
    seed: int | None,
    speed: float,
    start: float,
    end: float | None,
) -> int:
    """Play to a spectator in this process, as fast as it can render pictures, and save them. The pictures are the same
    every time."""
    from vinesim.client.spectator import PictureWriter

    spectator, bus = _spectator(tape, pose, scene, seed, start, end)
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    pictures = PictureWriter(spectator, out, 1.0)
    while not (bus.ended or stop.is_set()):
        _step(spectator, bus, speed, follow=pose is None)
    pictures.save(spectator)
    print(f"{pictures.count} pictures are in {out}/", file=sys.stderr)
    return 0


def make_page_replay(
    tape: Recording,
    pose: tuple[float, float, float] | None = None,
    scene: str | None = None,
    seed: int | None = None,
    speed: float = 1.0,
    start: float = 0.0,
    end: float | None = None,
) -> PageReplay:
    """Returns a recording that pages can play; arguments as for :func:`run`."""
    from vinesim.client.page.page_replay import PageReplay

    plan, model = _vineyard(tape, scene, seed)

    def make(begin: float, eyes: np.ndarray | None) -> tuple[Spectator, ReplayBus]:
        return _spectator_in(tape, plan, model, _eyes(tape, model, pose) if eyes is None else eyes, begin, end)

    return PageReplay(make, tape.length if end is None else min(end, tape.length), start, speed)


def _show(
    tape: Recording,
    stop: threading.Event,
    port: int,
    pose: tuple[float, float, float] | None,
    scene: str | None,
    seed: int | None,
    speed: float,
    start: float,
    end: float | None,
) -> int:
    """Play to a spectator in this process and show its view in browsers, which can pause the recording and go to other
    times."""
    from vinesim.web import page_files

    page_files.check()
    from vinesim.client.rate_loop import RateLoop
    from vinesim.web.page_server import PageServer

    replay = make_page_replay(tape, pose, scene, seed, speed, start, end)
    with PageServer(replay.world, port) as server:
        print(f"the recording in a browser: {server.address}", file=sys.stderr, flush=True)
        loop = RateLoop(replay.dt)
        was_playing = True
        while not stop.is_set():
            if not was_playing:
                stop.wait(POLL)
                loop = RateLoop(loop.dt)
            loop.begin()
            was_playing = replay.step(server)
            loop.end()
    return 0


def _publish(
    tape: Recording,
    stop: threading.Event,
    scene: str | None,
    seed: int | None,
    speed: float,
    start: float,
    end: float | None,
) -> int:
    """Play to a spectator in this process in real time, and publish its view as ROS topics."""
    from vinesim.ros import middleware

    if (reason := middleware.unavailable_reason()) is not None:
        print(f"ROS 2 is not usable here: {reason}")
        return 3
    from vinesim.client.rate_loop import RateLoop
    from vinesim.client.recording.ros_replay import RosReplay
    from vinesim.ros.world_node import WorldNode

    middleware.configure(large_messages=False)
    spectator, bus = _spectator(tape, None, scene, seed, start, end)
    loop = RateLoop(spectator.physics.dt)
    with WorldNode("vinesim_replay") as node:
        RosReplay(spectator, node, lambda: bus.time)
        while not (bus.ended or stop.is_set()):
            loop.begin()
            _step(spectator, bus, speed, follow=True)
            loop.end()
        sent = sum(node.sent.values())
    print(f"{sent} messages were published", file=sys.stderr)
    return 0


def _spectator(
    tape: Recording,
    pose: tuple[float, float, float] | None,
    scene: str | None,
    seed: int | None,
    start: float,
    end: float | None,
) -> tuple[Spectator, ReplayBus]:
    """Returns a spectator of a recording, and its bus. The spectator stands at ``pose``, by default behind the first
    robot."""
    plan, model = _vineyard(tape, scene, seed)
    return _spectator_in(tape, plan, model, _eyes(tape, model, pose), start, end)


def _vineyard(tape: Recording, scene: str | None, seed: int | None) -> tuple[Scene, Model]:
    """Returns the scene of a recording, and its model."""
    from vinesim.scene.generation.vineyard import generate
    from vinesim.scene.spec import SceneError, load_scene, with_seed

    if scene is None and "scene" not in tape.metadata:
        raise UsageError(f"{tape.path} does not contain the name of its scene: give --scene")
    if seed is None and "seed" in tape.metadata:
        seed = int(tape.metadata["seed"])
    try:
        plan = with_seed(load_scene(scene or tape.metadata["scene"]), seed)
    except SceneError as error:
        raise SceneError(f"the scene of {tape.path}: {error}; give --scene FILE") from error
    model = generate(plan)
    digest = tape.metadata.get("digest", model.digest())
    if digest != model.digest():
        raise InvalidRecording(
            f"{tape.path} is of scene {tape.metadata.get('scene', '?')!r} with digest {digest}, "
            f"{plan.name!r} with seed {plan.seed} has {model.digest()}: give its --scene and --seed"
        )
    return plan, model


def _eyes(tape: Recording, model: Model, pose: tuple[float, float, float] | None) -> np.ndarray:
    """Returns the pose [7] of a spectator's eyes at ``pose``, by default behind the first robot."""
    from vinesim.client.page.first_view import first_view
    from vinesim.client.spectator import standing_view

    if pose is not None:
        return standing_view(*pose, model.terrain)
    return first_view(_first_pose(tape), model, model.forward_kinematics(model.joint_settled)[:, :3])


def _spectator_in(
    tape: Recording, plan: Scene, model: Model, eyes: np.ndarray, start: float, end: float | None
) -> tuple[Spectator, ReplayBus]:
    """Returns a spectator at the time ``start`` [s] of a recording, and its bus."""
    from vinesim.client.recording.replay import ReplayBus
    from vinesim.client.spectator import Spectator

    bus = ReplayBus(tape, "spectator", start=start, end=end)
    return Spectator(plan, model, None, bus, name="spectator", pose=eyes, clock=lambda: bus.time), bus


def _step(spectator: Spectator, bus: ReplayBus, speed: float, *, follow: bool) -> None:
    """Step a spectator once; ``follow``: its eyes stay behind the first robot."""
    from vinesim.client.spectator import follow_view

    bus.play(spectator.physics.dt * speed)
    rigid = spectator.physics.rigid
    if follow and rigid.robots:
        spectator.pose = follow_view(rigid.base_state(min(rigid.robots))[0], spectator.model.terrain)
    spectator.tick()


def _first_pose(tape: Recording) -> np.ndarray:
    """Returns the pose [7] at which the first robot appears in the recording; without robots, the pose of the first
    person."""
    for kind in ("robot", "human"):
        such = set()
        for entry in tape.messages.of("hello"):
            with contextlib.suppress(MessageError):
                if decode_hello(entry.payload).kind == kind:
                    such.add(sender_of(entry.key))
        for entry in tape.messages.of("a", "pose") if such else ():
            if sender_of(entry.key) in such:
                with contextlib.suppress(MessageError):
                    return decode_pose(entry.payload, "").base_q
    raise UsageError(f"{tape.path} has no pose of an actor to look from: give --pose X Y YAW")
