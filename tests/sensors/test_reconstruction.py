"""Rendered pictures fused by Open3D, as docs/sensors.md shows it: the surface is where the depth pictures say."""

import json
import pathlib
import re

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from vinesim.cli.render import run
from vinesim.core import frames

pytestmark = pytest.mark.long

DOCS = pathlib.Path(__file__).parents[2] / "docs" / "sensors.md"
VIEWPOINTS = "x,y,z,look_x,look_y,look_z\n0.4,1.2,1.3,3,1,1.7\n0.45,1.15,1.3,3,1,1.7\n0.5,1.2,1.35,3,1,1.7\n"
VOXEL = 0.01
FARTHEST = 3.0
"""As in the docs [m]."""
TRUNCATION = 4.0 * VOXEL


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A folder with the pictures of three viewpoints in ``tour``."""
    folder = tmp_path_factory.mktemp("pictures")
    (folder / "path.csv").write_text(VIEWPOINTS)
    given = {"camera": "d435", "at": None, "look": None, "size": "320x240", "seed": None}
    run("demo", **given, path=folder / "path.csv", out=folder / "tour")
    return folder


def _picture(folder: pathlib.Path) -> tuple[dict, np.ndarray, np.ndarray]:
    """Camera, depth [height, width] m, and the points [n, 3] m of the world that it shows."""
    camera = json.loads((folder / "camera.json").read_text())
    depth = cv2.imread(str(folder / "depth.png"), cv2.IMREAD_UNCHANGED) * 1e-3
    fx, _, cx, _, fy, cy = camera["k"][:6]
    rows, columns = np.nonzero((depth > 0.0) & (depth < FARTHEST))
    z = depth[rows, columns]
    local = np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], 1)
    return camera, depth, frames.rotate(np.array(camera["quaternion_xyzw"]), local) + camera["position"]


def _assert_surface(vertices: np.ndarray, folder: pathlib.Path, truncation: float, gap: float) -> None:
    """Vertices [n, 3] m lie on what the pictures show, except within ``truncation`` [m] of the rims of leaves; and what
    the pictures show has vertices within ``gap`` [m]."""
    shown = np.concatenate([_picture(one)[2] for one in sorted((folder / "tour").glob("0*"))])
    assert len(vertices) > 5000
    off = cKDTree(shown).query(vertices)[0]
    away = cKDTree(vertices).query(shown)[0]
    assert np.median(off) < VOXEL
    assert np.quantile(off, 0.99) < truncation
    assert np.median(away) < VOXEL
    assert np.quantile(away, 0.9) < gap


def test_the_example_of_the_docs_fuses_pictures(folder: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("open3d", reason="Open3D is an extra (perception)")
    example = next(code for code in re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.S) if "perception" in code)
    monkeypatch.chdir(folder)
    names: dict = {}
    exec(example, names)
    assert (folder / "coarse.ply").stat().st_size > 100_000
    _assert_surface(names["surface"].vertices, folder, 2.0 * VOXEL, 4.0 * VOXEL)  # oblique surface has gaps


def test_the_older_volume_of_the_pinned_version_fuses_pictures(folder: pathlib.Path) -> None:
    o3d = pytest.importorskip("open3d", reason="Open3D is an extra (perception)")
    if o3d.__version__ == "0.20.0":
        pytest.skip("its ScalableTSDFVolume integrates nothing")
    volume = o3d.pipelines.integration.ScalableTSDFVolume(
        VOXEL, TRUNCATION, o3d.pipelines.integration.TSDFVolumeColorType.NoColor
    )
    for one in sorted((folder / "tour").glob("0*")):
        camera, depth, _ = _picture(one)
        fx, _, cx, _, fy, cy = camera["k"][:6]
        image = o3d.geometry.RGBDImage.create_from_color_and_depth(
            o3d.geometry.Image(np.zeros((*depth.shape, 3), np.uint8)),
            o3d.geometry.Image(depth.astype(np.float32)),
            1.0,
            FARTHEST,
            False,
        )
        pose = np.eye(4)
        pose[:3, :3] = frames.to_matrix(np.array(camera["quaternion_xyzw"]))
        pose[:3, 3] = camera["position"]
        lens = o3d.camera.PinholeCameraIntrinsic(camera["width"], camera["height"], fx, fy, cx, cy)
        volume.integrate(image, lens, np.linalg.inv(pose))
    _assert_surface(np.asarray(volume.extract_triangle_mesh().vertices), folder, TRUNCATION, 2.0 * VOXEL)
