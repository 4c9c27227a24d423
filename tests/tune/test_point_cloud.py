"""Canes that hang as a point cloud shows them: the shape holds for every modulus, fits find the truth, bad clouds are
refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.support.tuning import cane, hanging, number, scan
from vinesim.cli.tune import run
from vinesim.core.errors import UsageError
from vinesim.core.toml_loader import DataError
from vinesim.scene.plant_import.skeleton import PlantFileError
from vinesim.scene.plant_parameters import load_specimen
from vinesim.tune import Experiment, measure, tune, with_cloud
from vinesim.tune.fit import specimen_toml
from vinesim.tune.point_cloud import trace_axis

CURVED = {"bow": (1.1, -0.8), "segments": 64}
"""A cane that is bent by more than a radian, about both axes."""


@pytest.fixture(scope="module")
def truth():
    return cane(**CURVED)


@pytest.fixture(scope="module")
def cloud(truth) -> np.ndarray:
    return scan(hanging(truth))


def distance(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """[n] m from points to a line through [k, 3]."""
    a = line[:-1]
    way = np.diff(line, axis=0)
    share = np.clip(((points[:, None] - a) * way).sum(-1) / (way**2).sum(-1), 0.0, 1.0)
    return np.linalg.norm(points[:, None] - a - share[..., None] * way, axis=-1).min(1)


def test_the_axis_of_a_cloud_is_that_of_the_cane(truth, cloud) -> None:
    axis = trace_axis(cloud)
    np.testing.assert_allclose(axis[0], 0.0)
    assert distance(axis, np.concatenate([np.zeros((1, 3)), hanging(truth)])).max() < 0.003
    assert np.linalg.norm(axis[-1] - hanging(truth)[-1]) < 0.008


@pytest.mark.parametrize(("modulus", "mass"), [(1.0, 1.0), (0.5, 1.0), (4.0, 1.0), (1.0, 1.2)])
def test_a_cane_with_an_axis_hangs_there_whatever_its_modulus(truth, cloud, modulus: float, mass: float) -> None:
    shaped = with_cloud(cane(segments=32), cloud)
    own = hanging(shaped)
    np.testing.assert_allclose(hanging(shaped, modulus, mass), own, atol=1e-3)
    np.testing.assert_allclose(own, hanging(truth), atol=0.012)
    assert np.abs(hanging(cane(segments=32))[-1] - own[-1]).max() > 0.2  # a straight one does not


def test_a_fit_needs_the_shape(truth, cloud, tmp_path, capsys) -> None:
    """Modulus and damping of a bent cane, from files on the command line; its shape stands in what is written."""
    track = measure(truth, Experiment(duration=2.0, angle=0.0))
    track.write(tmp_path / "pull.csv")
    (tmp_path / "cane.toml").write_text(specimen_toml(cane(12e9, 0.001)))
    np.savetxt(tmp_path / "cloud.xyz", cloud, "%.5f")
    files = (tmp_path / "pull.csv", tmp_path / "cane.toml")
    out = tmp_path / "fitted.toml"
    code = run(*files, "modulus,damping", out, True, None, None, False, 0, 0, "cpu", cloud=tmp_path / "cloud.xyz")
    said = json.loads(capsys.readouterr().out)
    assert (code, said["ok"]) == (0, True), said
    fitted = load_specimen(out)
    assert fitted.modulus.value == pytest.approx(5e9, rel=0.03)
    assert fitted.damping.value == pytest.approx(0.004, rel=0.15)
    np.testing.assert_allclose(fitted.axis, with_cloud(cane(), cloud).axis, atol=1e-3)
    straight = tune(cane(12e9, 0.001), track)
    assert not straight.ok or abs(straight.estimate("modulus").value / 5e9 - 1.0) > 0.03


def test_clouds_of_other_things_are_refused(cloud, tmp_path) -> None:
    branch = cloud[len(cloud) // 2] + np.linspace(0.0, 0.2, 200)[:, None] * [0.0, 1.0, 0.0]
    shifted = np.concatenate([cloud, cloud + np.array([0.0, 0.5, 0.0])])
    for points, words in (
        (np.concatenate([cloud, branch]), "off the axis: leaves, a second branch"),
        (shifted, "are cut off from the base by gaps of more than 20 mm"),
        (1000.0 * cloud, "are cut off from the base by gaps"),
        (0.7 * cloud, "correct specimen.length"),
        (cloud[:3], "give more, in metres"),
        (cloud[:, :2], r"give \[n, 3\]"),
    ):
        with pytest.raises(UsageError, match=words):
            with_cloud(cane(), points)
    bad = tmp_path / "cloud.xyz"
    bad.write_text("0 0 0\n0 0 x\n")
    with pytest.raises(PlantFileError, match=r"cloud\.xyz:2: is '0 0 x'; give x, y and z"):
        with_cloud(cane(), bad)
    with pytest.raises(UsageError, match="leave out one of them"):
        tune(with_cloud(cane(), cloud), measure(cane(), Experiment(duration=1.0)), ("modulus", "rest"))


def test_an_axis_that_cannot_be_is_refused(tmp_path) -> None:
    path = tmp_path / "cane.toml"
    for axis, more, words in (
        (((0.0, 0.0, 0.0), (0.5, 0.0, 0.0)), {}, "on a way of 0.5 m"),
        (((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), {"direction": (1.0, 0.0, 0.0)}, "leave out direction and bow"),
    ):
        path.write_text(specimen_toml(cane(axis=axis, length=number(1.0, "m"), **more)))
        with pytest.raises(DataError, match=words):
            load_specimen(path)


def test_points_come_from_ply_and_from_text(cloud, tmp_path) -> None:
    head = f"ply\nformat ascii 1.0\nelement vertex {len(cloud)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    body = "\n".join(" ".join(f"{x:.6f}" for x in point) for point in cloud)
    (tmp_path / "a.ply").write_text(head + body + "\n")
    (tmp_path / "a.csv").write_text("x,y,z\n" + body.replace(" ", ",") + "\n")
    from_ply, from_text = (with_cloud(cane(), tmp_path / name).axis for name in ("a.ply", "a.csv"))
    assert from_ply == from_text
    np.testing.assert_allclose(from_ply, with_cloud(cane(), cloud).axis, atol=1e-4)
