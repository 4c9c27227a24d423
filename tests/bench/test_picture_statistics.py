"""``python -m benchmarks picture_statistics``: pictures whose statistics are known."""

from __future__ import annotations

import colorsys

import cv2
import numpy as np
import pytest
from PIL import Image

from benchmarks.picture_statistics import (
    bunch_shapes,
    detail_levels,
    mean_and_spread,
    noise_level,
    of_picture,
    picture_statistics,
    table,
)
from benchmarks.support.bunch_pictures import BunchPicture, mask_boxes
from vinesim.core.errors import UsageError


def coloured(hue: float, saturation: float, value: float) -> np.ndarray:
    """Red, green and blue [3] uint8 of a colour; ``hue`` in degrees."""
    return np.rint(255.0 * np.array(colorsys.hsv_to_rgb(hue / 360.0, saturation, value))).astype(np.uint8)


def two_colours(inside: np.ndarray, outside: np.ndarray) -> BunchPicture:
    """A picture of 100x80 px with one bunch of 20x40 px."""
    bunches = np.zeros((80, 100), np.uint16)
    bunches[20:60, 30:50] = 1
    return BunchPicture("a", np.where(bunches[..., None] > 0, inside, outside), bunches, mask_boxes(bunches))


def test_colours_are_counted_inside_and_outside_of_bunches():
    found = of_picture(two_colours(coloured(90, 0.5, 0.8), coloured(25, 0.4, 0.6)))
    assert found["bunches: hue 70 to 110 degrees, share"] == 1.0
    assert found["bunches: other hue or none, share"] == 0.0
    assert found["bunches: saturation"] == pytest.approx(0.5, abs=0.005)
    assert found["bunches: spread of brightness"] == pytest.approx(0.0, abs=1e-9)
    assert found["background: hue 10 to 40 degrees, share"] == 1.0
    assert found["background: saturation"] == pytest.approx(0.4, abs=0.005)
    red, green, blue = colorsys.hsv_to_rgb(25 / 360, 0.4, 0.6)
    assert found["background: brightness"] == pytest.approx(0.299 * red + 0.587 * green + 0.114 * blue, abs=0.003)
    assert found["bunches, share of the picture"] == pytest.approx(20 * 40 / (80 * 100))
    assert found["height of a box / height of the picture"] == 0.5


def test_grey_has_no_hue_and_white_is_counted():
    found = of_picture(two_colours(np.full(3, 255, np.uint8), np.full(3, 120, np.uint8)))
    assert found["bunches: other hue or none, share"] == found["background: other hue or none, share"] == 1.0
    assert found["nearly white, share"] == pytest.approx(0.1)


def test_shares_of_hues_sum_to_one():
    rng = np.random.default_rng(3)
    picture = two_colours(coloured(90, 0.5, 0.8), coloured(25, 0.4, 0.6))
    noisy = BunchPicture("a", rng.integers(0, 256, picture.rgb.shape, np.uint8), picture.bunches, picture.boxes)
    found = of_picture(noisy)
    for place in ("bunches", "background"):
        assert sum(v for k, v in found.items() if k.startswith(f"{place}: ") and "hue" in k) == pytest.approx(1.0)


@pytest.mark.parametrize("strength", [1.5, 4.0])
def test_the_standard_deviation_of_noise_is_found(strength):
    """The smoothest tenth of the blocks has a little less than all: less than 15 % here. A gradient adds nothing."""
    rng = np.random.default_rng(5)
    levels = np.linspace(60.0, 180.0, 320) + rng.normal(0.0, strength, (240, 320))
    assert 0.85 * strength < noise_level(levels) < strength


def test_a_smooth_picture_has_no_noise_even_if_the_rest_has_texture():
    levels = np.full((160, 160), 100.0)
    levels[:, 80:] += np.where(np.indices((160, 80)).sum(0) % 2, 30.0, -30.0)
    assert noise_level(levels) == pytest.approx(0.0, abs=1e-9)


def test_sky_is_bright_and_pale_or_blue():
    for sky, share in (((215, 0.5, 0.9), 0.9), ((60, 0.05, 0.9), 0.9), ((90, 0.5, 0.9), 0.0), ((215, 0.5, 0.4), 0.0)):
        found = of_picture(two_colours(coloured(25, 0.4, 0.6), coloured(*sky)))
        assert found["bright and pale or blue, share"] == pytest.approx(share)


def test_blur_takes_fine_detail_away_where_it_is():
    """A checkerboard of 20 levels is nothing but detail, and a smooth picture has none."""
    levels = 100.0 + 20.0 * np.where(np.indices((512, 768)).sum(0) % 2, 1.0, -1.0)
    assert detail_levels(levels) == pytest.approx([20.0, 20.0], rel=0.01)
    levels[:, :230] = np.linspace(50.0, 150.0, 230)
    assert detail_levels(levels)[0] < 0.2
    assert detail_levels(levels)[1] == pytest.approx(20.0, rel=0.01)


def test_a_cane_across_a_bunch_makes_two_parts():
    bunches = np.zeros((100, 100), np.uint16)
    bunches[10:70, 20:60] = 5
    whole = bunch_shapes(bunches)
    assert (whole["bunches in a picture"], whole["parts of a bunch"]) == (1.0, 1.0)
    assert whole["filled, of a bunch"] == pytest.approx(1.0)
    bunches[38:42] = 0
    crossed = bunch_shapes(bunches)
    assert crossed["parts of a bunch"] == 2.0
    assert crossed["filled, of a bunch"] == pytest.approx(56 / 60)
    assert crossed["roughness of a bunch"] > whole["roughness of a bunch"]
    assert crossed["height of a box / height of the picture"] == 0.6


def test_a_disc_is_not_rough():
    disc = cv2.circle(np.zeros((200, 200), np.uint8), (100, 100), 70, 1, -1)
    assert bunch_shapes(disc)["roughness of a bunch"] == pytest.approx(1.0, abs=0.12)
    assert bunch_shapes(disc)["filled, of a bunch"] == pytest.approx(1.0, abs=0.02)


def test_a_few_pixels_are_no_bunch():
    bunches = np.zeros((50, 50), np.uint16)
    bunches[3:6, 3:8] = 1  # 15 pixels
    found = bunch_shapes(bunches)
    assert found["bunches in a picture"] == 0.0
    assert np.isnan(found["parts of a bunch"])


def test_the_table_marks_what_is_outside_of_one_standard_deviation():
    real = {"near": np.array([1.0, 3.0]), "far": np.array([1.0, 3.0])}
    ours = {"near": np.array([2.9, np.nan]), "far": np.array([3.1, 3.1])}
    lines = table({"photos": real, "ours": ours}).splitlines()
    assert lines[0] == "| mean ± standard deviation | photos (2) | ours (2) |"
    assert lines[2] == "| near | 2.000 ± 1.000 | 2.900 ± 0.000 |"
    assert lines[3] == "| far | 2.000 ± 1.000 | **3.100** ± 0.000 |"
    assert lines[4].endswith("| 1 of 2 outside |")
    assert np.isnan(mean_and_spread(np.array([np.nan]))).all()


def test_photographs_without_masks_are_one_clear_line(tmp_path):
    photos, ours = tmp_path / "photos", tmp_path / "ours"
    (ours / "images").mkdir(parents=True)
    (ours / "ids").mkdir()
    photos.mkdir()
    for file in (photos / "a.jpg", ours / "images/000000.png", ours / "ids/000000.png"):
        Image.new("RGB", (64, 48)).save(file)
    with pytest.raises(UsageError, match=r"none of its 1 photographs has masks; put STEM.png"):
        list(picture_statistics(photos=str(photos), synthetic=[str(ours)]))


def test_the_table_is_written_and_means_are_yielded_beside_those_of_photographs(tmp_path):
    photos, ours = tmp_path / "photos", tmp_path / "ours"
    (ours / "images").mkdir(parents=True)
    (ours / "ids").mkdir()
    photos.mkdir()
    mask = np.zeros((48, 64), np.uint8)
    mask[10:34, 10:30] = 1
    Image.new("RGB", (64, 48), (200, 200, 200)).save(photos / "a.jpg")
    Image.fromarray(mask).save(photos / "a.png")
    for file in (ours / "images/000000.png", ours / "ids/000000.png"):
        Image.new("RGB", (64, 48)).save(file)
    out = tmp_path / "table.md"
    found = {m.case: m for m in picture_statistics(photos=str(photos), synthetic=[str(ours)], out=str(out))}
    height = found["ours: height of a box / height of the picture"]
    assert np.isnan(height.value)
    assert height.peer_value == 0.5
    assert found["ours: bunches in a picture"].value == 0.0
    assert "| photos (1) | ours (1) |" in out.read_text()
