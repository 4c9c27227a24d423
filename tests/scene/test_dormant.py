"""Dormant vineyards: the same vines as in summer, canes and nodes where they are, sizes as published."""

import datetime

import msgspec
import numpy as np
import pytest

from vinesim.core import frames
from vinesim.scene import plant_parameters
from vinesim.scene import spec as scenes
from vinesim.scene.generation.vineyard import generate, generate_uncached
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.season import load_season
from vinesim.scene.state import State
from vinesim.scene.surroundings import main_axis

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", params=["winter_spur", "winter_cane"])
def winter(request: pytest.FixtureRequest) -> tuple[scenes.Scene, Model]:
    scene = scenes.load_scene(request.param)
    return scene, generate(scene)


def test_there_are_neither_leaves_nor_bunches(winter: tuple[scenes.Scene, Model]) -> None:
    scene, model = winter
    counts = model.counts()
    assert (counts["leaf"], counts["bunch"]) == (0, 0)
    cane = plant_parameters.load_plant(scene.plants).arm
    vines = scene.layout.rows * scene.layout.vines
    assert (model.canes.year == 1).sum() == vines * cane.vsp_arms.value * cane.vsp_shoots.value


def test_the_cache_keeps_nodes_and_canes(winter: tuple[scenes.Scene, Model]) -> None:
    scene, model = winter
    again = generate_uncached(scene)
    assert again.digest() == model.digest() == model.copy().digest()
    for kept, made in ((model.nodes, again.nodes), (model.canes, again.canes)):
        for name in kept.array_fields():
            assert np.array_equal(getattr(kept, name), getattr(made, name)), name


def test_canes_are_the_shoots_of_the_same_scene_in_summer(winter: tuple[scenes.Scene, Model]) -> None:
    scene, model = winter
    summer = generate_uncached(msgspec.structs.replace(scene, date=datetime.date(2026, 9, 15)))
    q = State.at_rest(model).body_q.astype(float)
    harvest = State.at_rest(summer).body_q.astype(float)
    canes = model.canes
    young = np.flatnonzero(canes.year == 1)
    assert sorted(canes.shoot[young]) == list(range(len(summer.tree_first)))
    base = q[canes.body[young], :3]
    np.testing.assert_allclose(base, harvest[summer.tree_first[canes.shoot[young]], :3], atol=1e-5)
    share = load_season().dormant.ripe_share.value
    for cane in young[:: len(young) // 20]:
        axis = main_axis(summer, int(canes.shoot[cane]))
        path = np.concatenate([harvest[axis, :3], [_tip(summer, harvest, axis[-1])]])
        at = share * np.arange(len(axis) + 1)
        piece = np.minimum(at.astype(int), len(axis) - 1)
        wanted = path[piece] + (at - piece)[:, None] * (path[piece + 1] - path[piece])
        bodies = np.arange(canes.body[cane], canes.body[cane] + canes.size[cane])
        np.testing.assert_allclose(q[bodies, :3], wanted[:-1], atol=2e-5)


def _tip(model: Model, q: np.ndarray, body: int) -> np.ndarray:
    return q[body, :3] + frames.rotate(q[body, 3:], np.array([float(model.body_length[body]), 0.0, 0.0]))


def test_nodes_are_on_their_canes_from_base_to_tip(winter: tuple[scenes.Scene, Model]) -> None:
    model = winter[1]
    nodes = model.nodes
    canes = model.canes
    of_body = canes.of_bodies(len(model.body_mass))
    assert np.array_equal(of_body[nodes.body], nodes.cane)
    assert (nodes.along >= 0.0).all()
    assert (nodes.along <= model.body_length[nodes.body] + 1e-6).all()
    for cane in range(len(canes.body)):
        mine = np.flatnonzero(nodes.cane == cane)
        assert np.array_equal(nodes.rank[mine], np.arange(len(mine)))
        place = nodes.body[mine] + nodes.along[mine] / model.body_length[nodes.body[mine]]
        assert (np.diff(place) > 0.0).all()
        assert (nodes.bud[mine] >= 0).all() == (canes.year[cane] == 1)
    buds = nodes.bud[nodes.bud >= 0]
    assert np.array_equal(np.sort(buds), np.arange(len(buds)))


def test_canes_stand_at_the_nodes_they_name(winter: tuple[scenes.Scene, Model]) -> None:
    model = winter[1]
    canes = model.canes
    q = State.at_rest(model).body_q.astype(float)
    young = np.flatnonzero(canes.year == 1)
    at = model.nodes.positions(q)[canes.node[young]]
    apart = np.linalg.norm(q[canes.body[young], :3] - at, axis=1)
    assert apart.max() < 0.6 * load_season().dormant.two_year_diameter.value
    assert np.array_equal(model.nodes.cane[canes.node[young]], canes.parent[young])
    assert np.array_equal(model.body_parent[canes.body[young]] >= 0, np.ones(len(young), bool))


def test_buds_point_outwards_and_to_the_tip(winter: tuple[scenes.Scene, Model]) -> None:
    model = winter[1]
    nodes = model.nodes
    has = np.flatnonzero(nodes.bud >= 0)
    pose = nodes.bud_pose[has].astype(float)
    way = frames.rotate(pose[:, 3:], np.array([1.0, 0.0, 0.0]))
    assert (way[:, 0] > 0.7).all()
    assert ((way * pose[:, :3] * [0.0, 1.0, 1.0]).sum(1) > 0.0).all()
    q = State.at_rest(model).body_q
    world = nodes.bud_poses(q)
    apart = np.linalg.norm(world[:, :3] - nodes.positions(q)[has], axis=1)
    assert (apart < 0.007).all()


def test_internodes_and_retained_canes_are_as_published() -> None:
    """Internodes of 60 mm (wineskills.co.uk); retained canes 9.2 mm thick, 104.7 cm long, 11.4 cm from the trunk, 83.2
    cm high (AJGWR 2022)."""
    model = generate(scenes.load_scene("winter_cane"))
    canes = model.canes
    young = canes.year == 1
    spur = young & (canes.size[canes.parent] <= 2)
    np.testing.assert_allclose(canes.length[young].mean(), 1.047, rtol=0.02)
    np.testing.assert_allclose(canes.diameter[spur].mean(), 9.2e-3, rtol=0.03)
    np.testing.assert_allclose(canes.from_trunk[spur].mean(), 0.114, rtol=0.05)
    np.testing.assert_allclose(canes.height[spur].mean(), 0.832, rtol=0.02)
    per_cane = np.bincount(model.nodes.cane)[young]
    np.testing.assert_allclose((canes.length[young] / per_cane).mean(), 0.06, rtol=0.12)


def test_two_canes_stand_on_every_full_spur() -> None:
    model = generate(scenes.load_scene("winter_spur"))
    canes = model.canes
    borne = np.bincount(canes.parent[canes.year == 1], minlength=len(canes.body))[canes.year == 2]
    assert set(borne) == {1, 2}
    assert (borne == 2).mean() == pytest.approx(6 / 7)


def test_dormant_wood_hangs_in_equilibrium(winter: tuple[scenes.Scene, Model]) -> None:
    """Every body is wood of the published modulus: the stiffness of a joint within a cane is EI/h."""
    model = winter[1]
    dormant = load_season().dormant
    assert (model.body_organ == Organ.CANE).all()
    for cane in np.flatnonzero(model.canes.year == 1)[::25]:
        body = int(model.canes.body[cane]) + 5
        radius = float(model.body_radius[body, 0])
        length = 0.5 * float(model.body_length[body] + model.body_length[body - 1])
        wanted = dormant.modulus.value * np.pi * radius**4 / 4.0 / length
        np.testing.assert_allclose(model.joint_stiffness[body, 1:], wanted, rtol=1e-3)


def test_ties_hold_canes_at_wires(winter: tuple[scenes.Scene, Model]) -> None:
    scene, model = winter
    assert (model.fixed_organ[model.tie_wire] == Organ.WIRE).all()
    fruiting = np.flatnonzero(model.canes.size[model.canes.year == 2] > 3) if scene.pruning == "cane" else []
    old = model.canes.of_bodies(len(model.body_mass))[model.tie_body]
    tied = np.bincount(old[model.canes.year[old] == 2], minlength=len(model.canes.body))
    assert (tied[np.flatnonzero(model.canes.year == 2)[fruiting]] >= 2).all()
    assert len(fruiting) == (24 if scene.pruning == "cane" else 0)


def test_a_dormant_vineyard_stands_on_a_slope() -> None:
    scene = scenes.load_scene("winter_spur")
    tilted = msgspec.structs.replace(scene, terrain=scenes.TerrainTable(slope=0.1, direction=0.0))
    level, model = generate_uncached(scene), generate_uncached(tilted)
    rise = model.tree_pose[:, 2] - level.tree_pose[:, 2]
    np.testing.assert_allclose(rise, 0.1 * model.tree_pose[:, 0], atol=0.02)
    assert len(model.tie_body) == len(level.tie_body)
    q = model.forward_kinematics(model.joint_settled)
    held = q[model.tie_body, :3] + frames.rotate(q[model.tie_body, 3:], model.tie_point.astype(float))
    np.testing.assert_allclose(held, model.tie_anchor, atol=1e-4)


def test_a_tendone_may_be_dormant() -> None:
    scene = scenes.load_scene("tendone")
    model = generate_uncached(msgspec.structs.replace(scene, date=datetime.date(2026, 1, 15)))
    assert len(model.nodes.body) > 0
    assert len(model.leaf_body) == 0
