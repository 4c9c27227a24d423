"""Clutter and distant rows: seeded, bounded, above the ground, with true labels, and where contact geometry is."""

from __future__ import annotations

import dataclasses

import msgspec
import mujoco
import numpy as np
import pytest

from vinesim.rigid.static_world import FIRST_FIXED_GEOM, build_static_world
from vinesim.scene.generation.vineyard import generate_uncached
from vinesim.scene.ids import LABEL_STRIDE, NO_OBJECT, Organ
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.spec import Clutter, Scene, TerrainTable, load_scene
from vinesim.sensors import ground_truth
from vinesim.sensors.camera.camera import CameraSpec
from vinesim.sensors.export.dataset import resized_intrinsics
from vinesim.sensors.export.images import look_at
from vinesim.sensors.primitives import clutter, distant_rows, textures
from vinesim.sensors.primitives.ray_caster import RayCaster
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.raster.primitive_arrays import BOX, CONE, LEAF
from vinesim.wires.wire_segments import wire_segments

EVERYTHING = Clutter(
    old_wood=1.0,
    tendrils=1.0,
    dead_leaves=1.0,
    straw=1.0,
    prunings=1.0,
    hose=1.0,
    posts="mixed",
    ties=1.0,
    distant_rows=1.0,
)


def _scene(table: Clutter, *, bare: bool = False, **changes) -> Scene:
    scene = load_scene("vsp")
    layout = msgspec.structs.replace(scene.layout, rows=2, vines=3)
    scene = msgspec.structs.replace(scene, layout=layout, clutter=table, boxes=(), **changes)
    if bare:
        season = msgspec.structs.replace(scene.season, leafiness=0.0)
        fruit = msgspec.structs.replace(scene.fruit, bunches=(0, 0))
        scene = msgspec.structs.replace(scene, season=season, fruit=fruit)
    return scene


@pytest.fixture(scope="module")
def model():
    return generate_uncached(_scene(EVERYTHING))


@pytest.fixture(scope="module")
def primitives(model):
    return Primitives(model)


@pytest.fixture(scope="module")
def view(primitives):
    info = resized_intrinsics(CameraSpec.load("pinhole"), (640, 480))
    return ground_truth.render_buffers(primitives, info, look_at(np.array([2.0, 4.2, 1.1]), np.array([2.2, 0.0, 0.9])))


def _batches(model) -> list:
    segments = wire_segments(model)
    low, high = model.fixed_start[:, :2].min(0), model.fixed_start[:, :2].max(0)
    static = len(model.body_mass) + len(segments)
    return [*clutter.clutter_batches(model, segments, static, low, high), *distant_rows.distant_batches(model, static)]


def test_without_clutter_there_is_not_one_more_primitive() -> None:
    plain = generate_uncached(_scene(Clutter()))
    assert _batches(plain) == []
    assert not clutter.redrawn_posts(plain).any()


def test_the_seed_determines_the_clutter(model) -> None:
    for one, same in zip(_batches(model), _batches(generate_uncached(_scene(EVERYTHING))), strict=True):
        for name in ("a", "b", "c", "d", "tint", "label", "material", "carrier"):
            np.testing.assert_array_equal(getattr(one, name), getattr(same, name))
    other = _batches(generate_uncached(_scene(EVERYTHING, seed=5)))
    assert any(
        len(one.a) != len(two.a) or (one.a != two.a).any() for one, two in zip(_batches(model), other, strict=True)
    )


def test_numbers_are_finite_and_in_range(model) -> None:
    for batch in _batches(model):
        for name in "abcd":
            assert np.isfinite(getattr(batch, name)).all()
        assert (batch.a[:, 3] > 0.0).all()
        assert ((batch.tint >= 0.0) & (batch.tint <= 1.0)).all()
        assert ((batch.label >= 0) & (batch.label // LABEL_STRIDE == batch.organ)).all()
        if batch.kind == LEAF:
            for column in (batch.b, batch.c):
                np.testing.assert_allclose(np.linalg.norm(column[:, :3], axis=1), 1.0, atol=1e-5)
            np.testing.assert_allclose((batch.b[:, :3] * batch.c[:, :3]).sum(1), 0.0, atol=1e-5)
            assert (batch.b[:, 3] < textures.OUTLINE_COUNT).all()


def test_nothing_is_below_the_ground(model, primitives) -> None:
    added = np.isin(primitives.organ, (int(Organ.GROUND), int(Organ.LEAF), int(Organ.CANE), int(Organ.WIRE)))
    a, b = primitives.shapes.a.numpy(), primitives.shapes.b.numpy()
    cone = added & (primitives.shapes.kind.numpy() == CONE)
    assert (a[cone, 2] - a[cone, 3]).min() > -1e-3
    assert (b[cone, 2] - b[cone, 3]).min() > -1e-3
    away = primitives.label % LABEL_STRIDE == NO_OBJECT
    assert primitives.lower.numpy()[away & added, 2].min() > -0.13
    assert a[added, 2].min() >= 0.0


def test_every_pixel_has_the_label_of_the_primitive_there(primitives, view) -> None:
    seen = view.primitive >= 0
    np.testing.assert_array_equal(view.labels[seen], primitives.label[view.primitive[seen]])
    organs = set(np.unique(view.labels // LABEL_STRIDE))
    assert {int(o) for o in (Organ.GROUND, Organ.WIRE, Organ.TRUNK, Organ.ARM, Organ.LEAF, Organ.CANE)} <= organs


def test_bark_and_cuts_are_wood_in_the_picture(model, primitives, view) -> None:
    """A strip of bark has the label of the trunk or arm on which it is."""
    strips = clutter.bark_batch(model, 1.0, 0)
    middle = 0.5 * (strips.a + strips.b)[:, :3]
    for k in range(0, len(middle), 97):
        organ, index = divmod(int(strips.label[k]), LABEL_STRIDE)
        mine = (model.fixed_organ == organ) & (model.fixed_index == index)
        way = (model.fixed_end - model.fixed_start)[mine]
        start = model.fixed_start[mine]
        share = np.clip(((middle[k] - start) * way).sum(1) / (way**2).sum(1), 0.0, 1.0)
        gap = np.linalg.norm(middle[k] - start - share[:, None] * way, axis=1) - model.fixed_radius[mine].max(1)
        assert gap.min() < 0.03


def test_picture_and_contact_agree_on_arms_and_spur_heads(monkeypatch) -> None:
    """Rays hit old wood at the same distance in the picture, without bark strips, and in what robots touch."""
    monkeypatch.setattr(clutter, "bark_batch", lambda *_: None)
    monkeypatch.setattr(clutter, "cut_batch", lambda *_: None)
    model = generate_uncached(_scene(Clutter(old_wood=1.0), bare=True))
    model.look = dataclasses.replace(model.look, seed=77)  # primitives that no disk cache has
    primitives = Primitives(model, grass=0.0)
    world = build_static_world(model, PhysicsParameters()).compile()
    data = mujoco.MjData(world)
    mujoco.mj_forward(world, data)
    wood = np.isin(model.fixed_organ, (int(Organ.TRUNK), int(Organ.ARM)))
    rng = np.random.default_rng(3)
    piece = rng.choice(np.flatnonzero(wood), 2000)
    target = 0.5 * (model.fixed_start + model.fixed_end)[piece].astype(float)
    eye = target + np.stack([rng.uniform(-0.3, 0.3, 2000), np.full(2000, -0.8), rng.uniform(-0.1, 0.3, 2000)], 1)
    eye[:, 2] = np.maximum(eye[:, 2], 0.05)
    way = target - eye
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    seen, hit = RayCaster(primitives).cast(eye, way)
    errors = {True: [], False: []}
    for k in range(len(eye)):
        geom = np.zeros(1, np.int32)
        touched = mujoco.mj_ray(world, data, eye[k], way[k], None, 1, -1, geom)
        fixed = int(geom[0]) - FIRST_FIXED_GEOM
        if 0 <= fixed < len(wood) and wood[fixed] and primitives.organ[hit[k]] == model.fixed_organ[fixed]:
            is_chain = bool(model.fixed_shear_modulus[fixed] > 0.0) or model.fixed_organ[fixed] == int(Organ.TRUNK)
            errors[is_chain].append(abs(float(seen[k]) - touched))
    for is_chain, share in ((True, 0.005), (False, 0.02)):  # the rest graze an edge
        found = np.array(errors[is_chain])
        assert len(found) > 200
        assert np.median(found) < 0.001
        assert (found > 0.005).mean() <= share


def test_posts_are_where_they_are_touched() -> None:
    for kind, most in (("wood", 1e-6), ("concrete", 0.014), ("steel", 0.013)):
        model = generate_uncached(_scene(Clutter(posts=kind)))
        batches = clutter.post_batches(model, model.look.clutter, 0)
        pole = np.flatnonzero(model.fixed_organ == int(Organ.POLE))
        radius = float(model.fixed_radius[pole[0], 0])
        names = {int(one) for batch in batches for one in batch.label}
        assert names == {int(Organ.POLE) * LABEL_STRIDE + int(i) for i in model.fixed_index[pole]}
        for batch in batches:
            if batch.kind == BOX:
                axis = model.fixed_start[pole][batch.label % LABEL_STRIDE]
                corner = np.abs(batch.a[:, :2] - axis[:, :2]) + np.stack([batch.a[:, 3], batch.c[:, 0]], 1)
                assert np.linalg.norm(corner, axis=1).max() - radius < most


def test_rows_beyond_the_scene_leave_a_road_and_carry_no_ids(model, primitives) -> None:
    away = primitives.label % LABEL_STRIDE == NO_OBJECT
    far = away & np.isin(primitives.organ, (int(Organ.TRUNK), int(Organ.POLE)))
    place = primitives.shapes.a.numpy()[far, :2]
    poles = model.fixed_start[model.fixed_organ == int(Organ.POLE), :2]
    gap = np.maximum(np.maximum(poles.min(0) - place, place - poles.max(0)), 0.0)
    distance = np.linalg.norm(gap, axis=1)
    assert distance.min() > EVERYTHING.headland - 0.3
    assert distance.max() < 110.0
    assert (primitives.organ[away] != int(Organ.BUNCH)).all()


def test_open_sides_have_trees_but_no_rows() -> None:
    count = {}
    for share in (0.25, 1.0):
        batches = distant_rows.distant_batches(generate_uncached(_scene(Clutter(distant_rows=share))), 0)
        posts = np.concatenate([b.a[b.organ == int(Organ.POLE)] for b in batches])
        count[share] = len(posts)
        assert sum((b.kind == LEAF) * len(b) for b in batches) > 1000
    assert 0 < count[0.25] < 0.5 * count[1.0]


def test_counts_are_bounded() -> None:
    scene = load_scene("vsp")
    layout = msgspec.structs.replace(scene.layout, rows=6, vines=20)
    batches = _batches(generate_uncached(msgspec.structs.replace(scene, layout=layout, clutter=EVERYTHING)))
    most = (
        2 * clutter.MAX_STRIPS
        + 11 * clutter.MAX_TENDRILS
        + 5 * clutter.MAX_TENDRILS
        + 2 * clutter.MAX_DEAD_LEAVES
        + clutter.MAX_STRAW
        + 3 * clutter.MAX_PRUNINGS
        + 16 * clutter.MAX_TIES
        + distant_rows.MAX_LEAVES
        + distant_rows.MAX_CLUMPS
        + distant_rows.MAX_TUFTS
        + distant_rows.WOOD_OF_VINE * distant_rows.MAX_VINES
        + distant_rows.WOOD_OF_NEAR_VINE * 1.2 * distant_rows.MAX_DETAILED
        + 110 * 101
    )
    parts = [b for b in batches if not (b.organ == int(Organ.WIRE)).all() and not (b.organ == int(Organ.POLE)).all()]
    stubs = 6 * 20 * (2 * 14 * 2 + 5)
    assert sum(len(b) for b in parts) <= most + stubs


def test_clutter_follows_uneven_ground() -> None:
    terrain = TerrainTable(slope=0.15, direction=0.5)
    model = generate_uncached(_scene(Clutter(straw=0.3, prunings=0.5, hose=1.0, distant_rows=1.0), terrain=terrain))
    for batch in _batches(model):
        ground = model.terrain.height(batch.a[:, 0].astype(float), batch.a[:, 1].astype(float))
        height = batch.a[:, 2] - ground
        assert height.min() > -0.05
        assert height.max() < 12.0
        if (batch.organ == int(Organ.GROUND)).all():
            assert height.max() < 0.25
