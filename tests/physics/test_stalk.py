"""Cuts in peduncles: the place, what the vine and the bunch keep, momentum, the stump, and equal runs."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from tests.support.contact_scenes import bar, bunch_scene
from vinesim.core import frames
from vinesim.interaction.stalk import PLACE_STEP, split, stalk_below
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.world import Physics


def tensor_about(point: np.ndarray, mass: float, com: np.ndarray, tensor: np.ndarray) -> np.ndarray:
    """Inertia [3, 3] about ``point`` of a body with ``tensor`` about its centre of mass."""
    r = com - point
    return tensor + mass * ((r @ r) * np.eye(3) - np.outer(r, r))


@pytest.mark.parametrize("at", [0.0005, 0.013, 0.0395])
def test_the_parts_of_a_segment_add_up_to_it(at):
    length, mass, radius = 0.04, 8e-4, 0.002
    across = mass * (length**2 / 12 + radius**2 / 4)
    com = np.array([0.02, 0.0, 0.0])
    inertia = np.array([0.5 * mass * radius**2, across, across])
    parts = split(length, mass, com, inertia, at)
    assert parts[0].mass == pytest.approx(mass * at / length, rel=1e-12)
    assert sum(part.mass for part in parts) == pytest.approx(mass, rel=1e-12)
    np.testing.assert_allclose(sum(part.mass * part.com for part in parts), mass * com, rtol=1e-12)
    origin = np.zeros(3)
    whole = tensor_about(origin, mass, com, np.diag(inertia))
    together = sum(tensor_about(origin, part.mass, part.com, np.diag(part.inertia)) for part in parts)
    np.testing.assert_allclose(together, whole, rtol=1e-12, atol=1e-20)
    for part in parts:  # each is the rod of its length and radius
        own = part.mass * ((part.end - part.start) ** 2 / 12 + radius**2 / 4)
        np.testing.assert_allclose(part.inertia, [0.5 * part.mass * radius**2, own, own], rtol=1e-9)


def moments(masses, coms, tensors, velocities, spins) -> tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mass, first moment, inertia about the origin, momentum and angular momentum about the origin of some bodies."""
    mass = np.array(masses)
    com = np.array(coms)
    linear = mass[:, None] * np.array(velocities)
    inertia = sum(tensor_about(np.zeros(3), m, c, t) for m, c, t in zip(mass, com, tensors, strict=True))
    angular = sum(np.cross(c, p) + t @ w for c, p, t, w in zip(com, linear, tensors, spins, strict=True))
    return float(mass.sum()), mass @ com, inertia, linear.sum(0), angular


def of_plants(physics: Physics, bodies: list[int], origin: np.ndarray):
    """:func:`moments` of bodies of plants, about ``origin``."""
    plants = physics.plants
    plants.forward_kinematics()
    rows = []
    for body in bodies:
        pose = physics.state.body_q[body].astype(float)
        rate = physics.state.body_qd[body].astype(float)
        axes = frames.to_matrix(frames.normalize(pose[3:]))
        arm = axes @ plants.body_com[body].astype(float)
        yz, zx, xy = plants.body_product[body].astype(float)
        own = np.diag(plants.body_inertia[body].astype(float)) + np.array([[0, xy, zx], [xy, 0, yz], [zx, yz, 0]])
        rows.append(
            (
                float(plants.body_mass[body]),
                pose[:3] - origin + arm,
                axes @ own @ axes.T,
                rate[:3] + np.cross(rate[3:], arm),
                rate[3:],
            )
        )
    return moments(*zip(*rows, strict=True))


def of_free_bunch(physics: Physics, bunch: int, origin: np.ndarray):
    """:func:`moments` of a free bunch in MuJoCo, about ``origin``."""
    world = physics.rigid.mj_model
    data = physics.rigid.mj_data
    mujoco.mj_fwdPosition(world, data)
    mujoco.mj_comVel(world, data)
    body = world.body(f"free_bunch/{physics.rigid._bunch_slot[bunch]}").id
    jacobian = np.zeros((6, world.nv))
    mujoco.mj_jacBodyCom(world, data, jacobian[:3], jacobian[3:], body)
    rate = jacobian @ data.qvel
    axes = data.ximat[body].reshape(3, 3)
    own = axes @ np.diag(world.body_inertia[body]) @ axes.T
    return moments([world.body_mass[body]], [data.xipos[body] - origin], [own], [rate[:3]], [rate[3:]])


def swinging(model: Model, trees: np.ndarray, random: np.random.Generator) -> Physics:
    """A vineyard in which ``trees`` swing."""
    physics = Physics(model)
    physics.plants.wake(trees)
    for tree in trees.tolist():
        here = physics.model.bodies_of(tree)
        core = slice(here.start, here.start + int(model.tree_core[tree]))
        physics.state.joint_qd[core] = random.normal(0.0, 0.5, (core.stop - core.start, 3))
    for _ in range(3):
        physics.step()
    return physics


def random_cut(model: Model, bunch: int, random: np.random.Generator) -> tuple[int, float]:
    """A random segment of a bunch's peduncle, and a place along it."""
    segments = np.flatnonzero((model.bunch_of_body() == bunch) & (model.body_organ == int(Organ.PEDUNCLE)))
    segment = int(random.choice(segments))
    return segment, float(random.uniform(0.0, model.body_length[segment]))


@pytest.mark.parametrize("scene", ["vsp", "demo"])
def test_random_cuts_keep_mass_centre_inertia_and_momentum(scene):
    model = generate(load_scene(scene))
    random = np.random.default_rng(3)
    bunches = random.permutation(len(model.bunch_body))[:100]
    physics = swinging(model, np.unique(model.body_tree[model.bunch_body[bunches]]), random)
    faults = dict(physics.faults)
    for bunch in bunches.tolist():
        segment, at = random_cut(model, bunch, random)
        stalk = stalk_below(model, bunch, segment)
        body = int(model.bunch_body[bunch])
        origin = physics.state.body_q[body, :3].astype(float)
        before = of_plants(physics, [*stalk, body], origin)
        spring = physics.plants.joint_stiffness[segment].copy()
        physics.detachment_monitor.pick(bunch, segment=segment, at=at)
        place = float(physics.state.cut_at[bunch])
        assert abs(place - at) <= 0.5 * PLACE_STEP + 5e-4
        np.testing.assert_array_equal(physics.plants.joint_stiffness[segment], spring)
        parts = of_plants(physics, [segment], origin), of_free_bunch(physics, bunch, origin)
        for name, was, *now in zip(("mass", "centre", "inertia", "momentum", "spin"), before, *parts, strict=True):
            error = np.abs(sum(now) - was).max() / np.abs(was).max()
            assert error < 1e-6, (bunch, name, error)
    for _ in range(20):
        physics.step()
    assert physics.faults == faults
    assert np.isfinite(physics.snapshot().body_q).all()


def cut_by_blade(height: float) -> tuple[Physics, float]:
    """A blade closes ``height`` [m] below the start of the last segment of a peduncle that hangs down; the physics
    after the cut and the height of the blade."""
    model, body, _ = bunch_scene()
    physics = Physics(model)
    stalk = physics.snapshot().body_q[body - 1, :3].astype(float)
    physics.add_robot(bar(stalk + np.array([0.0, -0.5, -0.2])))
    mouth = np.array([0.0, 0.5, 0.2 - height])
    blade = physics.add_blade("bar", "bar", frames.pose(mouth), np.array([0.03, 0.03, 0.002]))
    blade.close()
    physics.step()
    return physics, float(stalk[2] - height)


@pytest.mark.parametrize("height", [-0.03, -0.012, 0.01, 0.027])
def test_a_bunch_is_cut_where_the_blade_is(height):
    physics, at = cut_by_blade(height)
    (detachment,) = physics.detachments
    model = physics.model
    assert detachment.segment == int(model.bunch_body[0]) - (1 if height > 0 else 2)
    pose = physics.snapshot().body_q[detachment.segment].astype(float)
    cut = pose[:3] + frames.rotate(pose[3:], np.array([detachment.at, 0.0, 0.0]))
    assert cut[2] == pytest.approx(at, abs=2e-3)
    # the bunch has the stalk below the cut, and begins at the cut
    free = physics.rigid._free_bunches[0]
    bunch = physics.rigid.bunch_pose(0)
    top = bunch[:3] + frames.rotate(bunch[3:], free.start[-free.stalk.pieces])
    assert top[2] == pytest.approx(at, abs=2e-3)
    assert free.stalk.pieces == (1 if height > 0 else 2)


def test_the_stump_can_be_touched_and_ends_at_the_cut():
    physics, _ = cut_by_blade(0.01)
    model = physics.model
    body = int(model.bunch_body[0]) - 1
    physics.remove_robot("bar")
    physics.rigid.remove_bunch(0)
    physics.update_kinematics()
    pose = physics.state.body_q[body].astype(float)
    monitor = physics.contact_solver

    def found(along: float) -> tuple[float, int] | None:
        point = pose[:3] + frames.rotate(pose[3:], np.array([along, 0.0, 0.0]))
        return monitor.nearest_body(point[None], 0.05)

    assert found(0.005) == (pytest.approx(-0.002, abs=1e-5), body)
    distance, nearest = found(0.03)
    place = float(physics.state.cut_at[0])
    assert (distance, nearest) == (pytest.approx(0.03 - place - 0.002, abs=1e-5), body)


def test_a_cut_is_refused_where_there_is_no_peduncle():
    model, body, _ = bunch_scene()
    physics = Physics(model)
    with pytest.raises(ValueError, match="no segment of the peduncle of bunch 0"):
        physics.detachment_monitor.pick(0, segment=2, at=0.01)
    with pytest.raises(ValueError, match="cut between its ends"):
        physics.detachment_monitor.pick(0, segment=body - 1, at=0.05)


def test_two_runs_with_cuts_are_bitwise_equal():
    def run() -> bytes:
        physics, _ = cut_by_blade(0.013)
        for _ in range(50):
            physics.step()
        return physics.snapshot().body_q.tobytes() + physics.rigid.mj_data.qpos.tobytes()

    assert run() == run()


def test_a_stalk_that_is_known_late_weighs_the_same():
    """As when the motion of a bunch reaches a client before the record that names the cut: before the bunch leaves,
    while it is free, and while it is dormant."""
    masses = []
    for when in ("own", "before", "after", "dormant"):
        model, body, _ = bunch_scene()
        physics = Physics(model)
        segment = body - 2
        pose = physics.snapshot().body_q[body].astype(float)
        if when == "own":
            physics.cut(segment, 0.013)
        if when == "before":
            physics.apply_remote_stalk(0, segment, 0.013)
        if when in ("before", "after"):
            physics.apply_remote_pick(0, pose, np.zeros(6))
        if when == "dormant":
            physics.dormant_bunches.add([0], [""], pose[None])
        if when in ("after", "dormant"):
            physics.apply_remote_stalk(0, segment, 0.013)
        if when == "dormant":
            physics.dormant_bunches.activate([0])
        free = physics.rigid.free_bunch(0)
        masses.append([free.mass, *free.com, *free.inertia, float(physics.plants.body_mass[segment])])
        assert free.stalk is not None
        assert (free.stalk.segment, free.stalk.pieces) == (segment, 2)
        for _ in range(5):
            physics.step()
        assert physics.snapshot().visuals[0].stalk is free.stalk
    np.testing.assert_allclose(masses, np.broadcast_to(masses[0], (4, 8)), rtol=1e-5, atol=1e-7)


def test_a_stalk_that_cannot_be_is_ignored():
    model, body, _ = bunch_scene()
    physics = Physics(model)
    for segment, at in ((0, 0.01), (body, 0.01), (10**6, 0.01), (body - 1, 0.5), (body - 1, 0.0)):
        physics.apply_remote_stalk(0, segment, at)
        assert physics.state.cut_segment[0] == -1
