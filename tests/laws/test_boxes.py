"""Boxes: stacking, friction, carrying with contents; and momentum of pairs that collide in the air."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from tests.support.contact_scenes import cane
from tests.support.long_rows import each_once
from vinesim.core import frames
from vinesim.scene.builder import GRAVITY, assemble
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.values import Drive, RobotSpec
from vinesim.world import Physics

pytestmark = pytest.mark.slow

WEIGHT = -GRAVITY[2]
SIZE = (0.6, 0.4, 0.3)
MASSES = (2.0, 3.0, 1.5, 2.5)
INERTIA = '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'


def robot(
    name: str, at: list[float], axis: str, size: str, mass: float, drive: tuple[float, float, float]
) -> RobotSpec:
    """A box of ``size`` on one slider; ``drive``: stiffness, damping, effort."""
    urdf = f"""<robot name="tool"><link name="base_footprint"><inertial><mass value="500"/>{INERTIA}</inertial></link>
<link name="tool"><inertial><mass value="{mass}"/>{INERTIA}</inertial>
<collision><geometry><box size="{size}"/></geometry></collision></link>
<joint name="slide" type="prismatic"><parent link="base_footprint"/><child link="tool"/><axis xyz="{axis}"/>
<limit lower="-9" upper="9" effort="1000" velocity="5"/></joint></robot>"""
    drives = (Drive("slide", *drive, 5.0, -9.0, 9.0),)
    return RobotSpec(name, 0, urdf, "base_footprint", frames.pose(at), drives, np.zeros(1), (1e5, 1e5))


def stack(count: int) -> Physics:
    """A stack of boxes, each rotated a little."""
    at = [frames.pose([0.0, 0.0, 0.3 * i], frames.from_yaw(0.01 * (-1) ** i)) for i in range(count)]
    return Physics(assemble([cane((0.0, 50.0, 2.0))], box_pose=at, box_size=[SIZE] * count, box_mass=MASSES[:count]))


def poses(physics: Physics) -> np.ndarray:
    return np.array([physics.rigid.mj_data.joint(f"box/{i}").qpos for i in range(len(physics.model.box_mass))])


def test_four_stacked_boxes_stand_and_sleep():
    physics = stack(4)
    for _ in range(100):
        physics.step()
    settled = poses(physics)
    for _ in range(400):
        physics.step()
    moved = poses(physics)
    assert np.abs(moved[:, :3] - settled[:, :3]).max() < 1e-4
    np.testing.assert_allclose(moved[:, 2], 0.3 * np.arange(4), atol=2e-3)
    tilt = 2.0 * np.linalg.norm(moved[:, 4:6], axis=1)
    assert tilt.max() < 2e-3
    trees = physics.rigid.mj_model.body_treeid[[physics.rigid.mj_model.body(f"box/{i}").id for i in range(4)]]
    assert (physics.rigid.mj_data.tree_asleep[trees] >= 0).all()


@pytest.mark.parametrize("fraction", [0.95, 1.05])
@pytest.mark.parametrize("which", [0, 1])
def test_a_box_starts_to_slide_at_mu_times_its_load(which, fraction):
    """F34: the upper of two boxes slides at mu m g of its own mass, the lower one of both masses."""
    physics = stack(2)
    for _ in range(150):
        physics.step()
    start = poses(physics)
    data = physics.rigid.mj_data
    body = physics.rigid.mj_model.body(f"box/{which}").id
    force = fraction * PhysicsParameters().friction * WEIGHT * sum(MASSES[which:2])
    data.xfrc_applied[body, 0] = force
    data.xfrc_applied[body, 4] = -force * (
        data.xipos[body, 2] - start[which, 2]
    )  # applied at its bottom, so that it does not tip
    for _ in range(60):
        physics.step()
    displacement = poses(physics)[:, 0] - start[:, 0]
    if fraction < 1.0:
        assert np.abs(displacement).max() < 3e-3
    else:
        assert displacement[which] > 0.03
    if which == 1:
        assert abs(displacement[0]) < 3e-3, "the lower box moved"


@pytest.mark.parametrize("clusters", [False, True], ids=["plain", "clusters"])
def test_a_box_of_bunches_is_lifted_moved_and_set_down(clusters):
    """A fork lifts the box by 40 cm and moves it by 1 m; its drive carries the weight of box and bunches."""
    masses = [0.4, 0.5, 0.6]
    trees = [cane((0.0, 9.0 + i, 2.0), bunch=mass, clusters=clusters) for i, mass in enumerate(masses)]
    physics = Physics(
        assemble(trees, box_pose=[[0.0, 0.0, 0.06, 0, 0, 0, 1]], box_size=[SIZE], box_mass=[2.0]), detachment=False
    )
    fork = robot("fork", [0.0, 0.0, 0.03], "0 0 1", "0.5 0.3 0.06", 10.0, (2e4, 2e3, 1000.0))
    physics.add_robot(fork)
    rigid = physics.rigid
    rng = np.random.default_rng(1)
    pick_all(physics)
    for bunch in range(3):
        at = np.array([-0.15 + 0.1 * bunch, 0.02 * bunch - 0.02, 0.25 + 0.15 * bunch])
        rigid.place_bunch(bunch, frames.pose(at, frames.normalize(rng.normal(size=4))), np.zeros(6))
    for _ in range(200):
        physics.step()
    for tick in range(800):
        lift = 0.4 * np.clip(tick / 200.0, 0.0, 1.0) * (1.0 if tick < 600 else max(0.0, 1.0 - (tick - 600) / 150.0))
        rigid.command("fork", np.array([lift]))
        rigid.command_base("fork", (0.5 * float(np.interp(tick, [200, 250, 400, 450], [0, 1, 1, 0])), 0.0, 0.0))
        physics.step()
        if tick == 590:
            contact = rigid.joint_measurements("fork")[3][0]
            assert contact == pytest.approx(-WEIGHT * (2.0 + sum(masses)), rel=0.01)
            assert rigid.mj_data.joint("box/0").qpos[2] == pytest.approx(0.46, abs=5e-3)
    box = rigid.mj_data.joint("box/0").qpos
    assert box[0] == pytest.approx(1.0, abs=0.03)
    for bunch, mass in enumerate(masses):
        middle = rigid.bunch_pose(bunch)
        middle = middle[:3] + frames.rotate(middle[3:], np.array([0.085, 0.0, 0.0]))
        inside = frames.rotate(frames.conjugate(frames.from_wxyz(box[3:])), middle - box[:3])
        assert (np.abs(inside[:2]) < [0.3, 0.2]).all()
        assert 0.0 < inside[2] < 0.35
        body = rigid.mj_model.body(f"free_bunch/{rigid._bunch_slot[bunch]}").id
        assert rigid.mj_model.body_mass[body] == pytest.approx(mass, rel=1e-6)


# ---------------------------------------------------------------------- momentum of pairs

HIGH = 60.0
"""Height of the collisions, in free fall without other horizontal forces [m]."""


def pick_all(physics: Physics) -> None:
    """Pick every bunch; one with clusters in the shape that a robot's hand meets, of one capsule a cluster."""
    trees = np.arange(len(physics.model.tree_first))
    physics.plants.wake(trees)
    physics.plants.refine(trees)
    for bunch in range(len(physics.model.bunch_body)):
        physics.pick(bunch)


def airborne(clusters: bool = False) -> Physics:
    """Two boxes, two bunches and two cut canes, far from one another, and two coasting rams."""
    trees = [cane((20.0 * i, 30.0, HIGH), bunch=0.5, clusters=clusters) for i in range(2)]
    trees += [cane((20.0 * i, 60.0, HIGH), radius=0.006) for i in range(2)]
    at = [frames.pose([5.0 * i, -30.0, HIGH]) for i in range(2)]
    physics = Physics(assemble(trees, box_pose=at, box_size=[SIZE] * 2, box_mass=[2.0, 1.0]), detachment=False)
    for i in range(2):
        physics.add_robot(robot(f"ram{i}", [10.0 * i, -60.0, HIGH], "1 0 0", "0.2 0.3 0.2", 3.0, (0.0, 0.0, 1000.0)))
    pick_all(physics)
    return physics


def momentum(physics: Physics) -> np.ndarray:
    """Total momentum of all free bodies [3] kg m/s; of a ram, along its axis."""
    rigid = physics.rigid
    model = physics.model
    rigid.update_kinematics()
    total = np.zeros(3)
    J = np.zeros((3, rigid.mj_model.nv))
    names = ["box/0", "box/1", *(f"free_bunch/{slot}" for slot in rigid._bunch_slot.values())]
    for name in (*names, "ram0/tool", "ram1/tool"):
        body = rigid.mj_model.body(name).id
        mujoco.mj_jacBodyCom(rigid.mj_model, rigid.mj_data, J, None, body)
        total += rigid.mj_model.body_mass[body] * (J @ rigid.mj_data.qvel)
    physics.update_kinematics()
    q = physics.state.body_q.astype(float)
    v = physics.state.body_qd.astype(float)
    free = model.body_tree >= 2
    velocity = v[:, :3] + np.cross(v[:, 3:], frames.rotate(q[:, 3:], model.body_com.astype(float)))
    return total + model.body_mass[free].astype(float) @ velocity[free]


def throw(physics: Physics, kind: str, index: int, x: float, speed: float) -> None:
    """Place an object so that it collides near (0, 0, 60), a little off centre, moving along x."""
    rigid = physics.rigid
    at = np.array([x, 0.02 * index, HIGH - 0.01 * index])
    if kind == "box":
        joint = rigid.mj_data.joint(f"box/{index}")
        joint.qpos[:] = [*(at - [0.0, 0.0, 0.15]), 1, 0, 0, 0]
        joint.qvel[0] = speed
    elif kind == "bunch":
        rigid.place_bunch(index, frames.pose(at - [0.085, 0, 0]), np.array([speed, 0, 0, 0, 0, 0]))
    else:
        rigid.place_robot(f"ram{index}", frames.pose([*at[:2], HIGH]), np.zeros(1))
        rigid.mj_data.qvel[rigid.robot(f"ram{index}").v] = speed


PAIRS = [
    ("box", "box"),
    ("box", "bunch"),
    ("bunch", "box"),
    ("bunch", "bunch"),
    ("ram", "box"),
    ("ram", "bunch"),
    ("ram", "ram"),
]


@pytest.mark.parametrize(
    ("one", "other", "clusters"),
    [(*pair, False) for pair in PAIRS] + [(*pair, True) for pair in PAIRS if "bunch" in pair],
)
def test_colliding_pairs_conserve_momentum(one, other, clusters):
    """Contact impulses of a pair cancel in every step; rotation about a point other than the centre of mass then
    drifts in free flight by the order of the step."""
    physics = airborne(clusters)
    rigid = physics.rigid
    rigid.mj_model.opt.gravity[:] = 0.0
    throw(physics, one, 0, -0.5, 1.5)
    throw(physics, other, 1, 0.5, -1.0)
    start = momentum(physics)
    exchanged = np.zeros(2)
    for _ in range(60):
        physics.step()
        acceleration = rigid.mj_data.qacc - rigid.mj_data.qacc_smooth  # of contacts, at the poses of the step's start
        pair = (
            np.array([momentum_rate_x(physics, *which, acceleration) for which in ((one, 0), (other, 1))]) * physics.dt
        )
        assert abs(pair.sum()) <= 1e-4 * np.abs(pair).max() + 1e-5
        exchanged += pair
    assert exchanged[0] < -0.3, "no collision"
    assert exchanged.sum() == pytest.approx(0.0, abs=1e-4 * exchanged[1])
    # bunches that spin: one of clusters is hit further from its centre, and spins faster
    assert abs(momentum(physics) - start)[0] < (7e-3 if clusters else 5e-3) * exchanged[1]


def momentum_rate_x(physics: Physics, kind: str, index: int, rates: np.ndarray) -> float:
    """Mass times the rate of an object's centre of mass along x, at MuJoCo's current poses."""
    rigid = physics.rigid
    name = {"box": f"box/{index}", "bunch": f"free_bunch/{rigid._bunch_slot[index]}", "ram": f"ram{index}/tool"}[kind]
    body = rigid.mj_model.body(name).id
    J = np.zeros((3, rigid.mj_model.nv))
    mujoco.mj_jacBodyCom(rigid.mj_model, rigid.mj_data, J, None, body)
    return float(rigid.mj_model.body_mass[body] * (J @ rates)[0])


@pytest.mark.parametrize("other", ["box", "bunch", "ram"])
def test_a_collision_with_a_cut_cane_conserves_momentum(other):
    """A freely falling cane, hit in the middle by a box, a bunch or a ram."""
    physics = airborne()
    tree = 2
    physics.plants.cut(int(physics.model.tree_first[tree]))
    rigid = physics.rigid
    middle = np.array([0.5, 60.0, HIGH])
    if other == "ram":
        rigid.place_robot("ram0", frames.pose([middle[0], 59.8, HIGH], frames.from_yaw(0.5 * np.pi)), np.zeros(1))
        rigid.mj_data.qvel[rigid.robot("ram0").v] = 1.0
    elif other == "box":
        joint = rigid.mj_data.joint("box/0")
        joint.qpos[:] = [middle[0], 59.7, HIGH - 0.15, 1, 0, 0, 0]
        joint.qvel[1] = 1.0
    else:
        rigid.place_bunch(0, frames.pose([middle[0] - 0.085, 59.85, HIGH]), np.array([0, 1.0, 0, 0, 0, 0]))
    start = momentum(physics)
    contact_count = 0
    for _ in range(50):
        physics.step()
        contact_count += len(physics.contacts)
    assert contact_count > 0
    change = momentum(physics) - start
    assert abs(change[1]) < 1e-4 * abs(start[1])


@pytest.mark.parametrize(
    ("mass", "fall"),
    each_once([0.5, 2.0, 15.0], [(0.2, 0.0, 0.0), (0.5, 0.03, 0.0), (0.5, 0.0, 0.05), (1.0, 0.0, 0.0)]),
)
def test_a_crate_that_falls_on_another_comes_to_rest_on_its_rim(mass, fall):
    """At 1 m it moves by 44 mm a step, and walls are 12 mm thick."""
    height, offset, tilt = fall
    turn = frames.multiply(frames.from_yaw(0.02), frames.exp(np.array([tilt, tilt / 2.0, 0.0])))
    at = [frames.pose([0.0, 0.0, 0.0], frames.from_yaw(0.01)), frames.pose([offset, offset, 0.3 + height], turn)]
    physics = Physics(assemble([cane((0.0, 50.0, 2.0))], box_pose=at, box_size=[SIZE] * 2, box_mass=[2.0, mass]))
    for _ in range(200):
        physics.step()
    (lower, upper) = poses(physics)
    data = physics.rigid.mj_data
    assert upper[2] == pytest.approx(0.3, abs=2e-3)
    assert lower[2] == pytest.approx(0.0, abs=2e-3)
    assert np.abs(data.qvel).max() < 1e-3
