"""The part of a sensor process that runs in the process: it renders the sensors that have subscribers, and publishes
their topics."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import logging
import pathlib
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.context import BaseContext
from typing import TYPE_CHECKING, Any

import numpy as np

from vinesim.client.processes.rigid_visual_list import VisualListMessage, VisualListReceiver
from vinesim.client.processes.shared_memory import SharedArrays, SharedSnapshot
from vinesim.client.processes.worker import POLL_PERIOD, Worker, report_ready, serve
from vinesim.client.world_time import OffsetHistory
from vinesim.core import allocator, frames, progress
from vinesim.core.geodesy import APRILIA, Geodetic
from vinesim.kernels.compilation import SENSOR_PACKAGES, compile_kernels
from vinesim.plants.device_buffers import device_fault
from vinesim.robot.description.description import RobotDescription
from vinesim.ros.names import ros_name
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.scene.state import State
from vinesim.scene.values import (
    SENSOR_KINDS,
    CameraFrame,
    CameraMount,
    CameraOutput,
    LidarMount,
    RenderedMount,
    SegmentPoses,
    SensorFrame,
    SensorMode,
    SensorPacing,
    Snapshot,
    WindState,
)
from vinesim.scene.wind import Wind
from vinesim.wires.wire_segments import wire_segments

if TYPE_CHECKING:
    from vinesim.ros.sensor_node import SensorNode
    from vinesim.sensors.camera.sunlight import SunPath
    from vinesim.sensors.scheduler import SensorScheduler

log = logging.getLogger(__name__)

SEND_POLL = 5e-4
"""Time between two checks whether all messages were sent [s]."""
NICENESS = 10
"""Niceness of the process. The client's loop and the ROS process take precedence. With a much higher niceness, other
programs would starve the renderer (docs/decisions/sensor-process.md)."""
POSE_HISTORY = 128
"""Number of poses of each sensor that are kept for sensors that sweep, such as lidars. They span 2.5 s."""
OFFSET_HISTORY = 512
"""Number of offsets of the world's time that are kept for the stamps of scans. They span 10 s."""
RENEWAL_PERIOD = 1.0
"""Simulated time after which a picture replaces an older picture with the same score [s]."""
REHEARSAL_SCENE = "demo"
REHEARSAL_CAMERA = "d435"
REHEARSAL_LIDAR = "vlp16"
REHEARSAL_SIZE = (64, 48)
"""Size of the picture of :func:`rehearse` [px]. It may be small, because the first call of each kernel is what takes
long."""
LIVE = SensorPacing()


@dataclasses.dataclass(frozen=True)
class SensorConfig:
    """Data that the sensor process needs to start."""

    name: str
    """The robot's name."""
    model: Model
    description: RobotDescription
    sun: SunPath
    namespace: str
    """Prefix of the robot's topics."""
    ros: bool
    """Whether the process runs a ROS node."""
    keep_pictures: bool
    """Whether the best picture of the first camera is kept. If so, pictures are rendered even without subscribers."""
    sensor_hz: float | None
    """Rate of all sensors [Hz]. None: each sensor has its own rate."""
    device: str = "cpu"
    """Device on which the sensors compute. If a GPU has failed, the next run computes on the CPU."""
    pacing: SensorPacing = LIVE
    wind: Wind | None = None
    """Wind of the scene."""
    datum: Geodetic = APRILIA
    """Position of the world's origin on the Earth."""
    params_file: pathlib.Path | None = None
    """File with ROS parameters of the node."""
    parameters: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Values of the node's parameters that were set, by name. The client updates them, and each run starts with
    them."""

    @property
    def sensor_frames(self) -> dict[str, str]:
        """Link that carries each sensor, by the sensor's name. Poses in snapshots have this order."""
        return {mount.name: mount.frame for mount in self.description.sensors}


class SensorChannel:
    """Shared memory of a client and its sensor process: the newest snapshot of the world, and the process's demands."""

    def __init__(self, config: SensorConfig, context: BaseContext) -> None:
        model = config.model
        sensors = len(config.sensor_frames)
        bodies = len(model.body_mass)
        trees = len(model.tree_first)
        bunches = len(model.bunch_body)
        wires = len(wire_segments(model))
        self.snapshot = SharedSnapshot(
            {
                "time": ((1,), "f8"),
                "frame_score": ((1,), "f8"),
                "tick": ((1,), "i8"),
                "number": ((1,), "i8"),  # counts snapshots from 1
                "visuals_version": ((1,), "i8"),
                "visual_count": ((1,), "i8"),
                "body_q": ((bodies, 7), "f4"),
                "bunch_attached": ((bunches,), "?"),
                "leaf_off": ((len(model.leaf_body),), "?"),
                "stump_count": ((1,), "i8"),
                "stumps": ((int(model.tree_spares.sum()), 3), "f8"),
                "wire_count": ((1,), "i8"),
                "wire_segment": ((wires,), "i8"),
                "wire_q": ((wires, 7), "f4"),
                "tree_number": ((trees,), "i8"),  # the snapshot in which each tree moved last
                "wind_time": ((1,), "f8"),
                "wind_strength": ((1,), "f8"),  # 0: calm
                "tree_air": ((trees, 3), "f4"),
                "tree_drawn": ((trees,), "f4"),
                "pose_count": ((1,), "i8"),
                "pose_time": ((POSE_HISTORY,), "f8"),  # a ring of sensor poses
                "pose": ((POSE_HISTORY, sensors, 7), "f8"),
                "pose_world_offset": ((POSE_HISTORY,), "f8"),
            },
            context,
        )
        self.wanted = SharedArrays(
            {"world": ((1,), "?"), "horizon": ((1,), "f8"), "factor": ((1,), "f8"), "shown": ((1,), "i8")}
        )
        """Demands, which the process writes. ``world``: whether snapshots of the world are wanted. ``horizon``:
        simulated time that the world must not pass before the process has taken another snapshot [s]. ``factor``:
        largest real-time factor that the sensors can follow. ``shown``: number of the newest snapshot whose frames are
        all rendered and sent."""
        self.wanted["horizon"][0] = self.wanted["factor"][0] = np.inf

    def close(self) -> None:
        """Release the memory."""
        self.snapshot.close()
        self.wanted.close()


def run_sensor_worker(config: SensorConfig, channel: SensorChannel, pipe: Connection) -> None:
    """Function that a sensor process runs: render and publish until the client sends "stop"."""

    def work() -> None:
        with contextlib.ExitStack() as stack:
            SensorWorker(config, channel, pipe, stack).run()

    serve("sensor process", pipe, work)


def rehearse() -> None:
    """Render a first picture and a first lidar revolution of a small vineyard on the CPU, and release their memory.

    A sensor process that stands by has then loaded the kernels and modules that they need.
    """
    from vinesim.scene.generation.vineyard import generate
    from vinesim.sensors.camera.camera import Camera, CameraSpec
    from vinesim.sensors.lidar.lidar import Lidar, LidarSpec
    from vinesim.sensors.scheduler import ScheduledSensor, SensorScheduler
    from vinesim.sensors.sensor import load_kernels

    load_kernels(CameraMount.kind, LidarMount.kind)
    scene = load_scene(REHEARSAL_SCENE)
    spec = CameraSpec.load(REHEARSAL_CAMERA)
    model = generate(scene)
    camera = Camera(spec, spec.info("camera", size=REHEARSAL_SIZE), "camera", scene.sun.direction)
    lidar = Lidar(LidarSpec.load(REHEARSAL_LIDAR), "lidar")
    sensors = [ScheduledSensor(sensor, lambda _: None) for sensor in (camera, lidar)]
    state = State.at_rest(model)
    trees = np.arange(len(model.tree_first))
    pose = frames.pose(np.array([0.0, 0.0, 1.0]))
    snapshot = Snapshot(0.0, 0, state.body_q, state.bunch_attached, (), np.zeros((0, 7)), trees)
    for _ in SensorScheduler(model, sensors).warm_up(snapshot, {sensor.name: pose for sensor in sensors}):
        pass
    del sensors, camera, lidar, model, state, snapshot
    allocator.release_free_memory()


class PictureKeeper:
    """Keeps the picture of a camera with the highest score, and requests a picture only if it would be kept.

    A picture costs the same with a subscriber and without, and only one picture is written to a file in the end
    (docs/decisions/sensor-process.md).
    """

    def __init__(self) -> None:
        self.frame: CameraFrame | None = None
        """The picture that is kept: colours, depth and labels."""
        self._score = 0.0

    def wants(self, time: float, score: float) -> bool:
        """Returns whether a picture of this simulated ``time`` [s] and ``score`` would be kept: its score is higher
        than that of the kept picture, or the same and the picture is at least :data:`RENEWAL_PERIOD` later."""
        if self.frame is None or score > self._score:
            return True
        return score == self._score and time >= self.frame.time + RENEWAL_PERIOD

    def keep(self, frame: CameraFrame, score: float) -> None:
        """Keep this ``frame`` and its ``score`` instead of the present picture."""
        self.frame = frame
        self._score = score


class SensorWorker(Worker):
    """The robot's sensors and their ROS node, in the sensor process. Their input is the snapshots of the world."""

    def __init__(
        self, config: SensorConfig, channel: SensorChannel, pipe: Connection, stack: contextlib.ExitStack
    ) -> None:
        """Opens the node and the sensors. ``stack`` closes the node."""
        super().__init__(pipe)
        self.config = config
        self.channel = channel
        self.frames_skipped = 0
        """Number of snapshots that could not be shown because their list of bodies had not arrived."""
        self._state = State.at_rest(config.model)
        self._visuals = VisualListReceiver()
        self._missing_version: int | None = None
        """Version of the list of bodies of the newest snapshot, if this list has not arrived. Otherwise None."""
        self._offsets = OffsetHistory(OFFSET_HISTORY)
        self._last_number = 0
        self._must_count = False
        """Whether the client waits for the counts."""
        self._pose_count = 0
        self._keeper = PictureKeeper() if config.keep_pictures else None
        self._kept_camera = next((mount.name for mount in config.description.sensors_of(CameraMount.kind)), "")
        self._is_lockstep = config.pacing.mode is SensorMode.LOCKSTEP
        self._digests = {name: hashlib.blake2b(digest_size=16) for name in config.sensor_frames}
        """Digest of all frames that each sensor has delivered in lockstep, by the sensor's name."""
        self._time = self._frame_score = 0.0  # of the newest snapshot
        self._stumps = np.zeros((0, 3))
        self._awaits("kernels and scene")
        self.node = self._open_node(stack) if config.ros else None
        if self.node is not None:
            self._watch_parameters(self.node)
        self.scheduler = self._open_sensors()

    def _awaits(self, *parts: str) -> None:
        self.pipe.send(("awaited", parts))

    @contextlib.contextmanager
    def _awaiting_progress(self) -> Iterator[None]:
        """Context in which the client receives the messages of :mod:`vinesim.core.progress`. They also show that the
        process does not hang."""
        handler = logging.Handler()
        handler.emit = lambda record: self._awaits(record.getMessage()) if record.getMessage() else None
        progress.log.setLevel(logging.INFO)
        progress.log.addHandler(handler)
        try:
            yield
        finally:
            progress.log.removeHandler(handler)

    # ------------------------------------------------------------------ construction

    def _open_node(self, stack: contextlib.ExitStack) -> SensorNode:
        from vinesim.ros.sensor_node import SensorNode
        from vinesim.sensors.sensor import maker

        config = self.config
        return stack.enter_context(
            SensorNode(
                f"{ros_name(config.name)}_sensors",
                namespace=config.namespace,
                sensors={mount.name: mount.kind for mount in config.description.sensors},
                channels={mount.name: maker(mount.kind).channels(mount.type) for mount in config.description.sensors},
                rates=self._rates(),
                params_file=config.params_file,
                parameters=config.parameters,
            )
        )

    def _rates(self) -> dict[str, float]:
        """Returns the rate of each sensor at the start [Hz], by name."""
        from vinesim.sensors.sensor import maker

        given = self.config.sensor_hz
        return {m.name: given or m.rate or maker(m.kind).rate(m.type) for m in self.config.description.sensors}

    def _present_rate(self, name: str) -> Callable[[], float] | None:
        """Returns a function that returns the rate of a sensor from its ROS parameter [Hz]. None without a node."""
        return None if self.node is None else partial(self.node.rate, name)

    def _open_sensors(self) -> SensorScheduler:
        from vinesim.sensors.primitives.scene_primitives import Primitives
        from vinesim.sensors.scheduler import ScheduledSensor, SensorScheduler
        from vinesim.sensors.sensor import SensorSetting, load_kernels, maker

        config = self.config
        device = self._working_device()
        with self._awaiting_progress():
            compile_kernels(SENSOR_PACKAGES, device)
        self._awaits("kernels and scene")
        if device == "cpu":
            load_kernels(*{mount.kind: None for mount in config.description.sensors})
        seed = zlib.crc32(config.name.encode())  # no two robots have the same noise
        setting = SensorSetting(config.sun, seed, device=device, datum=config.datum)
        sensors = [
            ScheduledSensor(
                maker(mount.kind).make(mount, setting),
                self._deliver,
                self._demand(mount),
                config.sensor_hz or mount.rate,
                self._present_rate(mount.name),
            )
            for mount in config.description.sensors
        ]
        primitives = Primitives(config.model, device=device)
        return SensorScheduler(
            config.model, sensors, primitives=primitives, pacing=config.pacing, on_taken=self._publish_pace
        )

    def _working_device(self) -> str:
        """Returns the device of the configuration, or "cpu" if that device can no longer be used. The client receives
        the name of the device."""
        device = self.config.device
        if device != "cpu" and (fault := device_fault(device)) is not None:
            log.error("the sensors of %s compute on the CPU: %s", self.config.name, fault)
            device = "cpu"
        self.pipe.send(("device", device))
        return device

    def _demand(self, mount: RenderedMount) -> Callable[[], CameraOutput]:
        """Returns a function that returns the outputs of a sensor that are needed now: by its subscribers, or for the
        kept picture."""
        name = mount.name
        whole = SENSOR_KINDS[mount.kind].whole
        keeper = self._keeper if name == self._kept_camera else None
        node = self.node

        def demand() -> CameraOutput:
            wanted = CameraOutput.NONE if node is None else node.outputs_wanted(name)
            if self._is_lockstep or (keeper is not None and keeper.wants(self._time, self._frame_score)):
                return wanted | whole
            return wanted

        return demand

    # ------------------------------------------------------------------ loop

    def run(self) -> None:
        """Warm up the sensors with the first snapshot, report "ready", then render until the client sends "stop"."""
        is_ready = False
        self._awaits("snapshot of the world")
        while self._take_messages():
            if self._wait_for_snapshot() and (world := self._read()) is not None:
                snapshot, earlier = world
                poses = earlier.pop()[1]
                if is_ready:
                    self.scheduler.advance(snapshot, poses, earlier)
                    if self._is_lockstep:
                        self._wait_until_sent()
                else:
                    for name in self.scheduler.warm_up(snapshot, poses):
                        self._awaits(name)
                    is_ready = True
                    self._awaits()
                    report_ready(self.pipe, NICENESS)
                    allocator.release_free_memory()  # takes 0.1 s, for which nothing waits here
                self.channel.wanted["shown"][0] = self._last_number
            if self._must_count:  # now that the snapshots before the request are rendered
                self._must_count = False
                self._send_statistics()
                self.pipe.send(("counted", None))
            is_rendering = any(sensor.wanted() for sensor in self.scheduler.sensors)
            self.channel.wanted["world"][0] = is_rendering or self._keeper is not None
            self._publish_pace()
            self._report()

    def _publish_pace(self) -> None:
        """Write the time up to which the world may continue, and the largest real-time factor, to the shared memory."""
        wanted = self.channel.wanted
        wanted["horizon"][0] = self.scheduler.horizon()
        wanted["factor"][0] = self.scheduler.sustainable_factor()

    def _wait_until_sent(self) -> None:
        """Wait until all messages of the delivered frames have been sent."""
        while self.node is not None and self.node.has_pending:
            time.sleep(SEND_POLL)

    def _wait_for_snapshot(self) -> bool:
        """Wait for a snapshot. Returns whether there is a snapshot to read: a new one, or a skipped one whose list of
        bodies has arrived since."""
        return self.channel.snapshot.wait(POLL_PERIOD) or self._visuals.version == self._missing_version

    def _take(self, kind: str, value: Any) -> None:
        """Take the list of bodies, write the kept picture, or note that the client waits for the counts."""
        if kind == "visuals":
            assert isinstance(value, VisualListMessage)
            self._visuals.take(value)
        elif kind == "save":
            self._save_kept_frame(value)
        elif kind == "count":
            self._must_count = True

    def _read(self) -> tuple[Snapshot, list[tuple[float, Mapping[str, np.ndarray]]]] | None:
        """Returns the newest snapshot, and the sensor poses since the snapshot before with their times [s]. The last
        poses belong to the time of the snapshot.

        Returns None if the snapshot was read before. This happens if a snapshot is written between the signal for the
        snapshot before and the reading. Returns None also if the list of bodies has not arrived, which is counted.
        """
        with self.channel.snapshot.reading() as shared:
            if shared["number"][0] == self._last_number:
                return None
            memory = self._visuals.memory
            version = int(shared["visuals_version"][0])
            if memory is None or version != self._visuals.version:
                self.frames_skipped += 1
                self._missing_version = version
                return None
            self._missing_version = None
            visual_q = memory["visual_q"][: int(shared["visual_count"][0])].copy()
            has_moved = shared["tree_number"] > self._last_number
            bodies = np.flatnonzero(has_moved[self.config.model.body_tree])
            self._state.body_q[bodies] = shared["body_q"][bodies]
            self._last_number = int(shared["number"][0])
            wires = int(shared["wire_count"][0])
            wire_poses = SegmentPoses(shared["wire_segment"][:wires].copy(), shared["wire_q"][:wires].copy())
            wind = None
            if self.config.wind is not None and shared["wind_strength"][0] > 0.0:
                wind = WindState(
                    self.config.wind,
                    float(shared["wind_time"][0]),
                    float(shared["wind_strength"][0]),
                    shared["tree_air"].copy(),
                    shared["tree_drawn"].copy(),
                )
            self._state.bunch_attached[:] = shared["bunch_attached"]
            if not np.array_equal(shared["leaf_off"], self._state.leaf_off):
                self._state.leaf_off = shared["leaf_off"].copy()
            self._stumps = shared["stumps"][: int(shared["stump_count"][0])].copy()
            self._frame_score = float(shared["frame_score"][0])
            self._time = time = float(shared["time"][0])
            tick = int(shared["tick"][0])
            count = int(shared["pose_count"][0])
            rows = np.arange(max(self._pose_count, count - POSE_HISTORY), count) % POSE_HISTORY
            times = shared["pose_time"][rows]
            poses = shared["pose"][rows]
            offsets = shared["pose_world_offset"][rows]
            self._pose_count = count
        for t, offset in zip(times, offsets, strict=True):
            self._offsets.add(float(t), float(offset))
        state = self._state
        names = tuple(self.config.sensor_frames)
        snapshot = Snapshot(
            time,
            tick,
            state.body_q,
            state.bunch_attached,
            self._visuals.visuals,
            visual_q,
            np.flatnonzero(has_moved),
            wind,
            wire_poses,
            self._stumps,
            state.leaf_off,
        )
        return snapshot, [(float(t), dict(zip(names, q, strict=True))) for t, q in zip(times, poses, strict=True)]

    def _statistics(self) -> dict[str, dict[str, int]]:
        statistics = {
            "frames": dict(self.scheduler.frames),
            "frames_dropped": dict(self.scheduler.dropped),
            "frames_skipped": {"snapshots": self.frames_skipped},
        }
        if self.node is not None:
            statistics |= {"sent": self.node.sent, "ros_dropped": self.node.dropped}
        return statistics

    def _send_statistics(self) -> None:
        """Send the counts and, in lockstep, the digests of the frames of each sensor."""
        if self._is_lockstep:
            self.pipe.send(("digests", {name: digest.hexdigest() for name, digest in self._digests.items()}))
        super()._send_statistics()

    def _deliver(self, frame: Any) -> None:
        """Publish a frame (any :class:`SensorFrame`), in lockstep add it to the digest, and keep it if it is the best
        picture."""
        if self._is_lockstep:
            self._digest(frame)
        if self.node is not None:
            self.node.publish(dataclasses.replace(frame, time=self._offsets.world_time(frame.time)))
        keeper = self._keeper if frame.name == self._kept_camera else None
        if keeper is not None and keeper.wants(frame.time, self._frame_score):
            assert isinstance(frame, CameraFrame)
            keeper.keep(frame, self._frame_score)

    def _digest(self, frame: SensorFrame) -> None:
        digest = self._digests[frame.name]
        digest.update(np.float64(frame.time).tobytes())
        for array in frame.measured:
            digest.update(np.ascontiguousarray(array).tobytes())

    def _save_kept_frame(self, folder: pathlib.Path) -> None:
        failure = ""
        if self._keeper is not None and self._keeper.frame is not None:
            from vinesim.sensors.export import images

            try:
                images.save_frame(self._keeper.frame, folder, "")
            except OSError as bad:
                failure = bad.strerror or str(bad)
        self._send_statistics()
        self.pipe.send(("saved", failure))
