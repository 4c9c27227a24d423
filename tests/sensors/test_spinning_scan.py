"""A head that turns while the world moves: shear, the poses of late sectors, what is dropped."""

import dataclasses

import numpy as np
import pytest

from tests.support import sensor_scenes
from vinesim.core import frames
from vinesim.scene.ids import Organ, label
from vinesim.sensors.lidar.lidar import MAX_SHARED_ROTATION, MAX_SHARED_TRANSLATION, Lidar, LidarSpec
from vinesim.sensors.lidar.spinning_scan import PoseHistory, SpinningScan

AT = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
STEP = 0.001
"""Of the world in these tests [s]: finer than a tick, so that motion is the only thing that shears."""


def _lidar(real: bool = False) -> Lidar:
    spec = LidarSpec.load("vlp16")
    return Lidar(spec if real else spec.ideal())


def _turn(lidar: Lidar, things, motion=None, pose=None, step: float = STEP, start: float = 0.0):
    """The first revolution: ``motion(t)`` [link, 7] moves the things, ``pose(t)`` [7] the lidar."""
    primitives, view = sensor_scenes.world(*things)
    rolling = SpinningScan(lidar)
    for k in range(round(0.1 / step) + 2):
        time = start + k * step
        if motion is not None:
            view = dataclasses.replace(view, visual_q=motion(time - start))
            primitives.update(view)
        rolling.pose_history.add(time, AT if pose is None else pose(time - start))
        for scan in rolling.advance(primitives, time):
            return scan
    raise AssertionError("no revolution was completed")


def _plate(index: int = 0):
    """A plate 2 m to the right of the lidar, 2 m wide along x; below it nothing is hit."""
    return sensor_scenes.thing(sensor_scenes.shape("box", 1.0, 0.01, 3.0, at=(0.0, -2.01, 1.0)), index=index)


@pytest.mark.parametrize("speed", [0.0, 5.0, -5.0])
def test_a_plate_that_moves_sideways_is_sheared(speed: float) -> None:
    """Each end is seen where it was when the beam passed it: x = x0 + v t."""
    still = np.array([[0, 0, 0, 0, 0, 0, 1.0]])
    scan = _turn(_lidar(), [_plate()], motion=lambda t: still + np.array([speed * t, 0, 0, 0, 0, 0, 0]))
    mine = scan.labels == label(Organ.ROBOT, 0)
    x = scan.xyz[mine, 0].astype(float)
    offset = scan.offset[mine]
    # clockwise from ahead: the far end comes first
    first = x.argmax()
    last = x.argmin()
    assert offset[first] < 0.02 < 0.03 < offset[last]
    spacing = 2.0 * np.pi * 10.0 * 55.3e-6 * 5.0 + abs(speed) * STEP  # between two shots there, and one step of motion
    assert x[first] == pytest.approx(1.0 + speed * offset[first], abs=spacing)
    assert x[last] == pytest.approx(-1.0 + speed * offset[last], abs=spacing)
    width = 2.0 - speed * (offset[last] - offset[first])
    assert np.ptp(x) == pytest.approx(width, abs=2 * spacing)
    if speed:
        assert abs(np.ptp(x) - 2.0) > 3 * spacing  # the shear is no matter of spacing


def test_points_of_a_lidar_that_drives_are_in_its_frame_of_their_time() -> None:
    """Raw, as drivers give them: the pose at each point's time puts them on the wall, the first pose does not."""
    wall = sensor_scenes.thing(sensor_scenes.shape("box", 0.1, 30.0, 30.0, at=(6.1, 0.0, 1.0)))
    speed = np.array([2.0, 0.5, 0.0])

    def pose(t: float) -> np.ndarray:
        return frames.pose(AT[:3] + speed * t, frames.from_yaw(0.2))

    scan = _turn(_lidar(), [wall], pose=pose, step=0.01)
    mine = scan.labels == label(Organ.ROBOT, 0)
    assert np.ptp(scan.offset[mine]) > 0.09
    xyz = frames.rotate(frames.from_yaw(0.2), scan.xyz[mine].astype(float))
    at_their_time = AT[:3] + np.outer(scan.offset[mine], speed) + xyz
    assert np.abs(at_their_time[:, 0] - 6.0).max() < 0.5 * MAX_SHARED_TRANSLATION + 1e-4
    at_the_first = scan.pose[:3] + xyz
    assert 6.0 - at_the_first[:, 0] == pytest.approx(
        speed[0] * scan.offset[mine], abs=0.5 * MAX_SHARED_TRANSLATION + 1e-4
    )


def test_a_lidar_that_turns_near_a_wall() -> None:
    """Turning with the head at 2 rad/s it sees a straight wall bent; each point's own pose straightens it."""
    wall = sensor_scenes.thing(sensor_scenes.shape("box", 0.1, 30.0, 30.0, at=(3.1, 0.0, 1.0)))
    rate = -2.0
    scan = _turn(_lidar(), [wall], pose=lambda t: frames.pose(AT[:3], frames.from_yaw(rate * t)), step=0.01)
    mine = scan.labels == label(Organ.ROBOT, 0)
    xyz = scan.xyz[mine].astype(float)
    turned = frames.rotate(frames.from_yaw(rate * scan.offset[mine].astype(float)), xyz)
    off = np.abs(turned[:, 0] - 3.0)
    assert (off < 0.5 * MAX_SHARED_ROTATION * np.hypot(*turned[:, :2].T) + 1e-3).all()
    late = scan.offset[mine] > 0.08
    assert np.abs(xyz[late, 0] - 3.0).max() > 0.2


def test_firing_bit_by_bit_is_firing_at_once() -> None:
    """If nothing moves: the same bits, noise included."""
    lidar = _lidar(real=True)
    scan = _turn(lidar, [_plate()], step=0.013)
    at_once = _lidar(real=True).scan(sensor_scenes.world(_plate())[0], AT)
    for name in ("xyz", "intensity", "ring", "offset", "labels"):
        assert np.array_equal(getattr(scan, name), getattr(at_once, name)), name


def test_a_late_sector_has_the_pose_of_its_time() -> None:
    """Nothing is computed for 90 ms; then all is fired at once, from where the lidar was, with the newest things."""
    wall = sensor_scenes.thing(sensor_scenes.shape("box", 0.1, 30.0, 30.0, at=(6.1, 0.0, 1.0)))
    primitives, _ = sensor_scenes.world(wall)
    rolling = SpinningScan(_lidar())
    scans = []
    for k in range(11):
        time = 0.01 * k
        rolling.pose_history.add(time, AT + np.array([2.0 * time, 0, 0, 0, 0, 0, 0]))
        if k in (0, 10):
            scans += rolling.advance(primitives, time)
    (scan,) = scans
    mine = scan.labels == label(Organ.ROBOT, 0)
    assert scan.xyz[mine, 0] + 2.0 * scan.offset[mine] == pytest.approx(6.0, abs=0.5 * MAX_SHARED_TRANSLATION + 1e-4)


def test_revolutions_that_were_missed_are_counted() -> None:
    primitives, _ = sensor_scenes.world(_plate())
    rolling = SpinningScan(_lidar())
    for time in (0.0, 0.05):
        rolling.pose_history.add(time, AT)
        assert list(rolling.advance(primitives, time)) == []
    rolling.pose_history.add(0.45, AT)
    (scan,) = rolling.advance(primitives, 0.45)  # the one that was begun; 0.1 to 0.4 are lost, 0.4 is under way
    assert scan.time == 0.0
    assert rolling.dropped == 3
    rolling.pose_history.add(0.5, AT)
    (scan,) = rolling.advance(primitives, 0.5)
    assert scan.time == pytest.approx(0.4)
    assert rolling.dropped == 3


def test_a_slower_rate_turns_as_fast_and_rests_between() -> None:
    primitives, _ = sensor_scenes.world(_plate())
    rolling = SpinningScan(_lidar(), rate=4.0)
    scans = []
    for k in range(101):
        rolling.pose_history.add(0.01 * k, AT)
        scans += rolling.advance(primitives, 0.01 * k)
    assert [s.time for s in scans] == pytest.approx([0.0, 0.25, 0.5, 0.75])
    assert all(s.offset.max() < 0.1 for s in scans)
    assert rolling.dropped == 0


def test_time_set_back_starts_a_revolution_anew() -> None:
    primitives, _ = sensor_scenes.world(_plate())
    rolling = SpinningScan(_lidar())
    for time in (100.0, 100.05, 0.0, 0.05, 0.1):
        rolling.pose_history.add(time, AT)
        scans = list(rolling.advance(primitives, time))
    assert [s.time for s in scans] == [0.0]


def test_a_track_interpolates_and_forgets() -> None:
    track = PoseHistory()
    quarter = frames.from_yaw(0.2)
    track.add(1.0, AT)
    assert np.array_equal(track.interpolate(np.array([0.0, 5.0])), np.stack([AT, AT]))
    track.add(2.0, frames.pose(np.array([2.0, 0.0, 1.0]), -quarter))  # the same rotation, written the other way round
    middle, before, after = track.interpolate(np.array([1.5, 0.5, 2.5]))
    assert middle[:3] == pytest.approx([1.0, 0.0, 1.0])
    assert frames.to_yaw(middle[3:]) == pytest.approx(0.1, abs=1e-4)
    assert np.array_equal(before, AT)
    assert after[:3] == pytest.approx([2.0, 0.0, 1.0])
    track.add(3.0, AT)
    track.discard_before(2.5)
    assert track.interpolate(np.array([2.0]))[0, 0] == pytest.approx(2.0)
    assert track.interpolate(np.array([0.0]))[0, 0] == pytest.approx(2.0)  # what came before is gone
    track.add(2.5, AT)  # time was set back
    assert track.interpolate(np.array([3.0]))[0, 0] == 0.0
