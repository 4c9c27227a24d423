"""The sensing thread: the latest snapshot wins, sensors without demand cost nothing, failures surface."""

import dataclasses
import threading

import numpy as np
import pytest

from tests.support import sensor_scenes
from vinesim.scene.ids import Organ, label
from vinesim.scene.values import CameraOutput
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.lidar.lidar import Lidar, LidarSpec
from vinesim.sensors.scene.primitives import rest_snapshot
from vinesim.sensors.scheduler import ScheduledSensor, SensorScheduler

TINY = sensor_scenes.IDEAL.info("optical", 0.1)


class Inbox:
    """Collects frames; ``wait`` until some number has come."""

    def __init__(self) -> None:
        self.frames = []
        self._news = threading.Condition()

    def __call__(self, frame) -> None:
        with self._news:
            self.frames.append(frame)
            self._news.notify_all()

    def wait(self, count: int) -> None:
        with self._news:
            assert self._news.wait_for(lambda: len(self.frames) >= count, 20.0), (
                f"{len(self.frames)} of {count} frames came"
            )


@pytest.fixture
def view():
    return rest_snapshot(sensor_scenes.empty())


def _camera(name: str = "head") -> Camera:
    return Camera(sensor_scenes.IDEAL, TINY, name)


def test_frames_come_at_the_sensors_rate_of_simulation_time(view) -> None:
    inbox = Inbox()
    with SensorScheduler(sensor_scenes.empty(), [ScheduledSensor(_camera(), inbox, rate=10.0)]) as eyes:
        for i, time in enumerate((0.0, 0.1, 0.2, 0.3)):
            for inside in (0.0, 0.03, 0.06):  # only the first of each tenth is due
                eyes.submit(dataclasses.replace(view, time=time + inside), {"head": sensor_scenes.AHEAD})
                if inside == 0.0:
                    inbox.wait(i + 1)
        eyes.submit(dataclasses.replace(view, time=0.4), {"head": sensor_scenes.AHEAD})
        inbox.wait(5)
    assert [round(f.time, 3) for f in inbox.frames] == [0.0, 0.1, 0.2, 0.3, 0.4]
    assert eyes.frames == {"head": 5}
    assert eyes.dropped == {"head": 0}


def test_the_newest_view_wins_and_the_rest_is_counted(view) -> None:
    gate, inbox = threading.Event(), Inbox()

    def slow(frame) -> None:
        inbox(frame)
        assert gate.wait(20.0)

    with SensorScheduler(sensor_scenes.empty(), [ScheduledSensor(_camera(), slow, rate=10.0)]) as eyes:
        eyes.submit(dataclasses.replace(view, time=0.0), {"head": sensor_scenes.AHEAD})
        inbox.wait(1)
        for k in range(1, 8):
            eyes.submit(dataclasses.replace(view, time=0.1 * k), {"head": sensor_scenes.AHEAD})
        gate.set()
        inbox.wait(2)
    assert [round(f.time, 3) for f in inbox.frames] == [0.0, 0.7]
    assert eyes.dropped == {"head": 6}


def test_nothing_is_rendered_without_demand(view) -> None:
    wanted, unwanted, taken, listening = Inbox(), Inbox(), Inbox(), threading.Event()
    lidar = Lidar(LidarSpec.load("vlp16"), "lidar")
    mounts = [
        ScheduledSensor(
            _camera(), unwanted, wanted=lambda: CameraOutput.ALL if listening.is_set() else CameraOutput.NONE, rate=10.0
        ),
        ScheduledSensor(lidar, wanted, rate=10.0),
    ]
    mounts.append(
        ScheduledSensor(_camera("other"), taken, rate=10.0)
    )  # the last: when it has a picture, the view was taken
    poses = {"head": sensor_scenes.AHEAD, "other": sensor_scenes.AHEAD, "lidar": np.array([0, 0, 1.0, 0, 0, 0, 1])}
    with SensorScheduler(sensor_scenes.empty(), mounts) as eyes:
        for k in range(4):  # a revolution is over a tenth of a second after it was begun
            eyes.submit(dataclasses.replace(view, time=0.1 * k), poses)
            taken.wait(k + 1)
        assert unwanted.frames == []
        listening.set()
        eyes.submit(dataclasses.replace(view, time=0.4), poses)
        taken.wait(5)
    assert eyes.frames == {"head": 1, "lidar": 4, "other": 5}
    assert eyes.dropped == {"head": 0, "lidar": 0, "other": 0}
    assert [len(inbox.frames) for inbox in (unwanted, wanted)] == [1, 4]


def test_a_late_thread_fires_from_where_the_lidar_was() -> None:
    """Snapshots that were skipped still give their poses: no shot is fired from a wrong place."""
    gate, inbox, started = threading.Event(), Inbox(), Inbox()
    wall = sensor_scenes.thing(sensor_scenes.shape("box", 0.1, 30.0, 30.0, at=(6.1, 0.0, 1.0)))
    rest = np.array([[0, 0, 0, 0, 0, 0, 1.0]])
    view = rest_snapshot(sensor_scenes.empty(), (wall,), rest)

    def slow(frame) -> None:
        started(frame)
        assert gate.wait(20.0)

    lidar = Lidar(LidarSpec.load("vlp16").ideal(), "lidar")
    mounts = [ScheduledSensor(_camera(), slow, rate=1.0), ScheduledSensor(lidar, inbox)]
    with SensorScheduler(sensor_scenes.empty(), mounts) as eyes:
        for k in range(11):  # the thread is kept by the first picture and sees the first and the last view
            pose = np.array([0.02 * k, 0, 1.0, 0, 0, 0, 1])
            eyes.submit(dataclasses.replace(view, time=0.01 * k), {"head": sensor_scenes.AHEAD, "lidar": pose})
            started.wait(1)
        gate.set()
        inbox.wait(1)
    scan = inbox.frames[0]
    mine = scan.labels == label(Organ.ROBOT, 0)
    assert mine.sum() > 1000
    assert scan.xyz[mine, 0] + 2.0 * (scan.time + scan.offset[mine]) == pytest.approx(6.0, abs=2e-3)


def test_trees_that_moved_in_skipped_views_are_taken_over() -> None:
    model = sensor_scenes.demo()
    view, inbox, bunch = rest_snapshot(model), Inbox(), 10
    tree = int(model.body_tree[model.bunch_body[bunch]])
    with SensorScheduler(model, [ScheduledSensor(_camera(), inbox, rate=1.0)]) as eyes:
        eyes.submit(view, {"head": sensor_scenes.AHEAD})
        inbox.wait(1)
        body_q = view.body_q.copy()
        body_q[model.bodies_of(tree), 2] += 0.3
        # moves and sleeps again between two frames
        eyes.submit(
            dataclasses.replace(view, time=0.4, body_q=body_q, moved_trees=np.array([tree])),
            {"head": sensor_scenes.AHEAD},
        )
        eyes.submit(dataclasses.replace(view, time=1.0, body_q=body_q), {"head": sensor_scenes.AHEAD})
        inbox.wait(2)
        berries = eyes.primitives.label == label(Organ.BUNCH, bunch)
        height = eyes.primitives.shapes.a.numpy()[berries, 2].mean()
    rest = rest_snapshot(model).body_q[model.bunch_body[bunch], 2]
    assert height > rest + 0.1


def test_a_failure_surfaces(view, caplog) -> None:
    def broken(frame) -> None:
        raise OSError("the disk is full")

    eyes = SensorScheduler(sensor_scenes.empty(), [ScheduledSensor(_camera(), broken)]).start()
    thread = eyes._thread
    eyes.submit(view, {"head": sensor_scenes.AHEAD})
    thread.join(20.0)
    with pytest.raises(RuntimeError, match="the disk is full"):
        eyes.submit(view, {"head": sensor_scenes.AHEAD})
    eyes.stop()  # raised once
    assert "the sensing thread stops" in caplog.text


def test_time_set_back_starts_anew(view) -> None:
    inbox = Inbox()
    with SensorScheduler(sensor_scenes.empty(), [ScheduledSensor(_camera(), inbox, rate=10.0)]) as eyes:
        for k, time in enumerate((100.0, 0.0)):
            eyes.submit(dataclasses.replace(view, time=time), {"head": sensor_scenes.AHEAD})
            inbox.wait(k + 1)
    assert [f.time for f in inbox.frames] == [100.0, 0.0]


def test_names_are_unique() -> None:
    with pytest.raises(ValueError, match="two sensors are named 'head'"):
        SensorScheduler(sensor_scenes.empty(), [ScheduledSensor(_camera(), print), ScheduledSensor(_camera(), print)])


def test_eyes_open_once_and_close_twice() -> None:
    eyes = SensorScheduler(sensor_scenes.empty(), []).start()
    with pytest.raises(RuntimeError, match="runs already"):
        eyes.start()
    eyes.stop()
    eyes.stop()


def test_depth_is_measured_only_for_those_who_look_at_it(view) -> None:
    inbox, wanted = Inbox(), [CameraOutput.RGB | CameraOutput.EXACT_DEPTH]
    spec = CameraSpec.load("d435")
    camera = Camera(spec, spec.info("optical", 0.1), "head")
    with SensorScheduler(
        sensor_scenes.empty(), [ScheduledSensor(camera, inbox, wanted=lambda: wanted[-1], rate=10.0)]
    ) as eyes:
        for k in range(2):
            eyes.submit(dataclasses.replace(view, time=0.1 * k), {"head": sensor_scenes.AHEAD})
            inbox.wait(k + 1)
            wanted.append(CameraOutput.ALL)
    without, complete = inbox.frames
    assert without.depth.size == without.labels.size == 0
    assert without.rgb.shape[:2] == without.exact_depth.shape == complete.depth.shape == complete.labels.shape
    near = np.isfinite(complete.exact_depth) & (complete.exact_depth < 5.0)
    assert not np.array_equal(complete.depth[near], complete.exact_depth[near])
