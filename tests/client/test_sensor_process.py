"""The sensor process of a robot: its pictures continue when actors join and when processes fail."""

from __future__ import annotations

import dataclasses
import itertools
import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pytest
import warp as wp

from tests.support.contact_scenes import cane
from tests.support.waiting import wait
from vinesim.client.client import Client
from vinesim.client.processes import worker_process
from vinesim.client.processes.sensor_process import SensorProcess
from vinesim.client.processes.sensor_worker import RENEWAL_PERIOD, PictureKeeper
from vinesim.client.processes.worker_process import WorkerError
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.core import frames
from vinesim.core.errors import WriteError
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.human_posture import standing_pose
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.scene.builder import assemble
from vinesim.scene.spec import load_scene
from vinesim.scene.values import CameraFrame, HumanSpec, MultispectralMount, SensorMode, SensorPacing
from vinesim.sensors.camera.camera import CameraSpec

CAMERA = "head_front_camera"


class Robot:
    """A client with one vinebot far from a single cane, and its sensor process."""

    def __init__(self, device: str = "cpu", *, standby: bool = False, pacing: SensorPacing | None = None) -> None:
        scene = load_scene("demo")
        vinebot = load_description("vinebot")
        model = assemble([cane((50.0, 5.0, 1.0), radius=0.005)])
        self.hub = MemoryHub()
        self.sensors = SensorProcess(
            "robot",
            scene,
            model,
            vinebot,
            ros=False,
            keep_pictures=True,
            device=device,
            standby=standby,
            pacing=pacing,
        )
        self.client = Client(scene, model, vinebot, self.hub.bus("robot"), name="robot", pose=spawn_pose(scene, 0))

    def frames(self) -> int:
        """Pictures so far."""
        return self.sensors.report()["frames"].get(CAMERA, 0)

    def run_until(self, condition: Callable[[], object], description: str) -> None:
        """Step about as fast as in real time until ``condition`` holds."""
        wait(lambda: (self.client.tick(), time.sleep(0.003), condition())[-1], description)

    def run_for_pictures(self, count: int) -> None:
        """Step until so many pictures more have been rendered."""
        seen = self.frames()
        self.run_until(lambda: self.frames() >= seen + count, f"{count} pictures")

    def add_human(self, name: str) -> None:
        pose = frames.pose(np.array([1.0, 1.0, 0.0]))
        self.client.add_human(HumanSpec(name, 7, standing_pose(pose, 1.75), 1.75), None, self.hub.bus(name))

    def stop_sensors_before_a_picture(self) -> bool:
        """Stop the process. If it promises no picture at this moment, let it continue. Returns whether it is stopped.

        Right after a picture, the process waits for no further one until the next snapshot has a better score.
        """
        run = self.sensors.worker.current()
        os.kill(run.process.pid, signal.SIGSTOP)
        if np.isfinite(run.shared.wanted["horizon"][0]):
            return True
        os.kill(run.process.pid, signal.SIGCONT)
        return False

    def kill_sensors(self) -> None:
        os.kill(self.sensors.worker.current().process.pid, signal.SIGKILL)


@pytest.fixture
def robot() -> Iterator[Robot]:
    one = Robot()
    with one.sensors:
        one.sensors.attach(one.client)
        yield one


@pytest.fixture
def robot_with_standby() -> Iterator[Robot]:
    one = Robot(standby=True)
    with one.sensors:
        one.sensors.attach(one.client)
        yield one


def test_a_multispectral_camera_is_rendered_beside_the_others():
    """As any kind of sensor that a robot's TOML file names."""
    scene = load_scene("demo")
    vinebot = load_description("vinebot")
    mount = MultispectralMount("bands", vinebot.sensors[0].frame, "rededge_mx", rate=10.0, size=(64, 48))
    vinebot = dataclasses.replace(vinebot, sensors=(*vinebot.sensors, mount))
    model = assemble([cane((50.0, 5.0, 1.0), radius=0.005)])
    pacing = SensorPacing(SensorMode.LOCKSTEP)
    with SensorProcess("robot", scene, model, vinebot, ros=False, pacing=pacing) as sensors:
        bus = MemoryHub().bus("robot")
        client = Client(scene, model, vinebot, bus, name="robot", pose=spawn_pose(scene, 0))
        sensors.attach(client)
        done = lambda: sensors.report()["frames"].get("bands", 0) >= 2  # noqa: E731
        wait(lambda: (client.tick(), time.sleep(0.003), done())[-1], "two pictures")
        assert sensors.report()["frames"].keys() == {CAMERA, "lidar", "bands"}


@pytest.mark.skipif(wp.get_cuda_device_count() > 0, reason="needs a GPU that is gone")
def test_sensors_whose_gpu_is_gone_compute_on_the_cpu_and_the_report_says_so():
    """What the restarted process of a robot meets whose GPU was lost in mid-run."""
    lost = Robot(device="cuda:0")
    with lost.sensors:
        lost.sensors.attach(lost.client)
        lost.run_for_pictures(1)
        assert lost.sensors.report()["sensor_device"] == "cpu"


@pytest.mark.long
def test_a_body_that_joins_while_a_list_is_on_its_way_does_not_end_the_pictures(robot):
    """The list of bodies changes after a snapshot with the old list has left and before the process has read it."""
    robot.run_for_pictures(1)
    process = robot.sensors.worker.current().process
    os.kill(process.pid, signal.SIGSTOP)
    for name in ("anna", "bert", "carl"):
        robot.client.tick()
        robot.client.tick()  # a snapshot with the former list has left
        robot.add_human(name)
    os.kill(process.pid, signal.SIGCONT)
    robot.run_for_pictures(3)
    assert robot.sensors.report()["sensor_restarts"] == 0


def test_a_snapshot_that_is_announced_twice_is_read_once(robot):
    """A snapshot may be written between the signal for the one before and its reading, and has its own signal then."""
    robot.run_for_pictures(1)
    signals = robot.sensors.worker.current().shared.snapshot._written
    for _ in range(3):
        signals.release()
        wait(lambda: signals.get_value() == 0, "the process to take the signal")
    robot.run_for_pictures(2)
    assert robot.sensors.report()["sensor_restarts"] == 0


def test_a_killed_process_is_started_again(robot, caplog):
    caplog.set_level(logging.WARNING)
    robot.run_for_pictures(1)
    assert robot.sensors.awaited() == []
    robot.kill_sensors()
    robot.run_until(lambda: robot.sensors.report()["sensor_restarts"] == 1, "a restart")
    robot.run_until(lambda: not robot.sensors.awaited(), "sensors that are ready again")
    robot.run_for_pictures(3)
    assert [r.message for r in caplog.records] == [
        "the sensor process of robot failed: it ended with exit code -9; starting it again"
    ]


def test_the_process_that_stands_by_takes_the_place_of_a_killed_one(robot_with_standby, monkeypatch):
    """It has imported all before, and has the niceness of the client until it is ready, so that it is back soon."""
    robot = robot_with_standby
    monkeypatch.setattr(worker_process, "STANDBY_DELAY", 0.0)
    worker = robot.sensors.worker
    robot.run_for_pictures(1)
    wait(lambda: worker.standby_pid, "a process that stands by")
    other = worker.standby_pid
    assert other is not None
    assert other != worker.pid
    assert os.getpriority(os.PRIO_PROCESS, other) == os.getpriority(os.PRIO_PROCESS, 0)
    robot.kill_sensors()
    robot.run_until(lambda: worker.pid == other, "a restart")
    robot.run_for_pictures(2)


@pytest.mark.long
def test_pictures_go_on_when_the_process_that_stands_by_is_killed(robot_with_standby, monkeypatch):
    robot = robot_with_standby
    monkeypatch.setattr(worker_process, "STANDBY_DELAY", 0.0)
    monkeypatch.setattr(worker_process, "LONGEST_PAUSE", 0.0)
    worker = robot.sensors.worker
    wait(lambda: worker.standby_pid, "a process that stands by")
    former = worker.standby_pid
    assert former is not None
    os.kill(former, signal.SIGKILL)
    wait(lambda: worker.standby_pid not in (former, None), "another one")
    assert worker.standby_pid is not None
    os.kill(worker.standby_pid, signal.SIGKILL)
    robot.kill_sensors()
    # two restarts if the end of the process that stood by is seen only when it should take over
    robot.run_until(lambda: robot.sensors.report()["sensor_restarts"] >= 1, "a restart")
    robot.run_for_pictures(1)


@pytest.mark.long
def test_pictures_go_on_after_a_process_that_hangs(robot, monkeypatch):
    robot.run_for_pictures(1)
    monkeypatch.setattr(worker_process, "HANG_TIMEOUT", 3)
    os.kill(robot.sensors.worker.current().process.pid, signal.SIGSTOP)
    robot.run_until(lambda: robot.sensors.report()["sensor_restarts"] >= 1, "a restart")
    robot.run_for_pictures(3)


def test_a_picture_that_finds_no_room_is_one_line_and_the_process_goes_on(robot, tmp_path):
    robot.run_for_pictures(1)
    (tmp_path / "file").write_text("")
    with pytest.raises(WriteError, match="file/out cannot be written: Not a directory; make room there"):
        robot.sensors.save_picture(tmp_path / "file" / "out")
    robot.sensors.save_picture(tmp_path / "out")
    assert (tmp_path / "out" / "rgb.png").exists()
    assert robot.sensors.report()["sensor_restarts"] == 0


@pytest.mark.long
def test_repeated_failures_are_logged_twice_and_counted(robot, caplog, monkeypatch):
    monkeypatch.setattr(worker_process, "LONGEST_PAUSE", 0.0)
    caplog.set_level(logging.WARNING)
    for count in range(1, 4):
        robot.run_until(lambda: not robot.sensors.awaited(), "sensors that are ready")
        robot.kill_sensors()
        robot.run_until(lambda count=count: robot.sensors.report()["sensor_restarts"] == count, "a restart")
    assert [record.levelname for record in caplog.records] == ["WARNING", "ERROR"]


def test_a_fault_in_the_process_does_not_end_the_loop(robot, caplog):
    robot.run_for_pictures(1)
    robot.sensors.worker.send("save", 3)  # not a folder
    robot.run_until(lambda: robot.sensors.report()["sensor_restarts"] == 1, "a restart")
    robot.run_for_pictures(1)
    assert "TypeError" in caplog.text


def unmeasurable_vinebot() -> RobotDescription:
    """A vinebot whose sensor process cannot start: it carries a camera of a model that does not exist."""
    vinebot = load_description("vinebot")
    mount = MultispectralMount("bands", vinebot.sensors[0].frame, "pencil")
    return dataclasses.replace(vinebot, sensors=(*vinebot.sensors, mount))


def test_a_process_that_cannot_start_is_an_error_in_one_line(tmp_path):
    scene = load_scene("demo")
    vinebot = unmeasurable_vinebot()
    model = assemble([cane((50.0, 5.0, 1.0), radius=0.005)])
    client = Client(scene, model, vinebot, MemoryHub().bus("robot"), name="robot", pose=spawn_pose(scene, 0))
    with SensorProcess("robot", scene, model, vinebot, ros=False) as sensors:
        with pytest.raises(WorkerError, match=r"the sensor process of robot failed: .*pencil") as caught:
            sensors.attach(client)
        assert "\n" not in str(caught.value)


def test_without_waiting_the_client_steps_and_the_sensors_join_it():
    one = Robot()
    with one.sensors:
        one.sensors.attach(one.client, wait=False)
        one.client.tick()
        assert one.sensors.awaited()
        one.run_for_pictures(1)
        assert one.sensors.awaited() == []


def test_without_waiting_the_error_of_a_process_that_cannot_start_ends_the_steps():
    scene = load_scene("demo")
    vinebot = unmeasurable_vinebot()
    model = assemble([cane((50.0, 5.0, 1.0), radius=0.005)])
    client = Client(scene, model, vinebot, MemoryHub().bus("robot"), name="robot", pose=spawn_pose(scene, 0))
    with SensorProcess("robot", scene, model, vinebot, ros=False) as sensors:
        sensors.attach(client, wait=False)
        with pytest.raises(WorkerError, match=r"the sensor process of robot failed: .*pencil"):
            wait(lambda: client.tick(), "the failure")


def test_the_kept_picture_is_written(robot, tmp_path):
    robot.run_for_pictures(1)
    robot.sensors.save_picture(tmp_path)
    assert cv2.imread(str(tmp_path / "rgb.png")).std() > 10.0


@pytest.mark.long
def test_without_subscribers_a_picture_is_rendered_only_where_it_would_be_kept(robot, tmp_path):
    """While the score rises by the camera's rate; afterwards none, and the one with the highest score is written."""
    physics = robot.client.physics
    counter = itertools.count(1)
    robot.client.frame_score = lambda: float(next(counter))
    robot.run_for_pictures(5)
    robot.client.frame_score = lambda: 0.5
    shown = robot.frames()
    for _ in range(2):
        until = physics.tick + 4 * round(RENEWAL_PERIOD / physics.dt)
        robot.run_until(lambda until=until: physics.tick >= until, "four times the period in which others are renewed")
    assert robot.frames() <= shown + 2  # those on their way when the score fell
    robot.sensors.save_picture(tmp_path)
    assert cv2.imread(str(tmp_path / "rgb.png")).std() > 10.0


def test_of_pictures_that_show_as_much_the_newest_is_kept():
    keeper = PictureKeeper()
    assert keeper.wants(0.0, 0.0)
    keeper.keep(frame := blank_frame(0.0), 0.0)
    assert [keeper.wants(time, 0.0) for time in (0.5, RENEWAL_PERIOD)] == [False, True]
    assert keeper.wants(0.1, 0.1)
    assert not keeper.wants(9.0, -0.1)
    assert keeper.frame is frame


def blank_frame(time: float) -> CameraFrame:
    info = CameraSpec.load("d435").info("optical")
    nothing = np.zeros((0, 0))
    return CameraFrame(time, CAMERA, info, frames.pose(np.zeros(3)), nothing, nothing, nothing)


def test_a_list_of_bodies_that_comes_after_its_snapshot_does_not_stop_the_start(monkeypatch: pytest.MonkeyPatch):
    """The first snapshot is then skipped; a client that wrote no other would wait for ever."""
    send = worker_process.Run.send
    delayed = []

    def send_late(run: worker_process.Run, kind: str, value: object = None) -> None:
        if kind == "visuals" and not delayed:
            delayed.append(threading.Timer(8.0, send, (run, kind, value)))
            delayed[0].start()
        else:
            send(run, kind, value)

    monkeypatch.setattr(worker_process.Run, "send", send_late)
    one = Robot()
    with one.sensors:
        one.sensors.attach(one.client)
        one.run_for_pictures(1)
        assert one.sensors.report()["frames_skipped"] > 0


def test_a_sensor_process_that_is_stopped_holds_time_for_three_seconds_and_then_no_longer(robot, caplog):
    """While it lives, time waits for it: no picture is more than a fifth of a second after the one before."""
    robot.client.frame_score = lambda: robot.client.physics.time  # each picture is better than the last: it is wanted
    robot.run_for_pictures(3)
    pid = robot.sensors.worker.current().process.pid
    robot.run_until(robot.stop_sensors_before_a_picture, "a stop of the process before a picture that it has promised")
    try:
        robot.run_until(robot.sensors.held, "the hold")
        begin = time.monotonic()
        before = robot.client.physics.time
        wait(lambda: not robot.sensors.held(), "the end of the hold")
        assert time.monotonic() - begin > 0.9 * worker_process.HOLD_TIMEOUT
        assert robot.client.physics.time == before
        robot.run_until(lambda: robot.client.physics.time > before + 1.0, "time that goes on")
        assert [m for m in caplog.messages if "done nothing" in m] == [
            "the sensor process of robot has done nothing for 3 s: until it goes on, simulated time goes on without "
            "its pictures"
        ]
    finally:
        os.kill(pid, signal.SIGCONT)
    robot.run_for_pictures(2)


def test_a_sensor_process_that_is_not_ready_holds_nothing(robot):
    robot.kill_sensors()
    wait(lambda: not robot.sensors.worker.is_ready, "the end of the process")
    assert robot.sensors.held() == ""


def test_in_lockstep_a_killed_process_is_started_again_and_the_steps_go_on():
    """No step runs until the new process has rendered, and it renders only when it has a snapshot."""
    one = Robot(pacing=SensorPacing(SensorMode.LOCKSTEP))
    with one.sensors:
        one.sensors.attach(one.client)

        def step() -> None:
            if one.client.held():
                time.sleep(0.001)
            else:
                one.client.tick()

        seen = one.client.physics.time
        wait(lambda: (step(), one.client.physics.time > seen)[-1], "a step")
        one.kill_sensors()
        wait(lambda: (step(), one.sensors.report()["sensor_restarts"] == 1)[-1], "a restart")
        seen = one.client.physics.time
        wait(lambda: (step(), one.client.physics.time > seen + 0.5)[-1], "steps after the restart")
