"""Touching: closest points, waking, the same tick, books that balance, room that runs out in words."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import warp as wp
from touch_scenes import bar, bunch_scene, cane, grasp, gripper

from vinesim import frames
from vinesim.kernels import contact
from vinesim.physics import touching as touching_module
from vinesim.physics.rigid import Rigid
from vinesim.physics.step import Physics
from vinesim.physics.touching import Touching, shapes_of
from vinesim.world.grow import assemble
from vinesim.world.ids import Organ

KINDS = {
    "sphere": (2, (0.05, 0.0, 0.0)),
    "capsule": (3, (0.04, 0.1, 0.0)),
    "ellipsoid": (4, (0.05, 0.08, 0.1)),
    "cylinder": (5, (0.06, 0.09, 0.0)),
    "box": (6, (0.05, 0.07, 0.1)),
}


@wp.kernel
def _closest(
    # in
    kind: int,
    size: wp.vec3d,
    start: wp.array(dtype=wp.vec3d),
    end: wp.array(dtype=wp.vec3d),
    # out
    found_out: wp.array(dtype=wp.vec4d),
):
    """Normal and distance where one segment is closest to a primitive."""
    i = wp.tid()
    t = contact.closest(kind, size, start[i], end[i])
    found_out[i] = contact.distance(kind, size, start[i] + t * (end[i] - start[i]))


def closest(kind: str, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    number, size = KINDS[kind]
    found = wp.zeros(len(start), dtype=wp.vec4d, device="cpu")
    ends = [wp.array(x, dtype=wp.vec3d, device="cpu") for x in (start, end)]
    wp.launch(_closest, len(start), inputs=[number, wp.vec3d(*size), *ends], outputs=[found], device="cpu")
    return found.numpy()


@pytest.mark.parametrize("kind", ["sphere", "capsule", "cylinder"])
@pytest.mark.parametrize("length", [0.0, 0.3])
def test_distance_of_segments_is_mujocos(kind, length):
    rng = np.random.default_rng(5)
    number, size = KINDS[kind]
    spec = mujoco.MjSpec()
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONTACT
    spec.worldbody.add_geom(type=mujoco.mjtGeom(number), size=size)
    body = spec.worldbody.add_body(mocap=True)
    thin = 0.001
    kind_of = mujoco.mjtGeom.mjGEOM_CAPSULE if length else mujoco.mjtGeom.mjGEOM_SPHERE
    body.add_geom(type=kind_of, size=[thin, length / 2, 0])
    world = spec.compile()
    data = mujoco.MjData(world)
    middle = rng.normal(size=(200, 3)) * 0.15
    turn = frames.normalize(rng.normal(size=(200, 4)))
    turn[:20] = frames.IDENTITY  # parallel to axes and faces
    axis = frames.rotate(turn, np.array([0.0, 0.0, length / 2]))
    mine = closest(kind, middle - axis, middle + axis)
    compared = 0
    for i in range(len(middle)):
        data.mocap_pos[0], data.mocap_quat[0] = middle[i], frames.to_wxyz(turn[i])
        mujoco.mj_forward(world, data)
        gap = mujoco.mj_geomDistance(world, data, 0, 1, 10.0, None)
        if gap > 0.0:
            assert mine[i, 3] - thin == pytest.approx(gap, abs=2e-6)
            compared += 1
    assert compared > 80
    np.testing.assert_allclose(np.linalg.norm(mine[:, :3], axis=1), 1.0, atol=1e-12)


def test_distance_of_segments_and_a_box_is_that_of_the_closest_of_many_points():
    """Not MuJoCo here: its distance from a box to a capsule that pierces it comes out positive."""
    rng = np.random.default_rng(5)
    size = np.array(KINDS["box"][1])
    middle, turn = rng.normal(size=(200, 3)) * 0.15, frames.normalize(rng.normal(size=(200, 4)))
    axis = frames.rotate(turn, np.array([0.0, 0.0, 0.15]))
    points = middle[:, None] + np.linspace(-1.0, 1.0, 2001)[:, None] * axis[:, None]
    beyond = np.abs(points) - size
    outside, inside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1), beyond.max(-1)
    truth = np.where(inside < 0.0, inside, outside).min(1)
    mine = closest("box", middle - axis, middle + axis)[:, 3]
    assert (truth < 0.0).sum() > 20
    assert (mine <= truth + 1e-9).all()
    np.testing.assert_allclose(mine, truth, atol=1.5e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_distance_grows_along_its_normal_and_is_negative_inside(kind):
    rng = np.random.default_rng(2)
    points = rng.normal(size=(400, 3)) * 0.1
    found = closest(kind, points, points)
    step = 1e-5
    moved = closest(kind, points + step * found[:, :3], points + step * found[:, :3])
    smooth = (np.abs(found[:, 3]) < 0.01) if kind == "ellipsoid" else np.full(len(points), True)
    np.testing.assert_allclose(
        (moved[:, 3] - found[:, 3])[smooth] / step, 1.0, atol=0.1 if kind == "ellipsoid" else 1e-4
    )
    size = np.array(KINDS[kind][1])
    if kind in ("box", "ellipsoid"):
        inside = (np.abs(points) < size).all(1) if kind == "box" else ((points / size) ** 2).sum(1) < 1.0
        assert ((found[:, 3] < 0.0) == inside).all()


def test_segment_along_a_face_touches_in_its_middle():
    start, end = np.array([[0.06, 0.0, -0.04]]), np.array([[0.06, 0.0, 0.04]])

    assert closest("box", start, end)[0] == pytest.approx([1.0, 0.0, 0.0, 0.01])


def test_spheres_of_a_bunch_fill_its_spheroid_and_no_more():
    model, body, _ = bunch_scene()
    shapes = shapes_of(model)
    of = (shapes.bunch == 0) & (model.body_organ[shapes.body] == Organ.BUNCH)
    assert (shapes.body[of] == body).all()
    assert (np.diff(shapes.body) >= 0).all()
    x, r = shapes.start[of, 0], shapes.radius[of]
    assert (x - r).min() == pytest.approx(0.0, abs=1e-6)
    assert (x + r).max() == pytest.approx(0.17, abs=1e-6)
    assert r.max() == pytest.approx(0.045)
    angle = np.linspace(0, np.pi, 181)
    for center, radius in zip(x, r, strict=True):
        along, across = (center - 0.085 + radius * np.cos(angle)) / 0.085, radius * np.sin(angle) / 0.045
        assert (along**2 + across**2).max() < 1.0 + 1e-5


def rows_of_canes(count: int = 40):
    return assemble([cane((2.0 * (i % 8), 1.0 * (i // 8), 1.0), radius=0.005) for i in range(count)])


def test_only_what_is_reached_wakes_and_it_moves_in_the_same_tick():
    model = rows_of_canes()
    physics = Physics(model)
    physics.step()
    assert len(physics.plants.awake) == 0
    physics.add_robot(bar((0.7, -0.06, 0.95)))
    drive = physics.rigid._robots["bar"].v
    physics.rigid.data.qvel[drive] = 3.0
    before = physics.state.joint_q.copy()
    reached = None
    for _ in range(3):
        physics.step()
        if physics.contacts:
            reached = physics.tick
            break
    assert reached is not None
    assert physics.plants.awake.tolist() == [0]
    assert physics.touched == ((0, "bar"),)
    moved = np.abs(physics.state.joint_q - before).max(1) > 0
    assert moved[: model.tree_size[0]].any()
    assert not moved[model.tree_size[0] :].any()
    deepest = min(c.distance for c in physics.contacts)
    assert deepest > 0.0  # seen before it was there: nothing was late
    _, _, _, contact_effort = physics.rigid.read("bar")
    assert contact_effort[0] == pytest.approx(sum(c.force[1] for c in physics.contacts), rel=1e-6)


def test_fast_bar_wakes_every_cane_before_it_overlaps_one():
    physics = Physics(assemble([cane((0.0, 0.3 * i, 1.0), radius=0.005) for i in range(6)]))
    physics.add_robot(bar((0.7, -0.2, 0.95), damping=2000.0))
    physics.rigid.data.qvel[physics.rigid._robots["bar"].v] = 5.0
    physics.rigid.command("bar", np.zeros(1), np.array([5.0]))
    first = {}
    for _ in range(40):
        asleep = set(range(6)) - set(physics.plants.awake.tolist())
        physics.step()
        for c in physics.contacts:
            tree = int(physics.model.body_tree[c.body])
            if tree not in first:
                first[tree] = (c.distance, tree in asleep)
    assert set(first) == set(range(6))
    assert min(gap for gap, _ in first.values()) > -1e-3


def test_a_box_that_lies_wakes_nobody_but_one_that_is_pushed_does():
    tree = cane((0.0, 0.0, 0.12), radius=0.005)
    box = {"box_pose": [[0.5, -0.22, 0.001, 0, 0, 0, 1]], "box_size": [[0.6, 0.4, 0.3]], "box_mass": [[2.0]]}
    physics = Physics(assemble([tree], **box))
    for _ in range(50):
        physics.step()
    physics.plants.rest(physics.plants.awake)
    for _ in range(20):
        physics.step()
    assert len(physics.plants.awake) == 0
    physics.rigid.data.joint("box/0").qvel[1] = 1.0
    touched = set()
    for _ in range(30):
        physics.step()
        touched.update(physics.touched)
    assert touched == {(0, "box/0")}


def test_room_that_runs_out_is_told_in_words_and_the_deepest_stay():
    model, _, middle = bunch_scene()
    physics = Physics(model)
    physics.touching = Touching(model, physics.plants, physics.rigid, capacity=2)
    physics.add_robot(gripper(middle))
    stages = (physics.rigid.prep, physics.touching.find, physics.plants.free, physics.touching.solve)
    for tick in range(250):
        physics.rigid.command("grip", grasp(0.01 * tick)[0])
        for stage in stages:
            stage()
        physics._commit()
        physics._finish()
        assert physics.touching.count <= 2
    assert physics.touching.dropped > 0
    assert "left out" in physics.touching.complaint
    assert "capacity" in physics.touching.complaint
    assert len(physics.contacts) == 2


def test_nothing_touches_a_bunch_that_was_picked():
    model, _, middle = bunch_scene()
    physics = Physics(model)
    physics.add_robot(gripper(middle))
    physics.state.bunch_attached[0] = False
    for tick in range(120):
        physics.rigid.command("grip", grasp(0.01 * tick)[0])
        physics.step()
    assert physics.touching.count == 0


def test_a_robot_that_joins_does_not_shake_a_grasp():
    model, body, middle = bunch_scene()
    runs = []
    for join in (False, True):
        physics = Physics(model)
        physics.add_robot(gripper(middle))
        for tick in range(300):
            physics.rigid.command("grip", grasp(0.01 * tick)[0])
            if join and tick == 200:
                physics.add_robot(bar((0.0, 5.0, 0.5)))
            if join and tick == 250:
                physics.remove_robot("bar")
            physics.step()
        runs.append(physics.view().body_q[body])
    np.testing.assert_allclose(runs[0], runs[1], atol=1e-6)


def test_islands_give_what_one_block_gives(monkeypatch):
    model = assemble([cane((0.0, 0.0, 1.0), radius=0.005), cane((0.0, 3.0, 1.0), radius=0.005)])
    runs = []
    for limit in (24, 0):
        monkeypatch.setattr(touching_module, "ISLANDS", limit)
        physics = Physics(model)
        for i in range(2):
            physics.add_robot(bar((0.7, 3.0 * i - 0.06, 0.95), f"bar{i}", damping=300.0))
        islands = 0
        for _ in range(60):
            for i in range(2):
                physics.rigid.command(f"bar{i}", np.zeros(1), np.array([0.5]))
            physics.step()
            islands = max(islands, physics.touching._part(physics.touching.count))
        runs.append((islands, physics.state.joint_q.copy()))
    assert [islands for islands, _ in runs] == [1, 2]
    np.testing.assert_allclose(runs[0][1], runs[1][1], atol=1e-5)


def test_contacts_come_sorted_and_name_who_touches_what():
    model, body, middle = bunch_scene()
    physics = Physics(model)
    physics.add_robot(gripper(middle, "grip"))
    for tick in range(250):
        physics.rigid.command("grip", grasp(0.01 * tick)[0])
        physics.step()
    contacts = physics.contacts
    assert {c.link for c in contacts} == {"left", "right"}
    assert all(c.actor == "grip" and c.body == body for c in contacts)
    assert [c.body for c in contacts] == sorted(c.body for c in contacts)
    left = next(c for c in contacts if c.link == "left")
    assert left.force[1] > 10.0  # the bunch pushes the left finger out
    assert left.distance < 0.0
    assert left.position[1] > middle[1]


def test_views_own_what_they_show_and_share_it_while_all_sleep():
    model, _, middle = bunch_scene()
    physics = Physics(model)
    physics.step()
    first = physics.view()
    physics.step()
    assert physics.view().body_q is first.body_q
    physics.plants.wake(0)
    physics.state.joint_qd[5, 1] = 1.0
    physics.step()
    second = physics.view()
    kept = second.body_q.copy()
    assert second.moved.tolist() == [0]
    assert (second.body_q != first.body_q).any()
    np.testing.assert_allclose(second.body_q, model.forward(physics.state.joint_q), atol=1e-5)
    physics.step()
    physics.view()
    assert (second.body_q == kept).all()
    physics.add_robot(gripper(middle))
    assert len(physics.view().links) == len(physics.view().link_q) == 2
    assert physics.view().links is physics.view().links


def test_rigid_groups_join_what_a_constraint_couples():
    rigid = Rigid(rows_of_canes(1))
    rigid.add_robot(bar((0.0, 0.0, 0.5), "a"))
    rigid.add_robot(bar((0.0, 0.055, 0.5), "b"))
    rigid.prep()
    a, b = (int(rigid.group[g]) for g in rigid.geoms.id)
    assert rigid.data.ncon > 0
    assert a == b


def test_a_tick_is_a_list_of_stages_and_the_vineyard_falls_asleep_again():
    physics = Physics(rows_of_canes(3))
    assert [name.split(":")[0] for name, _ in physics.stages] == [
        "rigid", "touching", "detail", "plants", "touching", "plants", "rigid", "guard", "parting", "sleep",
    ]  # fmt: skip
    physics.plants.wake(1)
    physics.state.joint_qd[physics.model.bodies_of(1).start, 1] = 0.5
    for _ in range(3000):
        physics.step()
        if len(physics.plants.awake) == 0:
            break
    assert len(physics.plants.awake) == 0
    assert physics.time == pytest.approx(0.01 * physics.tick)


def test_a_tree_that_a_robot_reaches_into_stays_awake():
    physics = Physics(rows_of_canes(3))
    physics.add_robot(bar((0.7, -0.034, 0.95), stiffness=1000.0, damping=100.0))
    for _ in range(400):
        physics.step()
    assert physics.touching.near.tolist() == [0]
    assert physics.plants.awake.tolist() == [0]


def test_a_copy_touches_only_trees_of_which_its_owner_tells():
    physics = Physics(rows_of_canes())
    reached = int(physics.model.tree_first[20])
    at = physics.state.body_q[reached + 5, :3].copy()
    physics.add_robot(bar(at, "ghost"))
    physics.touching.copies.add("ghost")
    asleep = physics.state.joint_q.copy()
    for _ in range(5):
        physics.step()
    assert physics.contacts == ()
    assert len(physics.plants.awake) == 0
    assert np.array_equal(physics.state.joint_q, asleep)

    physics.touching.told[20] = True
    physics.step()
    assert {tree for tree, _ in physics.touched} == {20}
