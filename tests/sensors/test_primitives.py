"""Primitives: complete, labelled, and moved only where the world moved."""

import dataclasses

import numpy as np
import pytest
import trimesh

from tests.support import sensor_scenes
from vinesim.core import frames
from vinesim.scene.berries import lay_out_berries
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ, label
from vinesim.scene.spec import load_scene
from vinesim.sensors.primitives import textures
from vinesim.sensors.primitives.bunch_primitives import Ripeness
from vinesim.sensors.primitives.plant_primitives import cane_batches
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot
from vinesim.sensors.raster.primitive_arrays import LEAF, SPHEROID


@pytest.fixture(scope="module")
def model():
    return sensor_scenes.demo()


@pytest.fixture
def primitives(model):
    return Primitives(model, grass=0.0)


def _of(primitives: Primitives, organ: Organ, index: int) -> np.ndarray:
    return np.flatnonzero(primitives.label == label(organ, index))


def test_every_bunch_has_its_berries_where_its_body_is(model, primitives) -> None:
    view = rest_snapshot(model)
    for bunch in range(0, len(model.bunch_body), 7):
        mine = _of(primitives, Organ.BUNCH, bunch)
        round_ones = mine[primitives.shapes.kind.numpy()[mine] == 1]
        assert len(round_ones) == model.bunch_berries[bunch]
        expected = lay_out_berries(
            float(model.bunch_length[bunch]),
            float(model.bunch_radius[bunch]),
            int(model.bunch_berries[bunch]),
            int(model.bunch_variety[bunch]),
            int(model.bunch_seed[bunch]),
        )
        pose = view.body_q[model.bunch_body[bunch]].astype(float)
        at = pose[:3] + frames.rotate(pose[3:], expected.position)
        got = primitives.shapes.a.numpy()[round_ones]
        assert np.abs(got[:, :3] - at).max() < 1e-5
        assert np.abs(got[:, 3] - expected.radius).max() < 1e-6


def test_every_leaf_cane_and_post_is_there(model, primitives) -> None:
    organ = primitives.organ
    kind = primitives.shapes.kind.numpy()
    assert ((organ == int(Organ.LEAF)) & (kind == LEAF)).sum() >= len(model.leaf_body)
    assert (organ == int(Organ.CANE)).sum() >= (model.body_organ == int(Organ.CANE)).sum()
    for o in (Organ.POLE, Organ.WIRE, Organ.TRUNK, Organ.ARM):
        expected = {label(o, int(i)) for i in model.fixed_index[model.fixed_organ == int(o)]}
        assert set(primitives.label[organ == int(o)]) == expected


def test_small_leaves_take_their_area_from_the_leaf_in_whose_axil_they_stand(model, primitives) -> None:
    """Weight and drag in the wind are those of the model's leaves, so the drawn blades have the same area in all."""
    blades = (primitives.organ == int(Organ.LEAF)) & (primitives.shapes.kind.numpy() == LEAF)
    assert blades.sum() > 1.2 * len(model.leaf_body)
    outline = primitives.shapes.b.numpy()[blades, 3].astype(int)
    size = primitives.shapes.a.numpy()[blades, 3] / textures.leaf_scale(outline)
    for tree in range(0, len(model.tree_first), 7):
        mine = primitives.label[blades] == label(Organ.LEAF, tree)
        of_model = model.leaf_size[model.body_tree[model.leaf_body] == tree]
        assert (size[mine] ** 2).sum() == pytest.approx((of_model**2).sum(), rel=1e-4)


def test_canes_without_leaves_have_nodes_thicker_than_the_cane() -> None:
    model = generate(load_scene("cordon"))
    bare = np.setdiff1d(np.flatnonzero(model.body_organ == int(Organ.CANE)), model.leaf_body)
    batches = cane_batches(model)
    carrier = np.concatenate([batch.carrier for batch in batches])
    radius = np.concatenate([batch.b[:, 3] for batch in batches])
    assert len(bare) > 100
    for body in bare[::50]:
        assert radius[carrier == body].max() > 1.2 * model.body_radius[body, 0]


def test_peduncles_carry_the_number_of_their_bunch(model, primitives) -> None:
    names = set(primitives.label[primitives.organ == int(Organ.PEDUNCLE)])
    assert names == {label(Organ.PEDUNCLE, b) for b in range(len(model.bunch_body))}


def test_posts_in_pieces_are_whole(model, primitives) -> None:
    post = int(model.fixed_index[model.fixed_organ == int(Organ.POLE)][0])
    mine = _of(primitives, Organ.POLE, post)
    whole = (model.fixed_organ == int(Organ.POLE)) & (model.fixed_index == post)
    a = primitives.shapes.a.numpy()[mine]
    b = primitives.shapes.b.numpy()[mine]
    length = np.linalg.norm(b[:, :3] - a[:, :3], axis=1).sum()
    assert length == pytest.approx(
        np.linalg.norm(model.fixed_end[whole] - model.fixed_start[whole], axis=1).sum(), rel=1e-5
    )


def test_only_what_moved_is_moved(model, primitives) -> None:
    view = rest_snapshot(model)
    tree = int(model.body_tree[model.bunch_body[5]])
    shifted = view.body_q.copy()
    shifted[:, :3] += [0.0, 0.0, 0.25]  # every body, but only one tree says so
    before = primitives.shapes.a.numpy().copy()
    dirty = primitives.update(dataclasses.replace(view, body_q=shifted, moved_trees=np.array([tree])))
    moved = np.flatnonzero(np.abs(primitives.shapes.a.numpy() - before).max(1) > 1e-6)
    carriers = primitives._carrier.numpy()[moved]
    assert set(carriers) <= set(range(*model.bodies_of(tree).indices(len(model.body_mass))))
    assert len(dirty) < 0.1 * len(primitives.cluster_first)
    assert primitives.shapes.a.numpy()[moved, 2] == pytest.approx(before[moved, 2] + 0.25, abs=1e-5)
    # the tree falls asleep a little further on: its last motion is still taken over
    shifted[:, 2] += 0.01
    primitives.update(dataclasses.replace(view, body_q=shifted, moved_trees=np.zeros(0, np.int64)))
    assert primitives.shapes.a.numpy()[moved, 2] == pytest.approx(before[moved, 2] + 0.26, abs=1e-5)
    assert len(primitives.update(dataclasses.replace(view, body_q=shifted, moved_trees=np.zeros(0, np.int64)))) == 0


def test_bounds_hold_what_they_bound(model, primitives) -> None:
    ball = primitives.ball.numpy()
    lower = primitives.lower.numpy()
    upper = primitives.upper.numpy()
    owner = np.repeat(np.arange(len(ball)), primitives.cluster_size)
    corner = np.maximum(np.abs(lower - ball[owner, :3]), np.abs(upper - ball[owner, :3]))
    assert (corner.max(1) <= ball[owner, 3] + 1e-5).all()
    assert (lower <= upper).all()


def test_a_picked_bunch_leaves_the_vine_and_rides_on_its_link(model, primitives) -> None:
    view = rest_snapshot(model)
    bunch = 3
    attached = view.bunch_attached.copy()
    attached[bunch] = False
    primitives.update(dataclasses.replace(view, bunch_attached=attached))
    mine = _of(primitives, Organ.BUNCH, bunch)
    assert (primitives.upper.numpy()[mine, 2] < -1e5).all()
    link = sensor_scenes.thing(name="bunch/3", organ=Organ.BUNCH, index=bunch)
    pose = np.array([[1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]])
    primitives.update(dataclasses.replace(view, bunch_attached=attached, visuals=(link,), visual_q=pose))
    there = _of(primitives, Organ.BUNCH, bunch)
    shown = there[primitives.upper.numpy()[there, 2] > 0]
    assert (primitives.shapes.kind.numpy()[shown] == 1).sum() == model.bunch_berries[bunch]
    assert np.abs(primitives.shapes.a.numpy()[shown, :3] - pose[0, :3]).max() < 0.4
    primitives.update(dataclasses.replace(view, visuals=()))
    assert (primitives.upper.numpy()[_of(primitives, Organ.BUNCH, bunch), 2] > 0).all()


def _bent(model, bunch: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses of all bodies when the second cluster of a bunch is turned, and the bodies that this moves."""
    joint_q = model.joint_settled.copy()
    turned = int(model.bunch_cluster[bunch]) + 1
    joint_q[turned] = frames.multiply(frames.exp(np.array([0.1, 0.3, -0.2])), joint_q[turned])
    last = int(model.bunch_cluster[bunch] + model.bunch_clusters[bunch])
    return model.forward_kinematics(joint_q), np.arange(turned, last)


def _berries(primitives: Primitives, bunch: int, shown: bool = True) -> np.ndarray:
    mine = _of(primitives, Organ.BUNCH, bunch)
    mine = mine[primitives.shapes.kind.numpy()[mine] == 1]
    return mine[primitives.upper.numpy()[mine, 2] > -1e4] if shown else mine


def test_berries_ride_on_their_clusters(model, primitives) -> None:
    """Turn one cluster: it and those below take their berries along, the others stay; as many as before."""
    bunch = 5
    before = primitives.shapes.a.numpy()[_berries(primitives, bunch)].copy()
    body_q, moved = _bent(model, bunch)
    tree = int(model.body_tree[model.bunch_body[bunch]])
    primitives.update(dataclasses.replace(rest_snapshot(model), body_q=body_q, moved_trees=np.array([tree])))
    mine = _berries(primitives, bunch)
    after = primitives.shapes.a.numpy()[mine]
    assert len(after) == model.bunch_berries[bunch]
    on_moved = np.isin(primitives._carrier.numpy()[mine], moved)
    assert 3 < on_moved.sum() < len(mine) - 3
    shift = np.linalg.norm(after[:, :3] - before[:, :3], axis=1)
    assert shift[~on_moved].max() < 1e-6
    assert shift[on_moved].min() > 5e-4
    assert np.array_equal(after[:, 3], before[:, 3])
    # what the generator weighed is what is drawn on it
    for body in moved:
        share = (after[:, 3] ** 3)[primitives._carrier.numpy()[mine] == body].sum() / (after[:, 3] ** 3).sum()
        stem = 0.03 / (1 + model.bunch_clusters[bunch])
        weight = model.body_mass[body] / model.body_mass[model.bunch_body[bunch]]
        assert 0.97 * share + stem == pytest.approx(weight, abs=2e-3)


def test_a_picked_bunch_keeps_the_shape_it_had(model, primitives) -> None:
    bunch = 5
    body_q, _ = _bent(model, bunch)
    tree = int(model.body_tree[model.bunch_body[bunch]])
    view = dataclasses.replace(rest_snapshot(model), body_q=body_q, moved_trees=np.array([tree]))
    primitives.update(view)
    before = primitives.shapes.a.numpy()[_berries(primitives, bunch)].copy()
    attached = view.bunch_attached.copy()
    attached[bunch] = False
    link = sensor_scenes.thing(name=f"bunch/{bunch}", organ=Organ.BUNCH, index=bunch)
    loose = body_q[model.bunch_body[bunch]][None]
    primitives.update(dataclasses.replace(view, bunch_attached=attached, visuals=(link,), visual_q=loose))
    after = primitives.shapes.a.numpy()[_berries(primitives, bunch)]
    assert np.abs(after - before).max() < 2e-6
    # someone comes, everything is laid out anew while the stub's clusters are elsewhere: the loose one keeps its shape
    others = (link, sensor_scenes.thing(sensor_scenes.shape("sphere", 0.1)))
    still = dataclasses.replace(
        rest_snapshot(model), bunch_attached=attached, visuals=others, moved_trees=np.array([tree])
    )
    primitives.update(dataclasses.replace(still, visual_q=np.concatenate([loose, loose])))
    after = primitives.shapes.a.numpy()[_berries(primitives, bunch)]
    assert np.abs(after - before).max() < 2e-6


def test_links_come_move_and_go(model, primitives) -> None:
    view = rest_snapshot(model)
    plants = primitives.count
    link = sensor_scenes.thing(sensor_scenes.shape("sphere", 0.1, at=(0.0, 0.0, 0.5)), index=2)
    pose = np.array([[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    links = (link,)
    primitives.update(dataclasses.replace(view, visuals=links, visual_q=pose))
    assert primitives.count == plants + 1
    assert primitives.label[-1] == label(Organ.ROBOT, 2)
    pose = pose + 0.5 * np.eye(7)[0]
    dirty = primitives.update(dataclasses.replace(view, visuals=links, visual_q=pose))
    assert len(dirty) == 1
    assert primitives.shapes.a.numpy()[-1] == pytest.approx([1.5, 0.0, 0.5, 0.1])
    primitives.update(view)
    assert primitives.count == plants


def test_meshes_are_simplified_and_keep_their_size(tmp_path) -> None:
    file = tmp_path / "fine.stl"
    trimesh.creation.icosphere(5, radius=0.3).export(file)
    primitives, _ = sensor_scenes.world(
        sensor_scenes.thing(sensor_scenes.shape("mesh", 2.0, 2.0, 2.0, at=(0, 0, 1), file=str(file)))
    )
    assert 500 < primitives.counts_by_kind()["triangle"] <= 4000
    corners = primitives.shapes.a.numpy()[primitives.shapes.kind.numpy() == 6, :3]
    assert np.linalg.norm(corners - [0, 0, 1], axis=1) == pytest.approx(0.6, abs=0.02)


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ValueError, match="shape kind 'blob'"):
        sensor_scenes.world(sensor_scenes.thing(sensor_scenes.shape("blob", 1.0)))
    with pytest.raises(ValueError, match=r"mesh file '/nowhere\.stl'"):
        sensor_scenes.world(sensor_scenes.thing(sensor_scenes.shape("mesh", 1.0, file="/nowhere.stl")))


def test_a_second_build_is_the_same_to_the_bit(model, primitives) -> None:
    other = Primitives(model, grass=0.0)
    for name in "abcd":
        assert np.array_equal(getattr(primitives.shapes, name).numpy(), getattr(other.shapes, name).numpy())
    assert np.array_equal(primitives.materials.sky.numpy(), other.materials.sky.numpy())


def test_fruit_ripens_from_green_to_its_variety() -> None:
    """Quite ripe is what there is without ripeness; half ripe lies between green and ripe, berry by berry."""
    model = sensor_scenes.demo()
    count = len(model.bunch_body)
    looks = {}
    for share in (None, 1.0, 0.5, 0.0):
        ripeness = None if share is None else Ripeness(np.full(count, share), 3)
        primitives = Primitives(model, grass=0.0, ripeness=ripeness)
        berry = primitives.shapes.kind.numpy() == SPHEROID
        looks[share] = primitives.materials.tint.numpy()[berry], primitives.shapes.a.numpy()[berry, 3]
    assert all(np.array_equal(a, b) for a, b in zip(looks[None], looks[1.0], strict=True))
    ripe, half, green = (looks[share][0] for share in (1.0, 0.5, 0.0))
    assert np.ptp(green, axis=0).max() < 0.06
    assert (green[:, 1] > 1.3 * green[:, 0]).all()
    between = (half - green) / np.where(np.abs(ripe - green) > 0.02, ripe - green, np.nan)
    assert np.nanmin(between) > -1e-3
    assert np.nanmax(between) < 1.0 + 1e-3
    assert 0.35 < np.nanmean(between) < 0.6
    assert np.nanstd(between) > 0.1
    size = looks[0.0][1] / looks[1.0][1]
    shot = size < 0.5
    assert 0.02 < shot.mean() < 0.10
    assert np.allclose(size[~shot], 0.91, atol=0.011)


def test_most_bunches_of_a_random_vineyard_are_ripe_and_some_are_green() -> None:
    drawn = Ripeness.random(4000, 5)
    assert np.array_equal(drawn.bunch, Ripeness.random(4000, 5).bunch)
    assert 0.6 < np.median(drawn.bunch) < 0.95
    assert 0.05 < (drawn.bunch < 0.4).mean() < 0.3


_ARRAYS = ("kind", "tint", "sky", "label", "organ", "carrier", "material", *"abcd", "lower", "upper")


def _bits(primitives: Primitives) -> dict[str, bytes]:
    """All that cameras and lidars read."""
    columns = {name: primitives._columns[name].numpy()[: primitives.count] for name in _ARRAYS}
    clusters = len(primitives.cluster_first)
    columns |= {name: primitives._columns[name].numpy()[:clusters] for name in ("first", "size", "shown", "ball")}
    columns |= {"label on the host": primitives.label, "kind of cluster": primitives.cluster_kind}
    columns |= {"rigid": primitives.rigid_clusters, "lamps": primitives.lamp_primitives}
    return {name: np.ascontiguousarray(column).tobytes() for name, column in columns.items()}


def test_plants_from_the_cache_are_those_that_were_laid_out(tmp_path, monkeypatch) -> None:
    model = sensor_scenes.demo()
    monkeypatch.setenv("VINESIM_CACHE", str(tmp_path))
    made = Primitives(model)
    monkeypatch.setattr(Primitives, "_bake", None)
    read = Primitives(model)
    assert _bits(read) == _bits(made)
    for name in ("ground_sky", "soil_texture", "leaf_texture"):
        assert getattr(read.materials, name).numpy().tobytes() == getattr(made.materials, name).numpy().tobytes()
    assert read.materials.ground_cell == made.materials.ground_cell


def test_another_list_of_rigid_bodies_leaves_what_a_new_build_would_make(model) -> None:
    """Oracle: primitives that have seen this snapshot only."""
    boxes = [sensor_scenes.thing(sensor_scenes.shape("box", 0.1, 0.2, 0.3), index=i) for i in range(3)]
    crowd = [sensor_scenes.thing(sensor_scenes.shape("sphere", 0.1), index=i) for i in range(2500)]
    ball = sensor_scenes.thing(sensor_scenes.shape("sphere", 0.1), index=9)
    followed = Primitives(model, grass=0.0)
    rng = np.random.default_rng(4)
    for visuals in ((), tuple(boxes), (boxes[0],), (ball, *boxes), tuple(crowd), (), (ball,)):
        poses = np.concatenate([rng.uniform(0.0, 3.0, (len(visuals), 3)), np.tile([0, 0, 0, 1], (len(visuals), 1))], 1)
        snapshot = rest_snapshot(model, visuals, poses)
        snapshot.body_q[model.bodies_of(5)] += np.float32(0.01)
        snapshot.bunch_attached[rng.integers(len(snapshot.bunch_attached))] = False
        if not visuals:  # another list of bodies is reason enough to look at all plants
            snapshot = dataclasses.replace(snapshot, moved_trees=np.array([5]))
        followed.update(snapshot)
        new = Primitives(model, grass=0.0)
        new.update(snapshot)
        assert _bits(followed) == _bits(new)
        assert followed.count - followed.plant_count == len(visuals)
