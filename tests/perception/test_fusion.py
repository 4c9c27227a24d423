"""``vinesim fuse`` and ``vinesim view`` as a user types them; the fused surface against the scene's true surface."""

import json
import shutil
import sys

import cv2
import numpy as np
import pytest

import vinesim
from tests.support import programs
from tests.support.recorded_pick import record_a_pick
from tests.support.waiting import deadline
from vinesim.cli.perception import fuse as fuse_tour
from vinesim.cli.perception import view
from vinesim.cli.render import run as render
from vinesim.core.errors import UsageError
from vinesim.perception import TourError, fuse, open_tour, wood_distance
from vinesim.perception.truth import _cone_distance
from vinesim.perception.viewing import NoDisplay, Shape, draw, read_shape
from vinesim.scene.ids import LABEL_STRIDE, Organ
from vinesim.sensors.recorded_pictures import RecordedPicturesError

VIEWPOINTS = [(x, y, 1.55, x + 0.05, y + way, 1.75) for x in (0.6, 0.8) for y, way in ((-0.3, 0.5), (0.7, -0.5))]
STEMS = (Organ.CANE, Organ.PEDUNCLE)


@pytest.fixture(scope="module")
def tour(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tour")
    lines = ["x,y,z,look_x,look_y,look_z", *(",".join(map(str, one)) for one in VIEWPOINTS)]
    (folder / "path.csv").write_text("\n".join(lines))
    given = {"camera": "d435", "at": None, "look": None, "size": "320x240", "seed": None}
    assert render("demo", **given, path=folder / "path.csv", out=folder / "tour") == 0
    return folder / "tour"


def test_a_tour_is_read_with_its_poses_depths_and_labels(tour):
    pictures = [one.read() for one in open_tour(tour)]
    assert [one.name for one in pictures] == ["0000", "0001", "0002", "0003"]
    camera = vinesim.Camera("d435", size=(320, 240), quality="fast")
    simulation = vinesim.Simulation("demo")
    for picture, place in zip(pictures, VIEWPOINTS, strict=True):
        again = camera.render(simulation, vinesim.look_at(place[:3], place[3:]))
        np.testing.assert_allclose(picture.pose, again.pose, atol=1e-9)
        np.testing.assert_array_equal(picture.labels, again.labels)
        seen = np.isfinite(again.exact_depth) & (again.exact_depth < 65.0)
        np.testing.assert_allclose(picture.exact_depth[seen], again.exact_depth[seen], atol=0.00051)


def test_stems_of_a_fused_tour_are_within_a_millimetre(tour):
    surface = fuse(open_tour(tour), voxel=0.002, farthest=1.0, ids=True)
    assert surface.labels is not None
    stems = np.isin(surface.labels // LABEL_STRIDE, STEMS)
    assert stems.sum() > 1000
    assert np.abs(wood_distance(vinesim.Simulation("demo"), surface.vertices[stems], STEMS)).mean() < 1e-3


def test_the_distance_to_a_round_cone_is_exact():
    """Against the nearest of many balls along the axis, whose hull the cone is."""
    rng = np.random.default_rng(3)
    start, end = np.array([0.0, 0.0, 0.0, 0.02]), np.array([0.1, 0.02, 0.0, 0.008])
    points = rng.uniform(-0.1, 0.2, (500, 3))
    share = np.linspace(0.0, 1.0, 4001)[:, None]
    balls = start + share * (end - start)
    oracle = np.min([np.linalg.norm(points - ball[:3], axis=1) - ball[3] for ball in balls], axis=0)
    np.testing.assert_allclose(_cone_distance(points, start, end), oracle, atol=2e-6)


def test_the_commands_write_a_surface_and_a_picture_of_it(tour, tmp_path, capsys):
    file = tmp_path / "vine.ply"
    limits = {"voxel": 0.004, "far": 1.0, "depth": "exact", "views": None}
    assert fuse_tour(tour, out=file, ids=True, **limits) == 0
    shape = read_shape(file)
    assert f"{len(shape)} vertices, {len(shape.triangles)} triangles of 4 pictures" in capsys.readouterr().out
    assert shape.triangles.max() < len(shape)
    assert b"property int label" in file.read_bytes()[:400]
    picture = tmp_path / "vine.png"
    drawing = {"picture": 0, "at": None, "look": None, "size": "320x240"}
    assert view([file], out=picture, **drawing) == 0
    image = cv2.imread(str(picture))
    assert image.shape == (240, 320, 3)
    drawn = image[(image != 245).any(2)]
    assert 500 < len(drawn) < 60_000
    blue, green, red = drawn.mean(0)
    assert green > red > blue  # leaves
    for out, given, message in (
        ("a.obj", limits, "give a file with the suffix .ply"),
        ("b.ply", {**limits, "voxel": 0.0001}, "--voxel is 0.0001 m; give 0.001 to 1"),
        ("b.ply", {**limits, "far": -1.0}, "--far is -1 m; give more than 0"),
        ("b.ply", {**limits, "far": 0.01}, "no picture has exact depth nearer than 0.01 m; give a larger --far"),
        ("b.ply", {**limits, "views": 5}, "--views is 5; give 1 to 4, the number of pictures"),
        ("b.ply", {**limits, "depth": "true"}, "give exact or measured"),
        ("none/b.ply", limits, "its folder is not there"),
    ):
        with pytest.raises(UsageError, match=message):
            fuse_tour(tour, out=tmp_path / out, ids=False, **given)
        assert not (tmp_path / out).exists()


def test_a_recording_without_pictures_is_one_line(tmp_path):
    """A recording of a world, by ``vinesim record``."""
    record_a_pick(tmp_path / "run.mcap")
    with pytest.raises(RecordedPicturesError, match=r"run\.mcap: has no topic of sensor_msgs/msg/Image; give raw"):
        read_shape(tmp_path / "run.mcap")


def test_pictures_of_two_vineyards_or_moments_are_not_fused(tour, tmp_path):
    for name, change in (
        ("seeds", {"digest": "of seed 5", "seed": 5}),
        ("moments", {"wind": {"mean": 1}, "time": 2.0}),
    ):
        mixed = tmp_path / name
        shutil.copytree(tour, mixed)
        truth = mixed / "0002/truth.json"
        truth.write_text(json.dumps(json.loads(truth.read_text()) | change))
        words = r"0000.camera\.json and .*0002.camera\.json show different " + (
            r"vineyards \(seeds \d+ and 5\)" if name == "seeds" else "moments of the wind"
        )
        with pytest.raises(TourError, match=words):
            fuse(open_tour(mixed))
        truth.unlink()  # of a picture without truth nothing is known
        assert len(fuse(open_tour(mixed), voxel=0.02, farthest=1.0).vertices)


@pytest.mark.parametrize("size", [(320, 240), (200, 320)])
@pytest.mark.parametrize("edges", [(1.0, 0.1, 0.1), (0.1, 0.2, 2.0), (1.0, 3.0, 0.5)])
def test_a_shape_fills_its_picture(edges, size):
    """All points are inside, and those in the farthest places are near an edge."""
    rng = np.random.default_rng(2)
    points = rng.uniform(-0.5, 0.5, (20_000, 3)) * edges + [3.0, -2.0, 1.0]
    image = draw(Shape(points, np.zeros_like(points), np.zeros((0, 3), int)), *size)
    rows, columns = np.nonzero((image == 0).all(2))
    filled = np.array([np.ptp(columns) / size[0], np.ptp(rows) / size[1]])
    assert filled.max() > 0.7


def test_a_picture_of_a_tour_is_viewed(tour, tmp_path, capsys):
    options = {"at": None, "look": None, "size": "64x48"}
    assert view([tour], out=tmp_path / "a.png", picture=2, **options) == 0
    assert view([tour / "0002"], out=tmp_path / "b.png", picture=0, **options) == 0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    measured = open_tour(tour)[2].read().depth
    assert f"{np.isfinite(measured).sum()} points" in capsys.readouterr().out
    for files, out, picture, words in (
        ([tour], "a.png", 4, "has no picture number 4"),
        ([tour, tour], "a.png", 0, "view shows one file, not 2"),
        ([tmp_path / "none.ply"], "none/a.png", 0, "its folder is not there"),
    ):
        with pytest.raises(UsageError, match=words):
            view(files, out=tmp_path / out, picture=picture, **options)


def test_points_are_drawn_where_they_are(tmp_path, monkeypatch):
    """A red and a blue cluster, left and right of the middle."""
    rows = [f"{x} 0 {z} {c}" for x, c in ((-0.5, "255 0 0"), (0.5, "0 0 255")) for z in np.linspace(-0.1, 0.1, 50)]
    head = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property float {one}" for one in "xyz")]
    head += [*(f"property uchar {one}" for one in ("red", "green", "blue")), "end_header"]
    file = tmp_path / "points.ply"
    file.write_text("\n".join([*head, *rows, ""]))
    drawing = {"picture": 0, "at": "0,-3,0", "look": "0,0,0", "size": "200x100"}
    assert view([file], out=tmp_path / "points.png", **drawing) == 0
    image = cv2.imread(str(tmp_path / "points.png")).astype(int)
    red, blue = (np.argwhere((image[..., k] > 200) & (image[..., 2 - k] < 50))[:, 1] for k in (2, 0))
    # columns: 100 -+ 0.5 / 3 * focal length (100 / tan 30 degrees)
    assert red.mean() == pytest.approx(99.5 - 0.5 / 3.0 * 100.0 / np.tan(np.pi / 6.0), abs=1.0)
    assert blue.mean() == pytest.approx(99.5 + 0.5 / 3.0 * 100.0 / np.tan(np.pi / 6.0), abs=1.0)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if sys.platform == "linux":
        with pytest.raises(NoDisplay, match=r"give --out picture\.png") as said:
            view([file], out=None, picture=0, at=None, look=None, size=None)
        assert said.value.exit_code == 3


def test_what_is_no_tour_is_one_line(tmp_path):
    with pytest.raises(TourError, match="is not there; write a tour by: vinesim render"):
        open_tour(tmp_path / "none")
    (tmp_path / "0000").mkdir()
    with pytest.raises(TourError, match=r"has neither \*/camera\.json nor records/"):
        open_tour(tmp_path)
    (tmp_path / "0000/camera.json").write_text("{}")
    with pytest.raises(TourError, match=r"camera\.json: no camera with k, d, position"):
        open_tour(tmp_path)[0].read()


@pytest.mark.slow
def test_ctrl_c_ends_a_fusion_without_a_file(tour, tmp_path):
    """The interruption comes with the second picture."""
    code = (
        "import os, signal, sys; from vinesim.perception import tour; from vinesim.cli import main; read = "
        "tour.TourPicture.read; calls = []; tour.TourPicture.read = lambda self: (calls.append(1), len(calls) == 2 and "
        "os.kill(os.getpid(), signal.SIGINT), read(self))[2]; main()"
    )
    command = [sys.executable, "-c", code, "fuse", str(tour), "--out", str(tmp_path / "a.ply")]
    done = programs.run(command, timeout=deadline(120.0))
    assert done.returncode == 130
    assert done.stdout == f"stopped; {tmp_path / 'a.ply'} was not written\n"
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())
