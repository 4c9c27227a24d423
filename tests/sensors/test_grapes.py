"""Wine grapes in pictures: hue of green and of black berries, veraison, damage; labels and berry numbers are exact."""

from __future__ import annotations

import functools

import cv2
import msgspec
import numpy as np
import pytest

from tests.support import sensor_scenes
from vinesim.scene.berries import VARIETIES
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import LABEL_STRIDE, Organ, label
from vinesim.scene.model import Model
from vinesim.scene.spec import Fruit, Season, load_scene
from vinesim.scene.values import CameraInfo
from vinesim.sensors import ground_truth
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export.images import look_at
from vinesim.sensors.primitives.bunch_primitives import Ripeness
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot
from vinesim.sensors.raster.primitive_arrays import SPHEROID

NEAR = CameraInfo(256, 256, 512.0, 512.0, 127.5, 127.5, "near")
SUN = (0.4, -0.7, 0.6)
GREEN = ("chardonnay", "riesling", "sauvignon-blanc")
BLACK = ("cabernet-sauvignon", "merlot", "syrah")


@functools.cache
def vineyard(variety: str, **fruit) -> tuple[Model, Primitives]:
    scene = load_scene("vsp")
    layout = msgspec.structs.replace(scene.layout, rows=1, vines=2)
    kinds = Fruit(bunches=(22, 26), varieties=(variety,), **fruit)
    scene = msgspec.structs.replace(scene, layout=layout, boxes=(), season=Season(leafiness=0.2), fruit=kinds)
    model = generate(scene)
    return model, Primitives(model, grass=0.0)


def pose_before(model: Model, bunch: int) -> np.ndarray:
    middle = rest_snapshot(model).body_q[model.bunch_body[bunch], :3].astype(float)
    middle[2] -= 0.5 * model.bunch_length[bunch]
    return look_at(middle + np.array([0.1, -0.75, 0.05]), middle)


def hsv_of_bunches(variety: str, quality: str = "still", **fruit) -> np.ndarray:
    """Hue [deg], saturation and value [n, 3] of the pixels of five bunches."""
    model, primitives = vineyard(variety, **fruit)
    camera = Camera(CameraSpec.load("pinhole"), NEAR, "near", SUN, quality=quality)
    found = []
    for bunch in range(0, 20, 4):
        frame = camera.render(primitives, pose_before(model, bunch))
        pixels = frame.rgb[frame.labels // LABEL_STRIDE == int(Organ.BUNCH)]
        found.append(cv2.cvtColor(pixels[None].astype(np.float32) / 255.0, cv2.COLOR_RGB2HSV)[0])
    return np.concatenate(found)


@pytest.mark.parametrize("variety", GREEN)
def test_green_varieties_are_green(variety: str) -> None:
    """In photographs of green grapes the hue inside of bunches is 60 to 110 degrees, mostly above 70."""
    hue, saturation, _ = hsv_of_bunches(variety).T
    assert 70.0 <= np.median(hue) <= 110.0
    assert ((hue > 60.0) & (hue < 110.0)).mean() > 0.75
    assert 0.4 < np.median(saturation) < 0.7


@pytest.mark.parametrize("variety", BLACK)
def test_black_varieties_are_green_first_and_blue_black_when_ripe(variety: str) -> None:
    green = hsv_of_bunches(variety, ripeness=(0.0, 0.05))
    assert 70.0 <= np.median(green[:, 0]) <= 110.0
    hue, _, value = hsv_of_bunches(variety).T
    assert 220.0 < np.median(hue) < 320.0
    assert np.median(value) < 0.6 * np.median(green[:, 2])


@pytest.mark.parametrize("variety", ["riesling", "merlot"])
def test_live_pictures_have_the_colours_of_stills(variety: str) -> None:
    damage = {"rot": 0.5, "shrivelled": 0.5, "sunburn": 0.5}
    still, live = (hsv_of_bunches(variety, quality, **damage) for quality in ("still", "fast"))
    assert np.median(live, 0)[1:] == pytest.approx(np.median(still, 0)[1:], abs=0.06)


def test_green_pink_and_purple_berries_hang_beside_each_other() -> None:
    model, primitives = vineyard("cabernet-sauvignon", ripeness=(0.5, 0.5))
    berry = primitives.shapes.kind.numpy() == SPHEROID
    red, green, blue = primitives.materials.tint.numpy()[berry].T
    bunch = primitives.label[berry] % LABEL_STRIDE
    for one in range(len(model.bunch_body)):
        mine = bunch == one
        assert (mine & (green > red)).sum() > 0.05 * mine.sum()
        assert (mine & (red > 1.3 * green) & (red > 0.08)).sum() > 0.15 * mine.sum()
        assert (mine & (np.maximum(red, blue) < 0.08)).sum() > 0.1 * mine.sum()


def test_the_shares_of_damaged_bunches_are_those_of_the_scene() -> None:
    """Rot is a patch of berries near each other; shrivelled berries are smaller; sound berries are untouched."""
    model, sound = vineyard("syrah")
    _, damaged = vineyard("syrah", rot=0.3, shrivelled=0.4, sunburn=0.25)
    before, after = (
        one.shapes.a.numpy()[one.shapes.kind.numpy() == SPHEROID].astype(float) for one in (sound, damaged)
    )
    berry = damaged.shapes.kind.numpy() == SPHEROID
    bunch = damaged.label[berry] % LABEL_STRIDE
    rot, dryness = damaged.shapes.c.numpy()[berry, 2:].T
    count = len(model.bunch_body)
    for there, share in ((rot > 0.0, 0.3), (dryness > 0.0, 0.4), (dryness < 0.0, 0.25)):
        with_it = len(np.unique(bunch[there])) / count
        assert abs(with_it - share) < 3.0 * np.sqrt(share * (1.0 - share) / count)
    assert np.array_equal(before[(rot == 0.0) & (dryness <= 0.0)], after[(rot == 0.0) & (dryness <= 0.0)])
    size = after[:, 3] / before[:, 3]
    assert size[dryness > 0.9].max() < 0.76
    assert 0.89 < size[rot > 0.0].min() < size[rot > 0.0].max() <= 1.0
    for one in np.unique(bunch[rot > 0.3]):
        mine = bunch == one
        spread = np.std(before[mine & (rot > 0.3), :3], axis=0).sum()
        assert spread < np.std(before[mine, :3], axis=0).sum()


def test_damage_is_determined_by_the_seed_and_changes_no_physics() -> None:
    plain, _ = vineyard("syrah")
    model, one = vineyard("syrah", rot=0.3, shrivelled=0.4, sunburn=0.25)
    assert plain.digest() == model.digest()
    again = Primitives(model, grass=0.0, ripeness=Ripeness.of(model))
    for name in ("a", "b", "c"):
        assert np.array_equal(getattr(one.shapes, name).numpy(), getattr(again.shapes, name).numpy())
    assert np.array_equal(one.materials.tint.numpy(), again.materials.tint.numpy())


def test_data_sets_use_the_ripeness_of_the_scene() -> None:
    model, _ = vineyard("syrah", ripeness=(0.2, 0.6), rot=0.1)
    drawn = Ripeness.for_pictures(model, 4)
    assert 0.2 <= drawn.bunch.min() < drawn.bunch.max() <= 0.6
    assert drawn.rot == 0.1
    model, _ = vineyard("syrah", rot=0.1)
    assert np.array_equal(Ripeness.for_pictures(model, 4).bunch, Ripeness.random(len(model.bunch_body), 4).bunch)


@pytest.mark.parametrize("variety", ["sauvignon-blanc", "merlot"])
def test_labels_and_berry_numbers_are_what_rays_meet(variety: str) -> None:
    """Of bunches with pressed, rotten and shrivelled berries."""
    model, primitives = vineyard(variety, rot=0.5, shrivelled=0.5)
    for bunch in (0, 8):
        seen = ground_truth.render_buffers(primitives, NEAR, pose_before(model, bunch))
        _, oracle = sensor_scenes.oracle(primitives, seen.pose, NEAR)
        assert (oracle == seen.primitive).mean() > 0.998
        mine = seen.labels == label(Organ.BUNCH, bunch)
        assert mine.sum() > 300
        assert (np.append(primitives.label, [0, 0])[oracle][mine] == label(Organ.BUNCH, bunch)).mean() > 0.998
        numbers = seen.berries[mine & (seen.berries >= 0)]
        assert numbers.max() < model.bunch_berries[bunch]
        berry = primitives.shapes.kind.numpy() == SPHEROID
        first = np.flatnonzero((primitives.label == label(Organ.BUNCH, bunch)) & berry)
        assert np.array_equal(first[numbers], seen.primitive[mine & (seen.berries >= 0)])
        truth = next(t for t in ground_truth.bunch_truths(primitives, rest_snapshot(model), seen) if t.bunch == bunch)
        assert truth.pixels == mine.sum()
        assert VARIETIES[truth.variety].name == variety
