"""A hanging bunch is followed in RGB-D pictures: the centre of its silhouette, within a fraction of a pixel."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.tuning import bunch
from tests.tune.test_track_command import write_bag
from vinesim.cli.tune import track
from vinesim.scene.values import CameraFrame, CameraInfo
from vinesim.tune import TrajectoryError, read_trajectory, track_bunch
from vinesim.tune.fit import specimen_toml
from vinesim.tune.specimen import place_markers

INFO = CameraInfo(240, 240, 300.0, 300.0, 119.5, 80.0, "optical")
BASE = np.array([0.0, 0.5, 0.0])
POSE = np.array([0.0, 0.0, 0.0, -np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
"""A level camera that looks along y."""
BELOW = 0.15
"""[m] Distance of the drawn bunch's centre below its clamp."""


def picture(time: float, angle: float) -> CameraFrame:
    """A yellow ellipse on a thin stalk, turned by ``angle`` [rad] about the clamp, before a grey wall; the depth of its
    front is 3 cm too near, a pixel wider and noisy."""
    fine = 4
    row, column = (np.mgrid[: 240 * fine, : 240 * fine] + 0.5) / fine - 0.5
    x, z = (column - INFO.cx) * 0.5 / INFO.fx, -(row - INFO.cy) * 0.5 / INFO.fy
    across = x * np.cos(angle) + z * np.sin(angle)
    along = x * np.sin(angle) - z * np.cos(angle)
    inside = (across / 0.045) ** 2 + ((along - BELOW) / 0.06) ** 2 < 1.0
    inside |= (np.abs(across) < 0.00225) & (along > 0.0) & (along < BELOW)
    share = inside.reshape(240, fine, 240, fine).mean((1, 3))
    rng = np.random.default_rng(round(1e3 * time))
    rgb = np.round(120.0 + share[..., None] * np.array([70.0, 60.0, -60.0])).astype(np.uint8)
    near = share > 0.0
    near[:, 1:-1] |= near[:, 2:] | near[:, :-2]
    depth = np.where(near, 0.47, 1.0) + rng.normal(0.0, 1e-3, near.shape)
    return CameraFrame(time, "camera", INFO, POSE, rgb, depth.astype(np.float32), np.zeros((0, 0)))


def test_the_centre_of_a_bunch_is_followed_and_named_by_its_distance_from_the_clamp() -> None:
    angles = 0.2 * np.cos(np.linspace(0.0, 9.0, 24))
    track = track_bunch([picture(i / 30.0, a) for i, a in enumerate(angles)], bunch(), base=BASE)
    true = BASE + BELOW * np.stack([np.sin(angles), np.zeros(24), -np.cos(angles)], -1)
    off = 1e3 * (track.position[:, 0] - true)
    assert np.abs(off[:, [0, 2]]).max() < 0.4  # mm; a pixel is 1.7 mm
    assert np.std(off[:, 0]) < 0.15
    assert np.abs(off[:, 1]).max() < 1.0
    assert int(track.markers[0].removesuffix(" mm")) == pytest.approx(150, abs=1)
    body, point = place_markers(bunch(), ("150 mm",))
    assert (body[0], point[0, 0]) == (4, pytest.approx(0.07))


def test_a_bunch_that_is_not_in_sight_is_one_clear_line() -> None:
    pictures = [picture(i / 30.0, 0.1) for i in range(12)]
    with pytest.raises(TrajectoryError, match="none of 12 pictures shows a whole bunch that hangs from a clamp at"):
        track_bunch(pictures, bunch(), base=BASE + np.array([0.0, 3.0, 0.0]))


def test_a_recording_of_a_bunch_becomes_a_track_by_the_command_of_the_page(tmp_path, capsys) -> None:
    """``vinesim track swing.mcap --bunch examples/bunch.toml --base``, as in docs/tuning.md."""
    time = np.arange(24) / 30.0
    angles = 0.2 * np.cos(np.linspace(0.0, 9.0, 24))
    drawn = [picture(t, a) for t, a in zip(time, angles, strict=True)]
    write_bag(tmp_path / "swing.mcap", time, [(one.rgb, one.depth) for one in drawn], camera=INFO)
    (tmp_path / "bunch.toml").write_text(specimen_toml(bunch()))
    files = tmp_path / "swing.mcap", [], None, tmp_path / "filmed.csv"
    plant = {"base": (0.0, 0.5, 0.0), "bunch": tmp_path / "bunch.toml"}
    assert track(*files, None, None, None, None, **plant) == 0
    assert "mm   found in 24, the others are gaps" in capsys.readouterr().out
    found = read_trajectory(tmp_path / "filmed.csv")
    true = BASE + BELOW * np.stack([np.sin(angles), np.zeros(24), -np.cos(angles)], -1)
    assert 1e3 * np.std(found.position[:, 0, 0] - true[:, 0]) < 0.3
