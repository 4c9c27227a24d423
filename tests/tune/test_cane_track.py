"""A bare cane is followed in RGB-D pictures: a point that is fixed in the wood, within a fraction of a pixel."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.tuning import cane
from tests.tune.test_track_command import write_bag
from vinesim.cli.tune import track
from vinesim.core import frames
from vinesim.scene.camera_geometry import project_points
from vinesim.scene.values import CameraFrame, CameraInfo
from vinesim.tune import TrajectoryError, read_trajectory, track_cane
from vinesim.tune.fit import specimen_toml
from vinesim.tune.specimen import place_markers

INFO = CameraInfo(320, 240, 300.0, 300.0, 159.5, 119.5, "optical")
BASE = np.array([-0.5, 1.0, 0.0])
POSE = np.array([0.0, 0.0, 0.0, -np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
"""A level camera that looks along y."""


def curve(bend: float) -> np.ndarray:
    """Points [1001, 3] m on the axis of a cane of 1 m, evenly along it, with a curvature that falls to the tip."""
    along = np.linspace(0.0, 1.0, 1001)
    angle = bend * along * (2.0 - along)
    step = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], -1)[:-1] / 1000.0
    return BASE + np.concatenate([np.zeros((1, 3)), np.cumsum(step, 0)])


def picture(time: float, bend: float, gap: bool = False) -> CameraFrame:
    """A brown cane before a grey wall 0.4 m behind it, drawn with four by four rays a pixel; the depth is a whole pixel
    wider on either side, and has noise."""
    fine = 4
    line = frames.rotate(frames.conjugate(POSE[3:]), curve(bend) - POSE[:3])
    pixel = project_points(line, INFO)
    radius = (0.0045 - 0.0015 * np.linspace(0.0, 1.0, 1001)) * INFO.fx / line[:, 2]
    row, column = (np.mgrid[: 240 * fine, : 320 * fine] + 0.5) / fine - 0.5
    x = np.clip(column[0], pixel[0, 0], pixel[-1, 0])
    middle = np.interp(x, pixel[:, 0], pixel[:, 1])
    # distance across the cane, whose slope in the picture is small
    slope = np.gradient(middle, x + 1e-9 * np.arange(len(x)))
    thick = np.interp(x, pixel[:, 0], radius) * np.sqrt(1.0 + np.nan_to_num(slope) ** 2)
    inside = (np.abs(row - middle) < thick) & (column[0] >= pixel[0, 0]) & (column[0] <= pixel[-1, 0])
    share = inside.reshape(240, fine, 320, fine).mean((1, 3))
    rgb = np.round(120.0 + share[..., None] * np.array([40.0, -20.0, -70.0])).astype(np.uint8)
    near = share > 0.0
    near[1:-1] |= near[2:] | near[:-2]
    rng = np.random.default_rng(round(1e3 * time))
    depth = np.where(near, 1.0 - 0.785 * 0.0033, 1.4) + rng.normal(0.0, 2e-3, near.shape)
    if gap:
        depth[:, 180:] = np.nan
    return CameraFrame(time, "camera", INFO, POSE, rgb, depth.astype(np.float32), np.zeros((0, 0)))


def test_a_point_fixed_in_the_wood_is_followed() -> None:
    bends = 0.25 * np.cos(np.linspace(0.0, 9.0, 24))
    pictures = [picture(i / 30.0, bend, gap=i == 7) for i, bend in enumerate(bends)]
    track = track_cane(pictures, cane(), base=BASE, percent=80)
    true = np.array([curve(bend)[800] for bend in bends])
    off = 1e3 * (track.position[:, 0] - true)
    assert np.flatnonzero(np.isnan(off[:, 0])).tolist() == [7]
    assert np.nanstd(off, axis=0)[2] < 0.3  # mm across the view; a pixel is 3.3 mm
    assert np.nanstd(off, axis=0)[0] < 0.6  # along the cane
    assert np.abs(np.nanmean(off, axis=0)).max() < 1.5
    assert track.markers == ("80 percent",)
    body, point = place_markers(cane(), track.markers)
    assert body[0] + point[0, 0] / 0.125 == pytest.approx(0.8 * 8)


def test_a_clamp_in_a_wrong_place_is_one_clear_line() -> None:
    pictures = [picture(i / 30.0, 0.1) for i in range(12)]
    with pytest.raises(TrajectoryError, match="none of 12 pictures has depth of a cane up to 80 % of its"):
        track_cane(pictures, cane(), base=BASE + np.array([0.0, 3.0, 0.0]))


def test_a_recording_of_a_bare_cane_becomes_a_track_by_the_command_of_the_page(tmp_path, capsys) -> None:
    """``vinesim track pull.mcap --cane examples/cane.toml --base``, as in docs/tuning.md."""
    time = np.arange(24) / 30.0
    bends = 0.25 * np.cos(np.linspace(0.0, 9.0, 24))
    drawn = [picture(t, bend) for t, bend in zip(time, bends, strict=True)]
    write_bag(tmp_path / "pull.mcap", time, [(one.rgb, one.depth) for one in drawn])
    (tmp_path / "cane.toml").write_text(specimen_toml(cane()))
    files = tmp_path / "pull.mcap", [], None, tmp_path / "filmed.csv"
    assert track(*files, None, None, None, None, tmp_path / "cane.toml", (-0.5, 1.0, 0.0)) == 0
    assert "80 percent found in 24, the others are gaps" in capsys.readouterr().out
    found = read_trajectory(tmp_path / "filmed.csv")
    assert found.markers == ("80 percent",)
    off = found.position[:, 0] - np.array([curve(bend)[800] for bend in bends])
    assert 1e3 * np.std(off[:, 2]) < 0.4
