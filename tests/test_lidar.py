"""Lidars: exact ranges, the table of firings, intensity."""

import numpy as np
import pytest
import seeing

from vinesim import frames
from vinesim.sensors.lidar import Lidar, LidarSpec
from vinesim.sensors.primitives import Primitives
from vinesim.sensors.specs import SensorError
from vinesim.world.ids import Organ, label
from vinesim.world.model import Model
from vinesim.world.places import find

AT = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def lidar() -> Lidar:
    return Lidar(LidarSpec.load("vlp16"))


def _post(x: float, y: float, radius: float) -> Primitives:
    model = Model.allocate(tree=0, body=0, bunch=0, leaf=0, fixed=1, tie=0, box=0)
    model.fixed_start[0], model.fixed_end[0], model.fixed_radius[0] = (x, y, -1.0), (x, y, 4.0), radius
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
    scan = lidar.scan(seeing.world()[0], pose)
    assert len(scan.xyz) > 5000
    world = pose[:3] + frames.rotate(pose[3:], scan.xyz.astype(float))
    assert np.abs(world[:, 2]).max() < 1e-4
    assert set(scan.labels) == {label(Organ.GROUND, 0)}


def test_rings_offsets_and_angles_follow_the_table(lidar: Lidar) -> None:
    room = seeing.thing(
        *(
            seeing.shape(
                "box", 0.1, 9.0, 9.0, at=frames.rotate(frames.yaw(a), np.array([5.0, 0, 0])), turn=frames.yaw(a)
            )
            for a in np.arange(4) * np.pi / 2
        )
    )
    scan = lidar.scan(seeing.world(room)[0], AT, 7.0)
    shots = len(lidar.offset)
    assert shots == 16 * 1808
    assert (scan.time, len(scan.xyz)) == (7.0, shots)
    distance = np.linalg.norm(scan.xyz.astype(float), axis=1)
    elevation = np.degrees(np.arcsin(scan.xyz[:, 2] / distance))
    assert elevation == pytest.approx(-15.0 + 2.0 * scan.ring, abs=1e-3)
    azimuth = np.unwrap(np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0]).astype(float))
    assert azimuth - azimuth[0] == pytest.approx(-2.0 * np.pi * 10.0 * scan.offset, abs=1e-4)
    assert (np.diff(scan.offset) > 0).all()
    assert scan.offset[16] == pytest.approx(55.296e-6, rel=1e-5)
    assert scan.offset[-1] < 0.1


def test_intensity_falls_with_the_angle(lidar: Lidar) -> None:
    wall = seeing.thing(seeing.shape("box", 0.1, 30.0, 30.0, at=(3.1, 0.0, 1.0)))
    scan = lidar.scan(seeing.world(wall)[0], AT)
    wall_hit = scan.labels == label(Organ.ROBOT, 0)
    cosine = scan.xyz[wall_hit, 0] / np.linalg.norm(scan.xyz[wall_hit], axis=1)
    expected = 100.0 * lidar.spec.reflectance["robot"].value * cosine
    assert scan.intensity[wall_hit] == pytest.approx(expected, abs=0.01)


def test_too_near_and_too_far_return_nothing(lidar: Lidar) -> None:
    near = seeing.thing(seeing.shape("sphere", 0.1, at=(0.3, 0.0, 1.0)), index=1)
    far = seeing.thing(seeing.shape("box", 0.1, 30.0, 30.0, at=(-101.0, 0.0, 1.0)), index=2)
    scan = lidar.scan(seeing.world(near, far)[0], AT)
    assert not np.isin([label(Organ.ROBOT, 1), label(Organ.ROBOT, 2)], scan.labels).any()
    distance = np.linalg.norm(scan.xyz, axis=1)
    assert distance.min() >= lidar.spec.nearest.value
    assert distance.max() <= lidar.spec.farthest.value


def test_a_scan_of_the_vineyard_follows_motion(lidar: Lidar) -> None:
    post = seeing.thing(seeing.shape("cylinder", 0.05, 2.0, at=(2.0, 0.0, 0.0)))
    primitives, view = seeing.world(post, model=seeing.demo())
    first, again = lidar.scan(primitives, AT), lidar.scan(primitives, AT)
    assert np.array_equal(first.xyz, again.xyz)
    assert {int(v) >> 20 for v in np.unique(first.labels)} >= {
        int(Organ.LEAF),
        int(Organ.BUNCH),
        int(Organ.TRUNK),
        int(Organ.ROBOT),
    }
    import dataclasses

    primitives.update(dataclasses.replace(view, link_q=view.link_q + 0.5 * np.eye(7)[1]))
    moved = lidar.scan(primitives, AT)
    mine = moved.xyz[moved.labels == label(Organ.ROBOT, 0)].astype(float)
    assert np.abs(np.hypot(mine[:, 0] - 2.0, mine[:, 1] - 0.5) - 0.05).max() < 2e-5


def test_bad_input_is_named(lidar: Lidar, tmp_path) -> None:
    with pytest.raises(ValueError, match="pose"):
        lidar.scan(seeing.world()[0], np.full(7, np.inf))
    file = tmp_path / "bad.toml"
    text = find("lidars", "vlp16", ".toml").read_text(encoding="utf-8")
    file.write_text("\n".join(line for line in text.splitlines() if not line.startswith("bunch")), encoding="utf-8")
    with pytest.raises(SensorError, match=r"reflectance\.bunch"):
        LidarSpec.load(str(file))
