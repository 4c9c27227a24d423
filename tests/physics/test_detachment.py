"""Detachment of bunches and canes: momentum, in a grasp, the fall, and by pull, bending, blade or command."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from tests.support.clustered_trees import momenta
from tests.support.contact_scenes import DOWN, bar, bunch_scene, cane, grasp, gripper
from vinesim.core import frames
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.ids import Organ
from vinesim.scene.values import Detachment
from vinesim.world import Physics


def momentum(physics: Physics, name: str) -> np.ndarray:
    """Linear momentum [3] of one free body of the rigid world, kg m/s."""
    world = physics.rigid.mj_model
    data = physics.rigid.mj_data
    mujoco.mj_fwdPosition(world, data)
    mujoco.mj_comVel(world, data)
    velocity = np.zeros(6)
    body = data.body(name).id
    mujoco.mj_objectVelocity(world, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
    lever = data.xipos[body] - data.xpos[body]
    return world.body_mass[body] * (velocity[3:] + np.cross(velocity[:3], lever))


def test_a_picked_bunch_keeps_its_momentum_and_falls():
    model, body, _ = bunch_scene()
    physics = Physics(model)
    physics.plants.wake(0)
    physics.state.joint_qd[body] = 0.3, -1.0, 2.0
    physics.state.joint_qd[4] = 0.0, 0.5, 0.3
    for _ in range(7):
        physics.step()
    physics.plants.forward_kinematics()
    pose = physics.state.body_q[body].astype(float)
    velocity = physics.state.body_qd[body].astype(float)
    com = frames.rotate(pose[3:], model.body_com[body].astype(float))
    before = 0.5 * (velocity[:3] + np.cross(velocity[3:], com))
    physics.pick(0)
    np.testing.assert_allclose(momentum(physics, "free_bunch/0"), before, atol=1e-6)
    assert np.linalg.norm(before) > 0.01
    snapshot = physics.snapshot()
    assert not snapshot.bunch_attached[0]
    assert [(link.name, link.organ, link.index) for link in snapshot.visuals] == [("bunch/0", Organ.BUNCH, 0)]
    np.testing.assert_allclose(snapshot.visual_q[0], snapshot.body_q[body], atol=1e-5)
    height = snapshot.visual_q[0, 2]
    for _ in range(300):
        physics.step()
    assert physics.snapshot().visual_q[0, 2] < height - 1.0
    assert physics.snapshot().visual_q[0, 2] > 0.0
    with pytest.raises(ValueError, match="picked already"):
        physics.pick(0)


def test_the_cane_rises_without_its_bunch():
    model, body, _ = bunch_scene()
    physics = Physics(model)
    tip = body - 3
    low = physics.snapshot().body_q[tip, 2]
    physics.pick(0)
    for _ in range(1500):
        physics.step()
    assert physics.snapshot().body_q[tip, 2] > low + 0.05
    assert np.isfinite(physics.snapshot().body_q).all()


CLUSTERS = pytest.mark.parametrize("clusters", [False, True], ids=["plain", "clusters"])


def detached_in_the_grasp(clusters: bool) -> tuple[Physics, np.ndarray, np.ndarray, np.ndarray, float]:
    """Grasp, lift, cut: bunch in the hand and finger forces of each later tick, finger forces and height before."""
    model, _, middle = bunch_scene(clusters=clusters)
    physics = Physics(model)
    physics.add_robot(gripper(middle))
    for tick in range(290):
        physics.rigid.command("grip", grasp(0.01 * tick)[0])
        physics.step()
    squeeze = physics.rigid.joint_measurements("grip")[3][2:].copy()
    start = physics.rigid.link_pose("grip", "hand")[2]
    physics.pick(0)
    samples = []
    for _ in range(200):
        physics.step()
        hand = physics.rigid.link_pose("grip", "hand")[:3]
        samples.append([*(physics.rigid.bunch_pose(0)[:3] - hand), *physics.rigid.joint_measurements("grip")[3][2:]])
    return physics, np.array(samples)[:, :3], np.array(samples)[:, 3:], squeeze, start


@CLUSTERS
def test_a_bunch_cut_in_a_grasp_stays_in_it(clusters):
    physics, place, fingers, squeeze, start = detached_in_the_grasp(clusters)
    assert np.abs(fingers / squeeze - 1.0).max() < 0.015  # in every tick for 2 s
    assert np.abs(place - place[0]).max() < 5e-5
    # the lift now carries the bunch's weight instead of the peduncle
    assert physics.rigid.joint_measurements("grip")[3][1] == pytest.approx(-0.5 * 9.81, rel=0.02)
    assert start == pytest.approx(physics.rigid.link_pose("grip", "hand")[2], abs=3e-3)
    assert not physics.plants.state.bunch_attached[0]


@CLUSTERS
def test_two_runs_are_bitwise_equal(clusters):
    data = [detached_in_the_grasp(clusters)[0].rigid.mj_data for _ in range(2)]
    assert data[0].qpos.tobytes() + data[0].qvel.tobytes() == data[1].qpos.tobytes() + data[1].qvel.tobytes()


def pull_bunch(
    pull: float, bend: float, ticks: int = 400, *, clusters: bool = False
) -> tuple[Physics, tuple[Detachment, ...], np.ndarray]:
    """A gripper closes on a bunch and moves down: the detachments, and the wrenches at both ends of the peduncle, first
    at the bunch, tick by tick."""
    model, _, middle = bunch_scene(clusters=clusters)
    body = int(model.bunch_body[0])
    model.bunch_pull[0] = pull
    model.bunch_bend[0] = bend
    physics = Physics(model)
    physics.add_robot(gripper(middle, effort=80.0))
    wrenches: list[np.ndarray] = []
    for tick in range(ticks):
        target, _ = grasp(0.01 * min(tick, 130))
        target[1] = -0.002 * max(tick - 150, 0)
        if pull > 1e3:  # move sideways instead of down
            target[:2] = 0.002 * max(tick - 150, 0), 0.0
        physics.rigid.command("grip", target)
        physics.step()
        wrenches.append(physics.plants.joint_wrench(np.array([body, body - 2])))
        if physics.detachments:
            break
    return physics, physics.detachments, np.array(wrenches)


@CLUSTERS
def test_a_bunch_detaches_when_the_pull_exceeds_its_limit(clusters):
    physics, detachments, wrenches = pull_bunch(12.0, 1e3, clusters=clusters)
    (detachment,) = detachments
    force = np.linalg.norm(wrenches[:, 0, :3], axis=1)
    assert len(force) > 155
    assert force[-3:-1].min() > 12.0  # above the limit for 30 ms, then detached
    assert force[:150].max() < 12.0
    assert (detachment.bunch, detachment.cause, detachment.actor) == (0, "pull", "grip")
    assert (detachment.tick, detachment.body) == (physics.tick, physics.model.bunch_body[0])
    assert np.linalg.norm(detachment.force) > 12.0
    assert physics.time - 0.01 < detachment.time <= physics.time
    assert detachment.force[2] > 10.0  # the force of the vine, upwards
    assert physics.rigid.free_bunches == (0,)


@pytest.mark.parametrize(("clusters", "limit"), [(False, 0.05), (True, 0.022)], ids=["plain", "clusters"])
def test_a_bunch_detaches_when_the_moment_exceeds_its_limit(clusters, limit):
    """Clusters give way between the hand and the peduncle, which then bears a seventh of the moment. The moment of a
    push across is larger at the shoot's end, where the peduncle breaks."""
    physics, (detachment,), wrenches = pull_bunch(1e4, limit, clusters=clusters)
    assert detachment.segment == physics.model.bunch_body[0] - 2
    moment = np.linalg.norm(wrenches[:, 1, 3:], axis=1)
    assert (moment > np.linalg.norm(wrenches[:, 0, 3:], axis=1))[-3:].all()
    assert (detachment.bunch, detachment.cause, detachment.actor) == (0, "bend", "grip")
    assert np.linalg.norm(detachment.moment) > limit
    assert moment[-3:-1].min() > limit


def test_no_detachment_below_the_limits():
    physics, detachments, _ = pull_bunch(1e5, 1e5, 200)
    assert detachments == ()
    assert physics.rigid.free_bunches == ()


def test_a_commanded_detachment_reports_the_weight_on_the_peduncle():
    model, body, _ = bunch_scene()
    physics = Physics(model)
    physics.pick(0)
    assert physics.detachments == ()
    physics.step()
    (detachment,) = physics.detachments
    assert (detachment.tree, detachment.body, detachment.bunch, detachment.cause, detachment.actor) == (
        0,
        body,
        0,
        "command",
        "",
    )
    np.testing.assert_allclose(detachment.force, [0.0, 0.0, 0.5 * 9.81], atol=1e-4)
    physics.step()
    assert physics.detachments == ()
    with pytest.raises(ValueError, match="bunch 7 does not exist"):
        physics.pick(7)


def test_a_blade_that_closes_on_the_peduncle_detaches_the_bunch():
    model, body, _ = bunch_scene()
    physics = Physics(model)
    stalk = physics.snapshot().body_q[body - 1, :3]
    physics.add_robot(bar(stalk + np.array([0.0, -0.5, -0.2])))
    blade = physics.add_blade("bar", "bar", frames.pose(np.array([0.0, 0.5, 0.18])), np.array([0.03, 0.03, 0.002]))
    physics.step()
    assert physics.detachments == ()
    blade.close()
    physics.step()
    (detachment,) = physics.detachments
    assert (detachment.bunch, detachment.body, detachment.cause, detachment.actor) == (0, body, "blade", "bar")
    assert detachment.force[2] == pytest.approx(0.5 * 9.81, rel=0.05)
    blade.close()  # on the rest of the peduncle: nothing to cut
    physics.step()
    assert physics.detachments == ()
    with pytest.raises(ValueError, match="no link 'hand'"):
        physics.add_blade("bar", "hand", blade.pose, blade.half)
    physics.remove_robot("bar")
    assert physics.detachment_monitor.blades == []


def test_a_blade_beside_the_peduncle_cuts_nothing():
    model, body, _ = bunch_scene()
    physics = Physics(model)
    stalk = physics.snapshot().body_q[body - 1, :3]
    physics.add_robot(bar(stalk + np.array([0.0, -0.5, -0.2])))
    for offset in ([0.05, 0.5, 0.18], [0.0, 0.54, 0.18], [0.0, 0.5, 0.12]):
        blade = physics.add_blade("bar", "bar", frames.pose(np.array(offset)), np.array([0.03, 0.03, 0.002]))
        blade.close()
        physics.step()
        assert physics.detachments == (), offset


def test_a_bunch_dropped_over_a_crate_comes_to_rest_in_it():
    tree = cane((0.0, 0.0, 0.9), bunch=0.5)
    box = {"box_pose": [[1.0, 0.0, 0.001, 0, 0, 0, 1]], "box_size": [[0.6, 0.4, 0.3]], "box_mass": [[2.0]]}
    model = assemble([tree], **box)
    physics = Physics(model)
    for _ in range(20):
        physics.step()
    physics.pick(0)
    for _ in range(400):
        physics.step()
    links = {link.name: pose for link, pose in zip(physics.rigid.visuals(), physics.rigid.visual_q(), strict=True)}
    bunch = links["bunch/0"]
    crate = links["box/0"]
    assert 0.0 < bunch[2] - crate[2] < 0.25
    assert np.abs(bunch[:2] - crate[:2]).max() < 0.3
    assert np.abs(physics.rigid.mj_data.qvel).max() < 0.1


def loaded_cane(clusters: bool = True, side: bool = True) -> TreeBuilder:
    """A cane of 1 m with a bunch half way along, and a side shoot behind it that carries another."""
    tree = TreeBuilder(frames.pose(np.array([0.0, 0.0, 1.6])))
    wood = RodMaterial(5e9, 900.0, 0.01)
    green = RodMaterial(3e8, 1000.0, 0.05)
    main = tree.add_rod(-1, 1.0, (0.006, 0.004), wood, 10)
    for at in (main[4], main[8]) if side else (main[4],):
        stalk = tree.add_rod(at, 0.06, (0.0022, 0.0022), green, 2, organ=Organ.PEDUNCLE, rest=DOWN)
        tree.add_bunch(stalk[-1], 0.5, count=80, seed=3, clusters=clusters)
    tree.solve_rest_pose()
    return tree


@pytest.mark.parametrize("fine", [False, True])
def test_a_cut_cane_falls_with_its_bunch(fine):
    model = assemble([loaded_cane()])
    physics = Physics(model)
    if fine:
        physics.plants.wake(0)
        physics.set_detail_focus(model.forward_kinematics(model.joint_settled)[model.bunch_body, :3], 0.1)
    for _ in range(5):
        physics.step()
    assert physics.state.tree_fine[0] == fine
    beyond_cut = [6, 7, 8, 9, *range(13, 16), *range(int(model.bunch_cluster[1]), len(model.body_mass))]
    moving = beyond_cut if fine else beyond_cut[:7]
    before = physics.snapshot().body_q.copy()
    weight = 9.81 * physics.plants.body_mass[moving].sum()
    physics.cut(6)
    for _ in range(20):
        physics.step()
        if physics.detachments:
            (detachment,) = physics.detachments
    assert (detachment.body, detachment.bunch, detachment.cause) == (6, -1, "command")
    assert detachment.force[2] == pytest.approx(weight, rel=0.01)
    drop = (before - physics.snapshot().body_q)[:, 2]
    assert drop[moving].mean() == pytest.approx(0.5 * 9.81 * 0.2**2, rel=0.1)
    assert drop[:5].max() < 1e-4  # the rest moves up
    assert physics.state.bunch_attached.all()
    with pytest.raises(ValueError, match="cut already"):
        physics.cut(6)
    with pytest.raises(ValueError, match="no piece of wood"):
        physics.cut(int(model.bunch_body[0]))


def test_a_blade_cuts_only_the_piece_next_to_the_root():
    """The blade spans a joint of two pieces: one cut, at the piece next to the root."""
    model = assemble([loaded_cane()])
    physics = Physics(model)
    joint = physics.snapshot().body_q[7, :3]
    physics.add_robot(bar(joint + np.array([0.0, -0.5, -0.2])))
    blade = physics.add_blade("bar", "bar", frames.pose(np.array([0.0, 0.5, 0.2])), np.array([0.03, 0.03, 0.03]))
    blade.close()
    physics.step()
    (detachment,) = physics.detachments
    assert (detachment.body, detachment.bunch, detachment.cause, detachment.actor) == (6, -1, "blade", "bar")
    assert physics.state.body_cut.tolist() == [body == 6 for body in range(len(model.body_mass))]


def test_cutting_a_peduncle_detaches_its_bunch():
    model = assemble([loaded_cane()])
    physics = Physics(model)
    physics.cut(10)
    physics.step()
    (detachment,) = physics.detachments
    assert (detachment.body, detachment.bunch) == (12, 0)
    assert physics.rigid.free_bunches == (0,)


def test_a_picked_fine_bunch_keeps_mass_pose_and_momentum():
    """With swinging clusters: the free bunch has their total mass, centre of mass, pose and momentum."""
    model = assemble([loaded_cane(side=False)])
    physics = Physics(model)
    parts = np.arange(model.bunch_cluster[0], model.bunch_cluster[0] + model.bunch_clusters[0])
    bunch_bodies = np.append(parts, model.bunch_body[0])
    physics.set_detail_focus(model.forward_kinematics(model.joint_settled)[model.bunch_body, :3], 0.2)
    physics.plants.wake(0)
    physics.step()
    physics.state.joint_qd[parts[0], 1] = 2.0
    for _ in range(10):
        physics.step()
    assert physics.state.tree_fine[0]
    q = physics.snapshot().body_q[bunch_bodies].astype(float)
    qd = physics.state.body_qd[bunch_bodies].astype(float)
    com = frames.rotate(q[:, 3:], physics.plants.body_com[bunch_bodies].astype(float))
    mass = physics.plants.body_mass[bunch_bodies].astype(float)
    middle = mass @ (q[:, :3] + com) / mass.sum()
    before = mass @ (qd[:, :3] + np.cross(qd[:, 3:], com))
    physics.pick(0)
    world = physics.rigid.mj_model
    data = physics.rigid.mj_data
    after = momentum(physics, "free_bunch/0")
    body = world.body("free_bunch/0").id
    assert world.body_mass[body] == pytest.approx(0.5, rel=1e-6)
    np.testing.assert_allclose(data.xipos[body], middle, atol=1e-6)
    assert np.linalg.norm(before) > 0.02
    # the clusters stop relative to their head at once, after the peduncle has let go
    np.testing.assert_allclose(after, before, atol=1e-4 * np.linalg.norm(before))
    shapes = physics.rigid.visuals()[0].shapes
    assert len(shapes) == model.bunch_clusters[0]
    for shape, part in zip(shapes, parts, strict=True):
        at = frames.compose(physics.rigid.visual_q()[0], shape.pose)[:3]
        pose = physics.state.body_q[part].astype(float)
        half = np.array([0.5 * model.body_length[part], 0.0, 0.0])
        np.testing.assert_allclose(at, pose[:3] + frames.rotate(pose[3:], half), atol=1e-5)


def test_a_picked_bunch_takes_its_momentum_along_and_nothing_of_its_neighbour():
    """Two bunches of swinging clusters on one shoot; one is cut off. Linear and angular momentum within 1e-4."""
    model = assemble([loaded_cane()])
    physics = Physics(model)
    plants = physics.plants
    state = physics.state
    physics.set_detail_focus(model.forward_kinematics(model.joint_settled)[model.bunch_body, :3], 0.2)
    plants.wake(0)
    physics.step()
    assert state.tree_fine[0]
    bodies = [
        np.append(model.bunch_cluster[i] + np.arange(model.bunch_clusters[i]), model.bunch_body[i]) for i in (0, 1)
    ]
    for own in bodies:
        state.joint_qd[own[0]] = 0.5, 2.0, -1.0
    for _ in range(7):
        physics.step()
    plants.forward_kinematics()
    origin = np.zeros(3)
    linear, angular, _, _ = momenta(plants, bodies[0], origin)
    others = np.setdiff1d(np.arange(len(model.body_mass)), bodies[0])
    rates = state.joint_qd.copy()
    velocities = state.body_qd.copy()
    physics.pick(0)
    assert np.array_equal(state.joint_qd, rates)
    plants.forward_kinematics()
    assert np.array_equal(state.body_qd[others], velocities[others])
    world = physics.rigid.mj_model
    data = physics.rigid.mj_data
    mujoco.mj_fwdPosition(world, data)
    mujoco.mj_comVel(world, data)
    J = np.zeros((6, world.nv))
    body = world.body("free_bunch/0").id
    mujoco.mj_jacBodyCom(world, data, J[:3], J[3:], body)
    velocity = J @ data.qvel
    axes = data.ximat[body].reshape(3, 3)
    after = world.body_mass[body] * velocity[:3]
    spin = axes @ np.diag(world.body_inertia[body]) @ axes.T @ velocity[3:]
    assert np.linalg.norm(linear) > 0.02
    np.testing.assert_allclose(after, linear, atol=1e-4 * np.linalg.norm(linear))
    total = np.cross(data.xipos[body], after) + spin
    np.testing.assert_allclose(total, angular, atol=1e-4 * np.linalg.norm(angular))
    for _ in range(20):
        physics.step()
    assert physics.faults["trees_stopped"] == physics.faults["trees_slowed"] == 0


def test_a_fine_bunch_cut_in_a_grasp_stays_in_it():
    """Like a coarse one: its shapes keep their poses."""
    tree = loaded_cane(side=False)
    model = assemble([tree])
    pose = model.forward_kinematics(model.joint_settled)[model.bunch_body[0]]
    middle = pose[:3] + frames.rotate(pose[3:], np.array([0.5 * model.bunch_length[0], 0.0, 0.0]))
    physics = Physics(model)
    physics.add_robot(gripper(middle))
    for tick in range(290):
        physics.rigid.command("grip", grasp(0.01 * tick)[0])
        physics.step()
    assert physics.state.tree_fine[0]
    squeeze = physics.rigid.joint_measurements("grip")[3][2:].copy()
    physics.pick(0)
    fingers = []
    place = []
    for _ in range(200):
        physics.step()
        fingers.append(physics.rigid.joint_measurements("grip")[3][2:].copy())
        place.append(physics.rigid.bunch_pose(0)[:3] - physics.rigid.link_pose("grip", "hand")[:3])

    assert np.abs(np.array(fingers) / squeeze - 1.0).max() < 0.015
    # between two fingers of equal force it may drift sideways, but it does not sink
    assert np.abs(np.array(place)[:, 2] - place[0][2]).max() < 5e-5
