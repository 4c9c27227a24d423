"""Level of detail of bunches: switched in time, without jumps, and without effect on the branch."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.contact_scenes import DOWN, bar
from vinesim.api import energy
from vinesim.core import frames
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.world import Physics

DETAIL_STEPS = PhysicsParameters().steps(PhysicsParameters().detail_duration)


def loaded_canes(rows: int = 1) -> Model:
    """Level canes of 1 m, 0.6 m apart, each with a bunch of 0.6 kg at three quarters of its length."""
    trees = []
    for row in range(rows):
        tree = TreeBuilder(frames.pose(np.array([0.0, 0.6 * row, 1.8])))
        cane = tree.add_rod(-1, 1.0, (0.006, 0.005), RodMaterial(5e9, 900.0, 0.01), 10)
        stalk = tree.add_rod(
            cane[7], 0.07, (0.0022, 0.0022), RodMaterial(3e8, 1000.0, 0.05), 2, organ=Organ.PEDUNCLE, rest=DOWN
        )
        tree.add_bunch(stalk[-1], 0.6, count=100, seed=4 + row, pull=1e4, bend=1e4)
        tree.solve_rest_pose()
        trees.append(tree)
    return assemble(trees)


def bunch_centre(model: Model, bunch: int = 0) -> np.ndarray:
    pose = model.forward_kinematics(model.joint_settled)[model.bunch_body[bunch]]
    return pose[:3] + frames.rotate(pose[3:], np.array([0.5 * model.bunch_length[bunch], 0.0, 0.0]))


def clusters(model: Model, bunch: int = 0) -> np.ndarray:
    first = int(model.bunch_cluster[bunch])
    return np.arange(first, first + int(model.bunch_clusters[bunch]))


def push(physics: Physics, at: np.ndarray, depth: float = 0.05, hold_ticks: int = 60):
    """A bar moves at walking speed, displaces the bunch by ``depth`` [m], stays, and leaves; yields after each tick."""
    radius = float(physics.model.bunch_radius[0])
    physics.add_robot(bar(at - [0.0, radius + 0.03 + 0.08, 0.0], stiffness=4e3, damping=400.0))
    reach = 0.08 + depth
    for tick in range(2000):
        t = 0.01 * tick
        target = (
            min(0.25 * t, reach)
            if tick < 25 * 4 * reach + hold_ticks + 20
            else reach - 0.5 * (t - 0.01 * hold_ticks) + 4 * reach
        )
        physics.rigid.command("bar", np.array([np.clip(target, -1.5, reach)]))
        physics.step()
        yield tick


def momentum(physics: Physics, bodies: np.ndarray) -> np.ndarray:
    """Linear momentum [3] of bodies from forward kinematics, kg m/s."""
    plants = physics.plants
    state = physics.state
    com = frames.rotate(state.body_q[bodies, 3:].astype(float), plants.body_com[bodies].astype(float))
    velocity = state.body_qd[bodies, :3] + np.cross(state.body_qd[bodies, 3:].astype(float), com)
    return (plants.body_mass[bodies, None] * velocity).sum(0)


def moving(physics: Physics) -> np.ndarray:
    model = physics.model
    size = model.tree_size if physics.state.tree_fine[0] else model.tree_core
    return np.arange(int(size[0]))


def test_switches_of_detail_keep_pose_and_momentum():
    """At both switches poses are bitwise equal; refining changes no momentum by 1e-6, coarsening none by 1e-4 of the
    largest of the motion (what it changes goes through the springs into the foot of the tree); bent joints stay bent.
    """
    model = loaded_canes()
    physics = Physics(model)
    detail = physics.level_of_detail
    switches = []
    refine = physics.plants.refine
    coarsen = physics.plants.coarsen

    def checked(change, trees):
        physics.plants.forward_kinematics(np.array([0]))
        pose = physics.state.body_q.copy()
        before = momentum(physics, moving(physics))
        change(trees)
        physics.plants.forward_kinematics(np.array([0]))
        assert np.array_equal(pose, physics.state.body_q)
        switches.append((physics.tick, change.__name__, momentum(physics, moving(physics)) - before, before))

    physics.plants.refine = lambda trees: checked(refine, trees)
    physics.plants.coarsen = lambda trees: checked(coarsen, trees)
    first_touch = left_at = None
    max_bend = largest = 0.0
    for tick in push(physics, bunch_centre(model)):
        if first_touch is None and any(c.actor == "bar" for c in physics.contacts):
            first_touch = tick
        if first_touch is not None and left_at is None and not len(physics.contact_solver.near_trees):
            left_at = tick
        turn = frames.log(
            frames.multiply(
                frames.conjugate(model.joint_settled[clusters(model)]), physics.state.joint_q[clusters(model)]
            )
        )
        physics.plants.forward_kinematics(np.array([0]))
        largest = max(largest, float(np.linalg.norm(momentum(physics, moving(physics)))))
        max_bend = max(max_bend, float(np.linalg.norm(turn, axis=1).max()))
        if left_at is not None and not physics.state.tree_fine[0]:
            break
    (refined, name, jump, _), (coarsened, other, drop, _) = switches
    assert (name, other) == ("refine", "coarsen")
    assert refined <= first_touch  # never late
    assert coarsened - left_at > DETAIL_STEPS
    assert max_bend > 0.05
    assert np.abs(jump).max() < 1e-6
    assert np.linalg.norm(drop) < 1e-4 * largest
    assert len(detail.fine_trees) == 0


def test_energy_and_momentum_do_not_notice_when_clusters_are_unlocked():
    """While a cane swings with its bunch, unlocking changes energy and momentum by rounding only, each kind by itself.

    Without the springs of locked clusters the elastic energy rose by 8 mJ at once.
    """
    physics = Physics(loaded_canes())
    plants = physics.plants
    plants.state.joint_qd[0] = [0.3, 0.8, -0.5]
    plants.wake(0)
    for _ in range(30):
        plants.predict()
        plants.integrate()
    plants.forward_kinematics()
    kinds = ("kinetic", "elastic", "gravitational")
    before = energy.energy(plants, 9.81)
    pushed = energy.momentum(plants)
    plants.refine(0)
    plants.forward_kinematics()
    after = energy.energy(plants, 9.81)
    assert before.kinetic > 1e-3
    springs = plants.joint_stiffness[clusters(physics.model)] * frames.log(
        physics.state.joint_q[clusters(physics.model)].astype(float)
    )
    assert np.abs(springs).max() > 1e-4  # the springs of the clusters are bent
    for kind in kinds:
        assert getattr(after, kind) == pytest.approx(getattr(before, kind), abs=1e-6 * before.gravitational)
    np.testing.assert_allclose(energy.momentum(plants).linear, pushed.linear, atol=1e-6)
    np.testing.assert_allclose(energy.momentum(plants).angular, pushed.angular, atol=1e-6)


def test_the_level_of_detail_does_not_change_the_branch():
    """A cane kicked by a centimetre has the same motion within a millimetre, coarse or fine for a second."""
    model = loaded_canes()
    paths = []
    for is_fine in (False, True):
        physics = Physics(model)
        if is_fine:
            physics.set_detail_focus(bunch_centre(model)[None], 0.3)
        physics.plants.wake(0)
        physics.state.joint_qd[0] = 0.0, 0.05, 0.05
        at = []
        fine = 0
        for tick in range(400):
            if tick == 100:
                physics.set_detail_focus(np.zeros((0, 3)), 0.0)
            physics.step()
            at.append(physics.snapshot().body_q[9, :3])
            fine += int(physics.state.tree_fine[0])
        assert (fine > 100) == is_fine
        paths.append(np.array(at))
    moved = np.abs(paths[0] - model.forward_kinematics(model.joint_settled)[9, :3]).max()
    assert moved > 5e-3
    assert np.abs(paths[0] - paths[1]).max() < 1e-3


def test_moving_trees_in_the_detail_focus_are_refined():
    model = loaded_canes(3)
    physics = Physics(model)
    physics.set_detail_focus(bunch_centre(model, 1)[None], 0.2)
    physics.step()
    assert len(physics.level_of_detail.fine_trees) == 0  # asleep trees are not refined
    physics.plants.wake(np.arange(3))
    for _ in range(3):
        physics.step()
    assert physics.level_of_detail.fine_trees.tolist() == [1]
    physics.set_detail_focus(np.zeros((0, 3)), 0.0)
    for _ in range(DETAIL_STEPS + 40):
        physics.step()
    assert len(physics.level_of_detail.fine_trees) == 0


def test_a_tree_stays_fine_while_an_actor_is_near_and_until_its_bunch_is_picked():
    model = loaded_canes()
    physics = Physics(model)
    at = bunch_centre(model)
    physics.add_robot(bar(at - [0.0, 0.025 + model.bunch_radius[0], 0.0], stiffness=4e3, damping=400.0))
    for _ in range(3 * DETAIL_STEPS):
        physics.step()
    assert physics.state.tree_fine[0]
    physics.pick(0)
    for _ in range(2 * DETAIL_STEPS):
        physics.step()
    assert not physics.state.tree_fine[0]


def test_berries_keep_their_identity():
    model = loaded_canes()
    physics = Physics(model)
    primitives = Primitives(model, grass=0.0)
    labels = primitives.label.copy()
    kinds = primitives.shapes.kind.numpy().copy()
    radii = primitives.shapes.a.numpy()[kinds == 1, 3].copy()
    start = primitives.shapes.a.numpy()[kinds == 1, :3].copy()
    for tick in push(physics, bunch_centre(model)):
        if tick % 50 == 0:
            primitives.update(physics.snapshot(), np.array([0]))
            berries = primitives.shapes.a.numpy()[: len(kinds)][kinds == 1]
            assert len(berries) == model.bunch_berries[0]
            assert np.array_equal(berries[:, 3], radii)
        if tick > 300 and not physics.state.tree_fine[0]:
            break
    assert np.array_equal(primitives.label[: len(labels)], labels)
    # at the rest pose, but for the bunch's swing, 4.8 cm at that time, and bending of the clusters
    assert np.abs(primitives.shapes.a.numpy()[: len(kinds)][kinds == 1, :3] - start).max() < 0.07


def test_two_runs_are_bitwise_equal():
    ends = []
    for _ in range(2):
        physics = Physics(loaded_canes())
        for tick in push(physics, bunch_centre(physics.model)):
            if tick == 400:
                break
        state = physics.state
        ends.append(state.joint_q.tobytes() + state.joint_qd.tobytes() + state.tree_fine.tobytes())
    assert ends[0] == ends[1]


@pytest.mark.parametrize("bunches", [0, 2])
def test_trees_without_clusters_stay_coarse(bunches):
    trees = []
    for row in range(2):
        tree = TreeBuilder(frames.pose(np.array([0.0, 0.6 * row, 1.8])))
        cane = tree.add_rod(-1, 1.0, (0.006, 0.005), RodMaterial(5e9, 900.0, 0.01), 4)
        if row < bunches:
            stalk = tree.add_rod(
                cane[2], 0.05, (0.002, 0.002), RodMaterial(3e8, 1000.0, 0.05), 1, organ=Organ.PEDUNCLE, rest=DOWN
            )
            tree.add_bunch(stalk[-1], 0.4, clusters=False)
        tree.solve_rest_pose()
        trees.append(tree)
    physics = Physics(assemble(trees))
    physics.plants.wake(np.arange(2))
    physics.set_detail_focus(np.zeros((1, 3)), 10.0)
    for _ in range(5):
        physics.step()
    assert not physics.state.tree_fine.any()
