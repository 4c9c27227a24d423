"""The schedule of sensors: frames at their rates, none without demand, and every one that is late counted."""

import dataclasses

import numpy as np
import pytest

from tests.support import sensor_scenes
from vinesim.client.processes.sensor_process import time_of_snapshot
from vinesim.scene.ids import Organ, label
from vinesim.scene.values import CameraOutput, SensorMode, SensorPacing
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.lidar.lidar import Lidar, LidarSpec
from vinesim.sensors.primitives.scene_primitives import rest_snapshot
from vinesim.sensors.scheduler import ScheduledSensor, SensorScheduler

TINY = sensor_scenes.IDEAL.info("optical", 0.1)


class Inbox(list):
    """Collects frames."""

    def __call__(self, frame) -> None:
        self.append(frame)


@pytest.fixture
def view():
    return rest_snapshot(sensor_scenes.empty())


def _camera(name: str = "head") -> Camera:
    return Camera(sensor_scenes.IDEAL, TINY, name)


def test_frames_come_at_the_sensors_rate_of_simulation_time(view) -> None:
    inbox = Inbox()
    scheduler = SensorScheduler(sensor_scenes.empty(), [ScheduledSensor(_camera(), inbox, rate=10.0)])
    for time in (0.0, 0.1, 0.2, 0.3):
        for inside in (0.0, 0.03, 0.06):  # only the first of each tenth is due
            scheduler.advance(dataclasses.replace(view, time=time + inside), {"head": sensor_scenes.AHEAD})
    scheduler.advance(dataclasses.replace(view, time=0.4), {"head": sensor_scenes.AHEAD})
    assert [round(f.time, 3) for f in inbox] == [0.0, 0.1, 0.2, 0.3, 0.4]
    assert scheduler.frames == {"head": 5}
    assert scheduler.dropped == {"head": 0}


def test_a_rate_that_changes_holds_from_the_next_frame_on(view) -> None:
    inbox = Inbox()
    rates = [10.0]
    sensor = ScheduledSensor(_camera(), inbox, present_rate=lambda: rates[-1])
    scheduler = SensorScheduler(sensor_scenes.empty(), [sensor])
    for tick in range(21):
        if tick == 11:
            rates.append(5.0)
        scheduler.advance(dataclasses.replace(view, time=0.05 * tick), {"head": sensor_scenes.AHEAD})
    assert [round(f.time, 3) for f in inbox] == [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0]
    assert scheduler.dropped == {"head": 0}


def test_frames_that_were_due_in_skipped_snapshots_are_counted_but_not_beside_the_first(view) -> None:
    inbox = Inbox()
    scheduler = SensorScheduler(sensor_scenes.empty(), [ScheduledSensor(_camera(), inbox, rate=10.0)])
    for time in (0.0, 3.0, 3.7):  # the first frame took three seconds, the second 0.7
        scheduler.advance(dataclasses.replace(view, time=time), {"head": sensor_scenes.AHEAD})
    assert [f.time for f in inbox] == [0.0, 3.0, 3.7]
    assert scheduler.dropped == {"head": 6}


def test_warming_up_delivers_and_counts_nothing(view) -> None:
    inbox = Inbox()
    lidar = Lidar(LidarSpec.load("vlp16"), "lidar")
    sensors = [ScheduledSensor(_camera(), inbox, rate=10.0), ScheduledSensor(lidar, inbox, rate=10.0)]
    scheduler = SensorScheduler(sensor_scenes.empty(), sensors)
    poses = {"head": sensor_scenes.AHEAD, "lidar": np.array([0, 0, 1.0, 0, 0, 0, 1])}
    assert list(scheduler.warm_up(view, poses)) == ["head", "lidar"]
    assert not inbox
    for k in range(3):
        scheduler.advance(dataclasses.replace(view, time=0.1 * k), poses)
    assert scheduler.frames == {"head": 3, "lidar": 2}
    assert scheduler.dropped == {"head": 0, "lidar": 0}


def test_nothing_is_rendered_without_demand(view) -> None:
    wanted = Inbox()
    unwanted = Inbox()
    is_wanted = []
    lidar = Lidar(LidarSpec.load("vlp16"), "lidar")
    sensors = [
        ScheduledSensor(
            _camera(), unwanted, wanted=lambda: CameraOutput.ALL if is_wanted else CameraOutput.NONE, rate=10.0
        ),
        ScheduledSensor(lidar, wanted, rate=10.0),
    ]
    poses = {"head": sensor_scenes.AHEAD, "lidar": np.array([0, 0, 1.0, 0, 0, 0, 1])}
    scheduler = SensorScheduler(sensor_scenes.empty(), sensors)
    for k in range(4):  # a revolution is over a tenth of a second after it was begun
        scheduler.advance(dataclasses.replace(view, time=0.1 * k), poses)
    assert not unwanted
    is_wanted.append(True)
    scheduler.advance(dataclasses.replace(view, time=0.4), poses)
    assert scheduler.frames == {"head": 1, "lidar": 4}
    assert scheduler.dropped == {"head": 0, "lidar": 0}
    assert [len(inbox) for inbox in (unwanted, wanted)] == [1, 4]


def test_a_late_lidar_fires_from_where_it_was() -> None:
    """Poses between two snapshots that are rendered count: no shot is fired from a wrong place."""
    inbox = Inbox()
    wall = sensor_scenes.thing(sensor_scenes.shape("box", 0.1, 30.0, 30.0, at=(6.1, 0.0, 1.0)))
    rest = np.array([[0, 0, 0, 0, 0, 0, 1.0]])
    view = rest_snapshot(sensor_scenes.empty(), (wall,), rest)
    lidar = Lidar(LidarSpec.load("vlp16").ideal(), "lidar")
    scheduler = SensorScheduler(sensor_scenes.empty(), [ScheduledSensor(lidar, inbox)])
    poses = [{"lidar": np.array([0.02 * k, 0, 1.0, 0, 0, 0, 1])} for k in range(11)]
    scheduler.advance(view, poses[0])
    earlier = [(0.01 * k, poses[k]) for k in range(1, 10)]
    scheduler.advance(dataclasses.replace(view, time=0.1), poses[10], earlier)
    (scan,) = inbox
    mine = scan.labels == label(Organ.ROBOT, 0)
    assert mine.sum() > 1000
    assert scan.xyz[mine, 0] + 2.0 * (scan.time + scan.offset[mine]) == pytest.approx(6.0, abs=2e-3)


def test_trees_that_moved_between_two_frames_are_taken_over() -> None:
    model = sensor_scenes.demo()
    view = rest_snapshot(model)
    inbox = Inbox()
    bunch = 10
    tree = int(model.body_tree[model.bunch_body[bunch]])
    scheduler = SensorScheduler(model, [ScheduledSensor(_camera(), inbox, rate=1.0)])
    scheduler.advance(view, {"head": sensor_scenes.AHEAD})
    body_q = view.body_q.copy()
    body_q[model.bodies_of(tree), 2] += 0.3
    # moves and sleeps again between two frames
    moved = dataclasses.replace(view, time=0.4, body_q=body_q, moved_trees=np.array([tree]))
    scheduler.advance(moved, {"head": sensor_scenes.AHEAD})
    scheduler.advance(dataclasses.replace(view, time=1.0, body_q=body_q), {"head": sensor_scenes.AHEAD})
    assert len(inbox) == 2
    berries = scheduler.primitives.label == label(Organ.BUNCH, bunch)
    height = scheduler.primitives.shapes.a.numpy()[berries, 2].mean()
    rest = rest_snapshot(model).body_q[model.bunch_body[bunch], 2]
    assert height > rest + 0.1


def test_time_set_back_starts_anew(view) -> None:
    inbox = Inbox()
    scheduler = SensorScheduler(sensor_scenes.empty(), [ScheduledSensor(_camera(), inbox, rate=10.0)])
    for time in (100.0, 0.0):
        scheduler.advance(dataclasses.replace(view, time=time), {"head": sensor_scenes.AHEAD})
    assert [f.time for f in inbox] == [100.0, 0.0]


def test_names_are_unique() -> None:
    with pytest.raises(ValueError, match="two sensors are named 'head'"):
        SensorScheduler(sensor_scenes.empty(), [ScheduledSensor(_camera(), print), ScheduledSensor(_camera(), print)])


def test_depth_is_measured_only_for_those_who_look_at_it(view) -> None:
    inbox = Inbox()
    wanted = [CameraOutput.RGB | CameraOutput.EXACT_DEPTH]
    spec = CameraSpec.load("d435")
    camera = Camera(spec, spec.info("optical", 0.1), "head")
    sensor = ScheduledSensor(camera, inbox, wanted=lambda: wanted[-1], rate=10.0)
    scheduler = SensorScheduler(sensor_scenes.empty(), [sensor])
    for k in range(2):
        scheduler.advance(dataclasses.replace(view, time=0.1 * k), {"head": sensor_scenes.AHEAD})
        wanted.append(CameraOutput.ALL)
    without, complete = inbox
    assert without.depth.size == without.labels.size == 0
    assert without.rgb.shape[:2] == without.exact_depth.shape == complete.depth.shape == complete.labels.shape
    near = np.isfinite(complete.exact_depth) & (complete.exact_depth < 5.0)
    assert not np.array_equal(complete.depth[near], complete.exact_depth[near])


def frames_beside_a_slow_renderer(view, sensors, poses, pacing: SensorPacing, cost: float, seconds: float) -> float:
    """A world of 100 steps a second of real time that stops at the scheduler's horizon, and a renderer that takes the
    newest snapshot of every second step whenever it is free, and ``cost`` [s] of real time for a frame.

    Returns how fast simulated time passed.
    """
    horizon = [np.inf]
    step = 0.01
    scheduler = SensorScheduler(
        sensor_scenes.empty(), sensors, pacing=pacing, on_taken=lambda: horizon.append(scheduler.horizon())
    )
    time = 0.0
    tick = 0
    real = 0.0
    free = 0.0
    newest = 0.0
    seen = -1.0
    while time < seconds:
        real += step
        if time + 0.5 * step <= time_of_snapshot(horizon[-1], step):
            tick += 1
            time = tick * step
            newest = time if tick % 2 == 0 else newest
        if real >= free and newest > seen:
            seen = newest
            before = sum(scheduler.frames.values())
            scheduler.advance(dataclasses.replace(view, time=seen), poses)
            free = real + cost * (sum(scheduler.frames.values()) - before)
    assert scheduler.sustainable_factor() < np.inf
    return time / real


POSES = {"head": sensor_scenes.AHEAD, "lidar": np.array([0, 0, 1.0, 0, 0, 0, 1])}


@pytest.mark.parametrize("cost", [0.02, 0.35, 3.0])
def test_live_sensors_never_fall_below_their_least_rate_in_simulated_time(view, cost) -> None:
    """However long a frame takes: time waits, and no longer than it must."""
    pictures = Inbox()
    scans = Inbox()
    lidar = Lidar(LidarSpec.load("vlp16"), "lidar")
    sensors = [ScheduledSensor(_camera(), pictures, rate=30.0), ScheduledSensor(lidar, scans)]
    factor = frames_beside_a_slow_renderer(view, sensors, POSES, SensorPacing(least_rate=5.0), cost, 4.0)
    for inbox in (pictures, scans):
        assert np.diff([frame.time for frame in inbox]).max() <= 0.2 + 1e-6
        assert len(inbox) >= 5 * 3.8
    if cost == 3.0:
        assert len(pictures) <= 6.0 * 4.0, "not many more than were asked for"
        assert factor == pytest.approx(0.18 / (2 * cost), rel=0.3)


def test_a_live_sensor_that_is_slower_by_itself_holds_nothing(view) -> None:
    inbox = Inbox()
    sensors = [ScheduledSensor(_camera(), inbox, rate=1.0)]
    factor = frames_beside_a_slow_renderer(view, sensors, POSES, SensorPacing(), 0.5, 4.0)
    assert factor > 0.95
    assert [round(frame.time, 2) for frame in inbox] == [0.0, 1.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize("cost", [0.02, 0.5])
def test_paced_sensors_deliver_every_frame_at_its_time(view, cost) -> None:
    pictures = Inbox()
    scans = Inbox()
    lidar = Lidar(LidarSpec.load("vlp16"), "lidar")
    sensors = [ScheduledSensor(_camera(), pictures, rate=10.0), ScheduledSensor(lidar, scans)]
    frames_beside_a_slow_renderer(view, sensors, POSES, SensorPacing(SensorMode.PACED), cost, 2.0)
    assert np.diff([frame.time for frame in pictures]) == pytest.approx(0.1, abs=1e-6)
    assert np.diff([scan.time for scan in scans]) == pytest.approx(0.1, abs=1e-6)
    assert len(pictures) >= 19
    assert len(scans) >= 18


def test_sensors_that_nobody_wants_hold_nothing(view) -> None:
    wanted = [CameraOutput.ALL]
    sensors = [ScheduledSensor(_camera(), Inbox(), lambda: wanted[-1], rate=10.0)]
    scheduler = SensorScheduler(sensor_scenes.empty(), sensors)
    assert scheduler.horizon() == np.inf
    scheduler.advance(dataclasses.replace(view, time=1.0), POSES)
    assert scheduler.horizon() == pytest.approx(1.18)
    wanted.append(CameraOutput.NONE)
    assert scheduler.horizon() == np.inf
    assert scheduler.sustainable_factor() == np.inf


def test_a_subscriber_that_returns_holds_nothing_before_the_first_snapshot_that_it_is_rendered_from(view) -> None:
    """While nobody looks, the client writes no snapshot. A promise that dated from the last one would hold its steps at
    once, and the next snapshot would never come."""
    wanted = [CameraOutput.ALL]
    scheduler = SensorScheduler(
        sensor_scenes.empty(), [ScheduledSensor(_camera(), Inbox(), lambda: wanted[-1], rate=10.0)]
    )
    scheduler.advance(dataclasses.replace(view, time=1.0), POSES)
    wanted.append(CameraOutput.NONE)
    assert scheduler.horizon() == np.inf
    wanted.append(CameraOutput.ALL)
    assert scheduler.horizon() == np.inf
    scheduler.advance(dataclasses.replace(view, time=9.0), POSES)
    assert scheduler.horizon() == pytest.approx(9.18)
