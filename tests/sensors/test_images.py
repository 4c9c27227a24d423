"""Pictures as files."""

import cv2
import numpy as np
import pytest

from tests.support import sensor_scenes
from vinesim.scene.ids import Organ
from vinesim.sensors.camera.camera import Camera
from vinesim.sensors.export import images
from vinesim.sensors.export.annotations import label_places
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot


def test_looking_is_level_and_right_handed() -> None:
    pose = images.look_at(np.array([1.0, 2.0, 1.0]), np.array([1.0, 5.0, 1.0]))
    from vinesim.core import frames

    axes = frames.to_matrix(pose[3:])
    assert axes[:, 2] == pytest.approx([0, 1, 0])  # forward
    assert axes[:, 1] == pytest.approx([0, 0, -1])  # down
    assert axes[:, 0] == pytest.approx([1, 0, 0])  # right of someone who looks along +y
    assert frames.to_matrix(images.look_at(np.zeros(3), np.array([0, 0, 1.0]))[3:])[:, 2] == pytest.approx([0, 0, 1])


def test_a_frame_comes_back_from_its_files(tmp_path) -> None:
    primitives, _ = sensor_scenes.world(sensor_scenes.thing(sensor_scenes.shape("sphere", 0.2, at=(1.5, 0.0, 1.0))))
    frame = Camera(sensor_scenes.IDEAL, sensor_scenes.SMALL).render(primitives, sensor_scenes.AHEAD)
    paths = images.save_frame(frame, tmp_path / "out", "a")
    assert [p.name for p in paths] == ["a_rgb.png", "a_depth.png", "a_depth_mm.png", "a_labels.png"]
    assert np.array_equal(cv2.imread(str(paths[0]))[..., ::-1], frame.rgb)
    millimetres = cv2.imread(str(paths[2]), cv2.IMREAD_UNCHANGED)
    measured = np.isfinite(frame.depth) & (frame.depth < 65.0)
    assert millimetres.dtype == np.uint16
    assert np.abs(millimetres[measured] / 1000.0 - frame.depth[measured]).max() <= 0.00051
    assert (millimetres[~np.isfinite(frame.depth)] == 0).all()


def test_labels_get_distinct_colours() -> None:
    labels = np.array([[int(o) << 20 for o in Organ] + [(9 << 20) + 1, (9 << 20) + 2]], np.int32)
    colours = images.label_colours(labels)[0]
    assert len({tuple(c) for c in colours.tolist()}) == labels.shape[1]


def test_a_portrait_shows_sky_leaves_fruit_and_ground(tmp_path) -> None:
    model = sensor_scenes.demo()
    view = rest_snapshot(model)
    primitives = Primitives(model)
    image = images.render_overview(model, view, tmp_path / "p.png", width=240, height=160, primitives=primitives)
    assert image.shape == (160, 240, 3)
    assert np.array_equal(cv2.imread(str(tmp_path / "p.png"))[..., ::-1], image)
    assert 60 < image.mean() < 190  # neither black nor burnt
    assert (image == 255).all(-1).mean() < 0.05
    pixels = image.reshape(-1, 3).astype(int)
    red, green, blue = pixels.T
    assert ((green > red + 15) & (green > blue + 30)).mean() > 0.15  # leaves and grass
    assert ((blue > 120) & (blue >= red)).mean() > 0.05  # sky
    assert ((red > green + 10) & (red > blue + 10)).mean() > 0.02  # soil, wood, red berries


def test_what_cannot_be_a_png_is_named(tmp_path) -> None:
    with pytest.raises((ValueError, cv2.error)):
        images.write_png(tmp_path / "x.png", np.zeros((2, 2, 5), np.uint8))


def test_labels_are_inside_the_picture_and_cover_no_other():
    rng = np.random.default_rng(4)
    picture = 640, 480
    corners = [tuple(map(int, one)) for one in rng.integers((-50, -50), (700, 520), (60, 2))]
    sizes = [tuple(map(int, one)) for one in rng.integers((40, 15), (140, 31), (60, 2))]
    places = label_places(corners, sizes, picture)
    covered = np.zeros(picture[::-1], int)
    for place, (width, height) in zip(places, sizes, strict=True):
        if place is not None:
            assert min(place) >= 0
            assert place[0] + width <= picture[0]
            assert place[1] + height <= picture[1]
            covered[place[1] : place[1] + height, place[0] : place[0] + width] += 1
    assert covered.max() == 1
    assert places[0] is not None
    assert None in places
