"""Ten free bunches in a crate and on the ground: rest, weight, and Coulomb friction."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from tests.support.contact_scenes import cane
from tests.support.long_rows import long
from vinesim.core import frames
from vinesim.scene.builder import GRAVITY, assemble
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.world import Physics

pytestmark = pytest.mark.slow

MASSES = 0.4 + 0.03 * np.arange(10)
CRATE = 2.0


def drop_bunches(into_crate: bool, clusters: bool = False) -> Physics:
    """Ten bunches dropped one after the other in random orientations: into the crate, or from 15 cm above ground."""
    trees = [cane((1.5 * i, 20.0, 1.0), bunch=float(mass), clusters=clusters) for i, mass in enumerate(MASSES)]
    box = {"box_pose": [[0.0, 0.0, 0.001, 0, 0, 0, 1]], "box_size": [[0.6, 0.4, 0.3]], "box_mass": [[CRATE]]}
    physics = Physics(assemble(trees, **box))
    rng = np.random.default_rng(0)
    for bunch in range(10):
        tree = np.array([bunch])
        physics.plants.wake(tree)
        physics.plants.refine(tree)  # as where a robot picks
        physics.pick(bunch)
        at = [rng.uniform(-0.15, 0.15), rng.uniform(-0.08, 0.08), 0.4]
        if not into_crate:
            at = [2.0 + 0.3 * (bunch % 4), 0.3 * (bunch // 4), 0.15]
        turn = frames.normalize(rng.normal(size=4))
        pose = frames.pose(np.array(at), turn)
        pose[:3] -= frames.rotate(turn, np.array([0.085, 0.0, 0.0]))
        physics.rigid.place_bunch(bunch, pose, np.zeros(6))
        for _ in range(40):
            physics.step()
    return physics


def on_the_ground(physics: Physics) -> tuple[float, float]:
    """Vertical force of all contacts with the ground [N], and the deepest penetration of any contact [m]."""
    world = physics.rigid.mj_model
    data = physics.rigid.mj_data
    force = 0.0
    wrench = np.zeros(6)
    deepest = 0.0
    for c in range(data.ncon):
        contact = data.contact[c]
        deepest = min(deepest, float(contact.dist))
        mujoco.mj_contactForce(world, data, c, wrench)
        if "ground" in (world.geom(g).name for g in contact.geom):
            force += abs(float((contact.frame.reshape(3, 3).T @ wrench[:3])[2]))
    return force, deepest


def watch_awake(physics: Physics, ticks: int = 100) -> tuple[float, float]:
    """Step without sleep for a second: mean force on the ground [N] and deepest penetration [m]."""
    physics.rigid.mj_model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    samples = []
    for _ in range(ticks):
        physics.step()
        samples.append(on_the_ground(physics))
    force, penetration = np.array(samples[ticks // 2 :]).T
    return float(force.mean()), float(penetration.min())


def settle(physics: Physics, ticks: int = 300) -> None:
    for _ in range(ticks):
        physics.step()
    asleep = physics.rigid.mj_data.tree_asleep
    assert (asleep >= 0).all()  # every bunch, and the crate


@pytest.mark.parametrize("clusters", [False, True], ids=["plain", "clusters"])
def test_ten_bunches_rest_in_the_crate_with_their_weight(clusters):
    physics = drop_bunches(into_crate=True, clusters=clusters)
    settle(physics)
    crate = physics.rigid.mj_data.joint("box/0").qpos
    for bunch in range(10):
        pose = physics.rigid.bunch_pose(bunch)
        middle = pose[:3] + frames.rotate(pose[3:], np.array([0.085, 0.0, 0.0]))
        local = frames.rotate(frames.conjugate(frames.from_wxyz(crate[3:])), middle - crate[:3])
        assert np.abs(local[0]) < 0.3
        assert np.abs(local[1]) < 0.2
        assert 0.01 < local[2] < 0.3
    force, deepest = watch_awake(physics)
    # parked bodies fall once sleep is disabled, without contacts
    assert force == pytest.approx(-GRAVITY[2] * (MASSES.sum() + CRATE), rel=0.01)
    assert deepest > -0.002


def test_ten_bunches_come_to_rest_on_the_ground():
    physics = drop_bunches(into_crate=False)
    settle(physics)
    poses = np.array([physics.rigid.bunch_pose(bunch) for bunch in range(10)])
    assert poses[:, 2].min() > 0.0
    assert np.abs(poses[:, :2] - [2.45, 0.3]).max() < 1.2
    force, deepest = watch_awake(physics)
    assert force == pytest.approx(-GRAVITY[2] * (MASSES.sum() + CRATE), rel=0.01)
    assert deepest > -0.002
    after = np.array([physics.rigid.bunch_pose(bunch) for bunch in range(10)])
    assert np.abs(after[:, :3] - poses[:, :3]).max() < 1e-3


@pytest.mark.parametrize(("fraction", "moves"), [(0.95, False), (1.05, True)])
def test_a_full_crate_slides_at_mu_m_g(fraction, moves):
    """F34: the force that starts a loaded crate is the friction coefficient times its total weight."""
    physics = drop_bunches(into_crate=True)
    settle(physics)
    box = physics.rigid.mj_model.body("box/0").id
    data = physics.rigid.mj_data
    start = data.joint("box/0").qpos[:3].copy()
    data.xfrc_applied[box, 0] = -fraction * PhysicsParameters().friction * GRAVITY[2] * (MASSES.sum() + CRATE)
    # at the height of the ground, so that it does not tip the crate
    data.xfrc_applied[box, 4] = -data.xfrc_applied[box, 0] * (data.xipos[box, 2])
    for _ in range(100):
        physics.step()
    displacement = data.joint("box/0").qpos[0] - start[0]
    assert displacement > 0.1 if moves else abs(displacement) < 2e-3


@pytest.mark.parametrize("seed", [0, *long(1, 2, 3)])
def test_contacts_add_no_speed(seed):
    """Six bunches fall together from 0.6 m to 1.85 m into a crate: contacts add no speed."""
    trees = [cane((0.0, 5.0 + i, 2.0), bunch=0.4) for i in range(6)]
    box = {"box_pose": [[0.0, 0.0, 0.001, 0, 0, 0, 1]], "box_size": [[0.6, 0.4, 0.3]], "box_mass": [[CRATE]]}
    physics = Physics(assemble(trees, **box))
    rigid = physics.rigid
    rng = np.random.default_rng(seed)
    for bunch in range(6):
        physics.pick(bunch)
        at = np.array([rng.uniform(-0.15, 0.15), rng.uniform(-0.05, 0.05), 0.6 + 0.25 * bunch])
        rigid.place_bunch(bunch, frames.pose(at, frames.normalize(rng.normal(size=4))), np.zeros(6))
    fastest = 0.0
    for _ in range(250):
        physics.step()
        speeds = [
            np.linalg.norm(rigid.mj_data.joint(f"free_bunch/{slot}").qvel[:3]) for slot in rigid._bunch_slot.values()
        ]
        fastest = max(fastest, *speeds)
    fall = np.sqrt(2.0 * 9.81 * 1.85)
    assert 0.8 * fall < fastest < 1.25 * fall
    # none is pushed through the bottom, which would lift the crate
    assert rigid.mj_data.joint("box/0").qpos[2] == pytest.approx(0.0, abs=2e-3)


@pytest.mark.long
def test_two_runs_are_bitwise_equal():
    ends = []
    for _ in range(2):
        physics = drop_bunches(into_crate=True)
        ends.append(physics.rigid.mj_data.qpos.tobytes() + physics.rigid.mj_data.qvel.tobytes())
    assert ends[0] == ends[1]
