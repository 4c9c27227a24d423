"""Lidars: exact ranges of ideal ones, the table of firings, intensity; wide beams, echoes, noise of real ones."""

import msgspec
import numpy as np
import pytest

from tests.support import sensor_scenes
from vinesim.core import frames
from vinesim.core.data_files import find_data_file
from vinesim.scene.ids import Organ, label
from vinesim.scene.model import Model
from vinesim.scene.values import LidarMount
from vinesim.sensors.lidar.lidar import MAKER, Lidar, LidarSpec
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.sensor import SensorSetting
from vinesim.sensors.spec_file import SensorError

AT = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def lidar() -> Lidar:
    return Lidar(LidarSpec.load("vlp16").ideal())


def _post(x: float, y: float, radius: float) -> Primitives:
    model = Model.allocate(tree=0, body=0, bunch=0, leaf=0, fixed=1, tie=0, box=0)
    model.fixed_start[0] = (x, y, -1.0)
    model.fixed_end[0] = (x, y, 4.0)
    model.fixed_radius[0] = radius
    return Primitives(model, grass=0.0)


@pytest.mark.parametrize("spot", [(3.0, 0.4), (-8.0, 5.0), (0.9, -0.2)])
def test_range_to_a_post_is_exact(lidar: Lidar, spot: tuple[float, float]) -> None:
    scan = lidar.scan(_post(*spot, 0.05), AT)
    post = scan.labels == label(Organ.POLE, 0)
    assert post.sum() > 16
    xyz = scan.xyz[post].astype(float)
    assert np.abs(np.hypot(xyz[:, 0] - spot[0], xyz[:, 1] - spot[1]) - 0.05).max() < 2e-5
    level = np.linalg.norm(xyz, axis=1) * np.cos(np.arcsin(xyz[:, 2] / np.linalg.norm(xyz, axis=1)))
    assert level.min() == pytest.approx(np.hypot(*spot) - 0.05, abs=2e-4)  # the shot nearest to the middle


def test_points_lie_on_the_ground(lidar: Lidar) -> None:
    pose = np.array([1.0, 2.0, 1.2, *frames.exp(np.array([0.1, 0.2, 0.7]))])
    scan = lidar.scan(sensor_scenes.world()[0], pose)
    assert len(scan.xyz) > 5000
    world = pose[:3] + frames.rotate(pose[3:], scan.xyz.astype(float))
    assert np.abs(world[:, 2]).max() < 1e-4
    assert set(scan.labels) == {label(Organ.GROUND, 0)}


def test_rings_offsets_and_angles_follow_the_table(lidar: Lidar) -> None:
    room = sensor_scenes.thing(
        *(
            sensor_scenes.shape(
                "box",
                0.1,
                9.0,
                9.0,
                at=frames.rotate(frames.from_yaw(a), np.array([5.0, 0, 0])),
                turn=frames.from_yaw(a),
            )
            for a in np.arange(4) * np.pi / 2
        )
    )
    scan = lidar.scan(sensor_scenes.world(room)[0], AT, 7.0)
    shots = len(lidar.offset)
    assert shots == 16 * 1808
    assert (scan.time, len(scan.xyz)) == (7.0, shots)
    distance = np.linalg.norm(scan.xyz.astype(float), axis=1)
    elevation = np.degrees(np.arcsin(scan.xyz[:, 2] / distance))
    assert elevation == pytest.approx(-15.0 + 2.0 * scan.ring, abs=1e-3)
    azimuth = np.unwrap(np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0]).astype(float))
    assert azimuth - azimuth[0] == pytest.approx(-2.0 * np.pi * 10.0 * scan.offset, abs=1e-4)
    level = scan.level
    assert abs(-15.0 + 2.0 * level.ring) == 1.0
    shot = np.arange(level.count)
    at = scan.ring == level.ring
    assert scan.offset[at] == pytest.approx(level.delay + shot * level.period, abs=1e-7)
    turned = azimuth[at] - level.azimuth + 2.0 * np.pi * shot / level.count
    assert np.abs((turned + np.pi) % (2.0 * np.pi) - np.pi).max() < 2e-3
    assert (np.diff(scan.offset) > 0).all()
    assert scan.offset[16] == pytest.approx(55.296e-6, rel=1e-5)
    assert scan.offset[-1] < 0.1


def test_intensity_falls_with_the_angle(lidar: Lidar) -> None:
    wall = sensor_scenes.thing(sensor_scenes.shape("box", 0.1, 30.0, 30.0, at=(3.1, 0.0, 1.0)))
    scan = lidar.scan(sensor_scenes.world(wall)[0], AT)
    wall_hit = scan.labels == label(Organ.ROBOT, 0)
    cosine = scan.xyz[wall_hit, 0] / np.linalg.norm(scan.xyz[wall_hit], axis=1)
    expected = 100.0 * lidar.spec.reflectance["robot"].value * cosine
    assert scan.intensity[wall_hit] == pytest.approx(expected, abs=0.01)


def test_too_near_and_too_far_return_nothing(lidar: Lidar) -> None:
    near = sensor_scenes.thing(sensor_scenes.shape("sphere", 0.1, at=(0.3, 0.0, 1.0)), index=1)
    far = sensor_scenes.thing(sensor_scenes.shape("box", 0.1, 30.0, 30.0, at=(-101.0, 0.0, 1.0)), index=2)
    scan = lidar.scan(sensor_scenes.world(near, far)[0], AT)
    assert not np.isin([label(Organ.ROBOT, 1), label(Organ.ROBOT, 2)], scan.labels).any()
    distance = np.linalg.norm(scan.xyz, axis=1)
    assert distance.min() >= lidar.spec.nearest.value
    assert distance.max() <= lidar.spec.farthest.value


def test_a_scan_of_the_vineyard_follows_motion(lidar: Lidar) -> None:
    post = sensor_scenes.thing(sensor_scenes.shape("cylinder", 0.05, 2.0, at=(2.0, 0.0, 0.0)))
    primitives, view = sensor_scenes.world(post, model=sensor_scenes.demo())
    first = lidar.scan(primitives, AT)
    again = lidar.scan(primitives, AT)
    assert np.array_equal(first.xyz, again.xyz)
    assert {int(v) >> 20 for v in np.unique(first.labels)} >= {
        int(Organ.LEAF),
        int(Organ.BUNCH),
        int(Organ.TRUNK),
        int(Organ.ROBOT),
    }
    import dataclasses

    primitives.update(dataclasses.replace(view, visual_q=view.visual_q + 0.5 * np.eye(7)[1]))
    moved = lidar.scan(primitives, AT)
    mine = moved.xyz[moved.labels == label(Organ.ROBOT, 0)].astype(float)
    assert np.abs(np.hypot(mine[:, 0] - 2.0, mine[:, 1] - 0.5) - 0.05).max() < 2e-5


def test_bad_input_is_named(lidar: Lidar, tmp_path) -> None:
    with pytest.raises(ValueError, match="pose"):
        lidar.scan(sensor_scenes.world()[0], np.full(7, np.inf))
    file = tmp_path / "bad.toml"
    text = find_data_file("lidars", "vlp16", ".toml").read_text(encoding="utf-8")
    file.write_text("\n".join(line for line in text.splitlines() if not line.startswith("bunch")), encoding="utf-8")
    with pytest.raises(SensorError, match=r"reflectance\.bunch"):
        LidarSpec.load(str(file))


# ---- real beams ------------------------------------------------------------------------------------------------------


def _but(name: str = "vlp16", returns: str = "strongest", **values: float) -> LidarSpec:
    """A shipped lidar with other values."""
    spec = LidarSpec.load(name)
    changed = {k: msgspec.structs.replace(getattr(spec, k), value=v) for k, v in values.items()}
    return msgspec.structs.replace(spec, returns=returns, **changed)


def _steady(**others) -> LidarSpec:
    """Wide beams, nothing left to chance."""
    return _but(noise=0.0, weak_noise=0.0, step=0.0, flicker=0.0, weakest=0.0, **others)


def _two_walls(gap: float):
    """A plate 2 m ahead, 0.6 m wide, and a wall that far behind it."""
    plate = sensor_scenes.thing(
        sensor_scenes.shape("box", 0.0005, 0.3, 0.3, at=(2.0005, 0.0, 1.0)), name="plate", index=1
    )
    wall = sensor_scenes.thing(
        sensor_scenes.shape("box", 0.05, 30.0, 30.0, at=(2.05 + gap, 0.0, 1.0)), name="wall", index=2
    )
    return sensor_scenes.world(plate, wall)[0]


def _ahead(scan, reach: float = 0.35) -> np.ndarray:
    """Points that look at the plate or a little past it, level enough to miss its upper and lower edge."""
    tangent = scan.xyz[:, :2] / np.maximum(scan.xyz[:, :1], 1e-6)
    level = np.abs(scan.xyz[:, 2] / np.maximum(scan.xyz[:, 0], 1e-6)) < 0.12
    return level & (scan.xyz[:, 0] > 0.0) & (np.abs(tangent[:, 1]) < reach)


def test_mixed_returns_lie_between_and_only_at_edges() -> None:
    """Nearer together than the pulse is long, two surfaces in one beam come back as one echo between them."""
    scan = Lidar(_steady()).scan(_two_walls(0.3), AT)
    here = _ahead(scan)
    depth = scan.xyz[here, 0]
    side = np.abs(scan.xyz[here, 1] / scan.xyz[here, 0])
    between = (depth > 2.0 + 0.005) & (depth < 2.3 - 0.005)
    assert between.sum() > 10
    spec = LidarSpec.load("vlp16")
    beam = 0.5 * spec.aperture.value[0] / 2.0 + 0.5e-3 * spec.divergence.value[0]
    assert np.abs(side[between] - 0.3 / 2.0).max() < beam
    assert depth[side < 0.15 - beam] == pytest.approx(2.0, abs=2e-3)
    assert depth[side > 0.15 + beam] == pytest.approx(2.3, abs=2e-3)


def test_surfaces_far_apart_do_not_mix() -> None:
    primitives = _two_walls(1.5)
    for returns in ("strongest", "last"):
        scan = Lidar(_steady(returns=returns)).scan(primitives, AT)
        depth = scan.xyz[_ahead(scan), 0]
        assert np.minimum(np.abs(depth - 2.0), np.abs(depth - 3.5)).max() < 0.01
        assert scan.returned is None


def test_last_sees_past_an_edge_further_than_strongest() -> None:
    primitives = _two_walls(1.5)
    seen = [
        (Lidar(_steady(returns=which)).scan(primitives, AT).labels == label(Organ.ROBOT, 1)).sum()
        for which in ("strongest", "last")
    ]
    assert seen[1] < seen[0]


@pytest.mark.parametrize(("gap", "both"), [(0.7, False), (1.5, True)])
def test_dual_return_gives_both_sides_of_an_edge(gap: float, both: bool) -> None:
    """If they lie further apart than the receiver's separation; a shot that met one surface is reported once."""
    primitives = _two_walls(gap)
    scan = Lidar(_steady(returns="dual")).scan(primitives, AT)
    here = _ahead(scan)
    second = here & (scan.returned == 2)
    assert (second.sum() > 10) == both
    single = Lidar(_steady()).scan(primitives, AT)
    first = scan.returned == 1
    assert np.array_equal(scan.xyz[first], single.xyz)
    if both:
        shot = np.flatnonzero(second)
        assert np.array_equal(scan.offset[shot], scan.offset[shot - 1])
        assert np.array_equal(scan.ring[shot], scan.ring[shot - 1])
        pairs = np.sort(np.stack([scan.xyz[shot - 1, 0], scan.xyz[shot, 0]], 1), 1)
        assert np.abs(pairs - [2.0, 2.0 + gap]).max() < 0.01


def test_what_fills_a_part_of_the_beam_is_dimmer() -> None:
    scan = Lidar(_steady()).scan(_two_walls(1.5), AT)
    plate = (scan.labels == label(Organ.ROBOT, 1)) & _ahead(scan)
    side = np.abs(scan.xyz[plate, 1] / scan.xyz[plate, 0])
    whole = np.median(scan.intensity[plate][side < 0.14])
    assert scan.intensity[plate].min() < 0.75 * whole
    assert scan.intensity[plate][side < 0.14].min() > 0.95 * whole


def test_range_noise_and_steps() -> None:
    spec = LidarSpec.load("vlp16")
    wall = sensor_scenes.world(sensor_scenes.thing(sensor_scenes.shape("box", 0.05, 30.0, 30.0, at=(4.05, 0.0, 1.0))))[
        0
    ]
    real = Lidar(_but(rays=1)).scan(wall, AT)
    ideal = Lidar(spec.ideal()).scan(wall, AT)
    head_on = [s.xyz[:, 0] / np.linalg.norm(s.xyz, axis=1) > 0.95 for s in (real, ideal)]
    error = np.linalg.norm(real.xyz[head_on[0]], axis=1) - np.linalg.norm(ideal.xyz[head_on[1]], axis=1)
    assert len(error) > 2000
    assert error.std() == pytest.approx(spec.noise.value, rel=0.06)
    assert abs(error.mean()) < 0.1 * spec.noise.value
    steps = np.linalg.norm(real.xyz.astype(float), axis=1) / spec.step.value
    assert np.abs(steps - np.round(steps)).max() < 0.01


@pytest.mark.parametrize("returns", ["strongest", "dual"])
def test_an_exact_revolution_is_that_of_an_ideal_lidar(returns: str) -> None:
    """From the next one on: the present revolution stays as it began."""
    spec = _but(returns=returns, weakest=8e-5)
    walls = _two_walls(1.5)
    lidar = Lidar(spec)
    other = Lidar(spec)
    ideal = Lidar(spec.ideal()).scan(walls, AT)
    lidar.begin_revolution()
    lidar.is_exact = True
    lidar.fire(walls, 0, np.broadcast_to(AT, (lidar.firings, 7)))
    measured = other.scan(walls, AT)
    assert np.array_equal(lidar.finish_revolution(AT, 0.0).xyz, measured.xyz)
    exact = lidar.scan(walls, AT)
    assert len(exact.xyz) > len(measured.xyz)
    for name in ("ring", "offset", "labels"):
        assert np.array_equal(getattr(exact, name), getattr(ideal, name)), name
    assert exact.xyz == pytest.approx(ideal.xyz, abs=1e-6)
    assert exact.intensity == pytest.approx(ideal.intensity, abs=1e-4)
    lidar.is_exact = False
    other.revolution += 1
    assert np.array_equal(lidar.scan(walls, AT).xyz, other.scan(walls, AT).xyz)


def test_weak_echoes_are_lost() -> None:
    """The same wall returns less and less often from farther away, and from a darker thing none."""
    shares = []
    for distance in (40.0, 80.0, 95.0):
        wall = sensor_scenes.world(
            sensor_scenes.thing(sensor_scenes.shape("box", 0.05, 60.0, 60.0, at=(distance + 0.05, 0.0, 1.0)))
        )[0]
        scans = [Lidar(spec).scan(wall, AT) for spec in (_but(weakest=8e-5), LidarSpec.load("vlp16").ideal())]
        hits = [((s.labels == label(Organ.ROBOT, 0)) & _ahead(s, 0.2)).sum() for s in scans]
        shares.append(hits[0] / hits[1])
    assert shares[0] > 0.99
    assert 0.1 < shares[1] < 0.95
    assert shares[2] < 0.3 * shares[1]


def test_noise_follows_from_seed_name_and_revolution() -> None:
    primitives = _two_walls(0.3)
    spec = LidarSpec.load("vlp16")
    one = Lidar(spec, seed=3)
    two = Lidar(spec, seed=3)
    first = one.scan(primitives, AT)
    assert np.array_equal(first.xyz, two.scan(primitives, AT).xyz)
    again = one.scan(primitives, AT)
    assert not np.array_equal(first.xyz, again.xyz)
    assert np.array_equal(again.xyz, two.scan(primitives, AT).xyz)
    for other in (Lidar(spec, seed=4), Lidar(spec, "other", seed=3)):
        assert not np.array_equal(first.xyz, other.scan(primitives, AT).xyz)


def test_a_lidar_of_64_beams() -> None:
    """1024 columns of 64 shots at once, 16.6 degrees up to 16.6 degrees down, beams staggered in azimuth."""
    lidar = Lidar(LidarSpec.load("os1_64").ideal())
    around = np.arange(4) * np.pi / 2
    room = sensor_scenes.thing(
        *(
            sensor_scenes.shape(
                "box",
                0.1,
                9.0,
                9.0,
                at=frames.rotate(frames.from_yaw(a), np.array([5.0, 0, 0])),
                turn=frames.from_yaw(a),
            )
            for a in around
        )
    )
    scan = lidar.scan(sensor_scenes.world(room)[0], AT)
    assert len(scan.xyz) == 64 * 1024
    assert np.array_equal(np.unique(scan.offset), np.unique(lidar.offset))
    assert len(np.unique(scan.offset)) == 1024
    elevation = np.degrees(np.arcsin(scan.xyz[:, 2] / np.linalg.norm(scan.xyz.astype(float), axis=1)))
    for ring, angle in ((0, -16.611), (31, -0.264), (63, 16.611)):
        assert elevation[scan.ring == ring] == pytest.approx(angle, abs=2e-3)
    column = scan.offset == np.unique(scan.offset)[100]
    azimuth = np.degrees(np.arctan2(scan.xyz[column, 1], scan.xyz[column, 0]))
    assert np.ptp(azimuth) == pytest.approx(2 * 3.164, abs=1e-2)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "firing_period = { value = 55.296e-6",
            "firing_period = { value = 0.0",
            r"firing_period is 0 s; give 1e-06 to 0\.1",
        ),
        ("rays = { value = 7", "rays = { value = 900", r"rays is 900 1; give 1 to 8"),
        ("farthest = { value = 100.0", "farthest = { value = 0.2", "an empty range; give nearest < farthest"),
        ("value = [3.0, 1.5]", "value = [3.0]", "divergence has 1 values; give 2"),
        ('returns = "strongest"', 'returns = "loudest"', "returns is 'loudest'; give one of: dual, last, strongest"),
        ("leaf = { value = 0.50", "leaf = { value = -0.50", r"reflectance\.leaf is -0\.5; give 0 to 10"),
    ],
)
def test_absurd_values_are_refused_in_one_line(tmp_path, old: str, new: str, says: str) -> None:
    text = find_data_file("lidars", "vlp16", ".toml").read_text(encoding="utf-8")
    assert old in text
    file = tmp_path / "bad.toml"
    file.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(SensorError, match=says) as caught:
        LidarSpec.load(str(file))
    assert "\n" not in str(caught.value)


def test_any_number_of_threads_gives_the_same_scan() -> None:
    """In one revolution and in sectors, with noise."""
    primitives = _two_walls(0.3)
    spec = LidarSpec.load("vlp16")
    whole = Lidar(spec, threads=1).scan(primitives, AT)
    for threads in (2, 3):
        lidar = Lidar(spec, threads=threads)
        lidar.begin_revolution()
        for first in range(0, lidar.firings, 300):
            lidar.fire(primitives, first, np.repeat(AT[None], min(300, lidar.firings - first), 0))
        parts = lidar.finish_revolution(AT, 0.0)
        assert np.array_equal(whole.xyz, parts.xyz)
        assert np.array_equal(whole.labels, parts.labels)


def test_a_mount_gives_angles_ranges_and_noise_of_its_own() -> None:
    """Before a wall at 5 m: the given lasers, shots and noise, and nothing beyond the given sector and range."""
    mount = LidarMount(
        "scan",
        "lidar",
        "vlp16",
        rate=5.0,
        columns=720,
        elevations=(-0.01, 0.0, 0.01),
        sector=(-1.0, 0.5),
        range=(0.2, 6.0),
        noise=0.02,
    )
    made = MAKER.make(mount, SensorSetting())
    assert made.rate == 5.0
    wall = sensor_scenes.shape("box", 0.1, 50.0, 50.0, at=(5.1, 0.0, 0.0))
    scan = made.scan(sensor_scenes.world(sensor_scenes.thing(wall))[0], AT)
    azimuth = np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0])
    assert -1.0 <= azimuth.min() < -0.5  # beyond 0.59 rad the wall is farther away than 6 m
    assert 0.45 < azimuth.max() <= 0.5
    distance = np.linalg.norm(scan.xyz, axis=1)
    assert distance.max() < 6.1
    assert set(scan.ring) == {0, 1, 2}
    assert len(azimuth) == pytest.approx(3 * 720 * (0.59 + 0.5) / (2.0 * np.pi), rel=0.02)
    level = scan.ring == 1
    assert (distance[level] - 5.0 / np.cos(azimuth[level])).std() == pytest.approx(0.02, rel=0.2)
