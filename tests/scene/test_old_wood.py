"""Old wood: spur heads below all shoots, in the fixed structure; without it nothing changes."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from vinesim.core.toml_loader import load_toml
from vinesim.scene.generation.gnarl import ARM_PIECES, MAX_STEP, TRUNK_PIECES
from vinesim.scene.generation.old_wood import MAX_PIECES_PER_SPUR
from vinesim.scene.generation.vineyard import generate_uncached
from vinesim.scene.ids import Organ
from vinesim.scene.spec import Clutter, Scene, SceneError, load_scene


def _scene(name: str = "vsp", **clutter) -> Scene:
    scene = load_scene(name)
    layout = msgspec.structs.replace(scene.layout, rows=2, vines=3)
    return msgspec.structs.replace(scene, layout=layout, clutter=Clutter(**clutter))


@pytest.fixture(scope="module")
def old():
    return generate_uncached(_scene(old_wood=1.0))


@pytest.mark.parametrize("name", ["vsp", "demo"])
def test_a_scene_without_clutter_is_the_same_with_an_empty_table(name) -> None:
    scene = load_scene(name)
    assert generate_uncached(scene).digest() == generate_uncached(_with(scene, Clutter())).digest()


def _with(scene: Scene, clutter: Clutter) -> Scene:
    return msgspec.structs.replace(scene, clutter=clutter)


def test_clutter_that_cannot_be_touched_changes_no_array() -> None:
    plain = generate_uncached(_scene())
    strewn = generate_uncached(_scene(straw=0.5, tendrils=0.3, hose=1.0, distant_rows=1.0))
    for name in plain.array_fields():
        np.testing.assert_array_equal(getattr(plain, name), getattr(strewn, name), err_msg=name)


def test_the_seed_determines_old_wood(old) -> None:
    assert generate_uncached(_scene(old_wood=1.0)).digest() == old.digest()
    assert generate_uncached(msgspec.structs.replace(_scene(old_wood=1.0), seed=2)).digest() != old.digest()


def test_old_wood_of_a_vine_does_not_depend_on_its_neighbours(old) -> None:
    scene = _scene(old_wood=1.0)
    longer = msgspec.structs.replace(scene, layout=msgspec.structs.replace(scene.layout, vines=4))
    other = generate_uncached(longer)
    for organ, count in ((Organ.TRUNK, 1), (Organ.ARM, 2)):
        mine, same = ((m.fixed_organ == int(organ)) & (m.fixed_index < 3 * count) for m in (old, other))
        np.testing.assert_array_equal(old.fixed_start[mine], other.fixed_start[same])


@pytest.mark.parametrize("name", ["vsp", "tendone"])
@pytest.mark.parametrize("age", [0.2, 1.0])
def test_every_shoot_stands_on_wood_of_its_vine(name, age) -> None:
    model = generate_uncached(_scene(name, old_wood=age))
    wood = model.fixed_organ == int(Organ.ARM)
    start, end = model.fixed_start[wood].astype(float), model.fixed_end[wood].astype(float)
    radius = model.fixed_radius[wood]
    way = end - start
    for tree in range(len(model.tree_first)):
        base = model.tree_pose[tree, :3].astype(float)
        share = np.clip(((base - start) * way).sum(1) / (way**2).sum(1), 0.0, 1.0)
        thick = radius[:, 0] * (1.0 - share) + radius[:, 1] * share
        assert (np.linalg.norm(base - start - share[:, None] * way, axis=1) < thick).any(), tree


def test_shoots_turn_with_pieces_of_the_arm_below_them(old) -> None:
    piece = old.tree_piece
    assert old.arm_is_elastic()[piece].all()
    middle = 0.5 * (old.fixed_start + old.fixed_end)[piece]
    assert np.abs((old.tree_pose[:, :3] - middle)[:, :2]).max() < 0.10
    rise = old.tree_pose[:, 2] - middle[:, 2]
    assert rise.min() > 0.0
    assert rise.max() < 0.19


def test_pieces_are_few_and_finite_and_above_the_ground(old) -> None:
    vines, arms, spurs = 6, 2, 7
    wood = np.isin(old.fixed_organ, (int(Organ.TRUNK), int(Organ.ARM)))
    least = vines * (TRUNK_PIECES + arms * ARM_PIECES)
    assert least < wood.sum() <= least + vines * (arms * (spurs * MAX_PIECES_PER_SPUR + 6) + 7)
    for name in ("fixed_start", "fixed_end", "fixed_radius"):
        assert np.isfinite(getattr(old, name)).all()
    assert (old.fixed_radius > 0.0).all()
    assert old.fixed_start[wood, 2].min() >= 0.0
    assert old.fixed_end[wood, 2].min() > 0.0
    step = np.abs(np.diff(old.fixed_radius[wood], axis=1))
    assert step.max() <= MAX_STEP + 1e-6


def test_a_share_that_is_none_and_an_unknown_post_are_refused(tmp_path) -> None:
    text = (
        'name = "a"\nseed = 1\ntraining = "vsp"\n[layout]\nrows = 1\nvines = 1\nrow_spacing = 2.0\n'
        'vine_spacing = 1.0\nheight = 0.8\n[fruit]\nbunches = [0, 0]\nvarieties = ["black"]\n[clutter]\n'
    )
    for line, said in (
        ("old_wood = 1.5", "clutter.old_wood"),
        ("straw = -0.1", "clutter.straw"),
        ('posts = "bamboo"', "clutter.posts"),
        ("mud = 1.0", "mud"),
    ):
        file = tmp_path / "scene.toml"
        file.write_text(text + line + "\n")
        with pytest.raises(SceneError, match=said) as caught:
            load_toml(file, Scene, SceneError)
        assert "\n" not in str(caught.value)
