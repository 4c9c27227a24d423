"""The rigid world: the split step equals MuJoCo's, measured efforts, robots that join and leave in mid-motion."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

from tests.support.contact_scenes import cane
from vinesim.core import frames
from vinesim.rigid import free_bunch, static_world
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.rigid.urdf import RobotError
from vinesim.scene.builder import assemble
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.values import Drive, RobotSpec

ARM = """<robot name="arm">
<material name="red"><color rgba="0.8 0.1 0.1 1"/></material>
<link name="base_footprint"/>
<link name="chassis"><inertial><mass value="60"/><inertia ixx="2" iyy="2" izz="3" ixy="0" ixz="0" iyz="0"/></inertial>
 <visual><geometry><box size="0.6 0.5 0.3"/></geometry><material name="red"/></visual>
 <collision><geometry><box size="0.6 0.5 0.3"/></geometry></collision></link>
<joint name="stand" type="fixed"><parent link="base_footprint"/><child link="chassis"/><origin xyz="0 0 0.25"/></joint>
<link name="upper"><inertial><origin xyz="0.2 0 0"/><mass value="4"/>
  <inertia ixx="0.01" iyy="0.06" izz="0.06" ixy="0" ixz="0" iyz="0"/></inertial>
 <collision><origin xyz="0.2 0 0" rpy="0 1.5707963 0"/><geometry><cylinder radius="0.04" length="0.4"/></geometry>
 </collision></link>
<joint name="shoulder" type="revolute"><parent link="chassis"/><child link="upper"/><origin xyz="0.3 0 0.5"/>
 <axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="90" velocity="2"/></joint>
<link name="lower"><inertial><origin xyz="0.2 0 0"/><mass value="2"/>
  <inertia ixx="0.005" iyy="0.03" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial>
 <collision><origin xyz="0.2 0 0" rpy="0 1.5707963 0"/><geometry><cylinder radius="0.03" length="0.4"/></geometry>
 </collision></link>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0.4 0 0"/>
 <axis xyz="0 1 0"/><limit lower="-2.5" upper="2.5" effort="60" velocity="2"/></joint>
<link name="slider"><inertial><mass value="0.5"/>
  <inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
 <collision><geometry><sphere radius="0.04"/></geometry></collision></link>
<joint name="extend" type="prismatic"><parent link="lower"/><child link="slider"/><origin xyz="0.4 0 0"/>
 <axis xyz="1 0 0"/><limit lower="0" upper="0.1" effort="80" velocity="0.5"/></joint>
<link name="tool"/>
<joint name="mount" type="fixed"><parent link="slider"/><child link="tool"/><origin xyz="0.06 0 0"/></joint>
<link name="wheel"><inertial><mass value="1"/>
  <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="axle" type="continuous"><parent link="chassis"/><child link="wheel"/><axis xyz="0 1 0"/></joint>
</robot>"""

DRIVES = (
    Drive("shoulder", 4000.0, 250.0, 90.0, 2.0, -2.0, 2.0),
    Drive("elbow", 2500.0, 150.0, 60.0, 2.0, -2.5, 2.5),
    Drive("extend", 8000.0, 400.0, 80.0, 0.5, 0.0, 0.1),
)
HOME = np.array([0.4, -0.9, 0.05])


def arm(name: str = "anna", index: int = 0, x: float = 0.0, y: float = 0.0, heading: float = 0.0) -> RobotSpec:
    pose = frames.pose(np.array([x, y, 0.0]), frames.from_yaw(heading))
    return RobotSpec(name, index, ARM, "base_footprint", pose, DRIVES, HOME)


def yard(boxes: int = 0, **counts: int) -> Model:
    model = Model.allocate(tree=0, body=0, bunch=0, leaf=0, fixed=2, tie=0, box=boxes)
    model.fixed_start[:] = [[3, 0, 0], [3, 2, 0]]
    model.fixed_end[:] = [[3, 0, 2], [3, 2, 2]]
    model.fixed_radius[:] = 0.05
    model.fixed_organ[:] = Organ.POLE, Organ.WIRE
    for i in range(boxes):
        model.box_pose[i, :3] = 0.0, 5.0 + i, 0.002
    model.box_size[:] = (0.6, 0.4, 0.3)
    model.box_mass[:] = 2.0
    return model


def step(rigid: RigidWorld, ticks: int = 1) -> None:
    for _ in range(ticks):
        rigid.predict()
        rigid.integrate()


def test_everything_that_stands_still_is_a_static_geom():
    names = [yard_geom.name for yard_geom in map(RigidWorld(yard()).mj_model.geom, range(3))]
    assert names == ["ground", "fixed/0", "fixed/1"]


def test_split_step_is_bitwise_mj_step():
    rigid = RigidWorld(yard(boxes=2))
    rigid.add_robot(arm())
    rigid.add_robot(arm("bert", 1, y=1.5))
    reference = mujoco.MjData(rigid.mj_model)
    mujoco.mj_copyData(reference, rigid.mj_model, rigid.mj_data)
    rng = np.random.default_rng(3)
    for tick in range(200):
        if tick % 20 == 0:
            rigid.command("anna", HOME + rng.normal(size=3) * 0.3, rng.normal(size=3))
            rigid.command_base("bert", (0.4, -0.1, 0.5))
        rigid.predict()
        rigid.velocity_free  # noqa: B018 (reading the prediction must not disturb the step)
        rigid.impulse_response(np.eye(rigid.mj_model.nv)[:4])
        rigid.integrate()
        reference.ctrl[:] = rigid.mj_data.ctrl
        mujoco.mj_step(rigid.mj_model, reference)
        assert (reference.qpos == rigid.mj_data.qpos).all()
        assert (reference.qvel == rigid.mj_data.qvel).all()


@pytest.mark.parametrize("exact", [False, True])
def test_predicted_velocity_and_response_are_realised(exact):
    rigid = RigidWorld(yard())
    rigid.add_robot(arm())
    if exact:
        rigid.set_gains("anna", np.full(3, 60.0), np.full(3, 5.0), np.zeros(3), exact=np.ones(3, bool))
    rigid.command("anna", HOME + np.array([0.2, -0.3, 0.02]))
    step(rigid, 5)
    rng = np.random.default_rng(1)
    force = np.zeros(rigid.mj_model.nv)
    force[rigid.robot("anna").v] = rng.normal(size=3) * 3.0
    rigid.predict()
    predicted = rigid.velocity_free + rigid.impulse_response(force[None])[:, 0] * rigid.dt
    rigid.integrate(force)
    np.testing.assert_allclose(rigid.mj_data.qvel, predicted, atol=1e-12)


def test_response_includes_the_stiffness_of_an_active_limit():
    rigid = RigidWorld(yard())
    rigid.add_robot(arm())
    rigid.command("anna", np.array([0.4, -0.9, 0.2]))  # beyond the limit at 0.1
    step(rigid, 100)
    rigid.predict()
    assert rigid.mj_data.nefc == 1
    force = np.zeros(rigid.mj_model.nv)
    force[rigid.robot("anna").v[2]] = -1.0
    predicted = rigid.velocity_free + rigid.impulse_response(force[None])[:, 0] * rigid.dt
    rigid.integrate(force)
    np.testing.assert_allclose(rigid.mj_data.qvel, predicted, atol=1e-7)


def test_response_of_a_crate_that_slides_on_the_ground_is_that_of_its_friction_cones():
    """The prediction with a small force, less that without, is the response times the force: to 1 % of it."""
    rigid = RigidWorld(
        assemble([cane((0.0, 9.0, 2.0))], box_pose=[frames.pose([0, 0, 0])], box_size=[(0.6, 0.4, 0.3)], box_mass=[2.0])
    )
    rigid.mj_data.joint("box/0").qvel[:2] = 1.0, 0.3
    step(rigid, 3)
    rigid.predict()
    assert (rigid.mj_data.efc_state == int(mujoco.mjtConstraintState.mjCNSTRSTATE_CONE)).all()
    first = int(rigid.mj_model.joint("box/0").dofadr[0])
    forces = 1e-3 * np.eye(rigid.mj_model.nv)[first : first + 6]
    response = rigid.impulse_response(forces).T * rigid.dt
    without = rigid.velocity_free
    rates = []
    for force in forces:
        rigid.predict_with(force)
        rates.append(rigid.velocity_free - without)
    error = np.abs(np.array(rates) - response).max(1) / np.abs(response).max(1)
    assert error.max() < 0.01, error


def test_new_gains_do_not_change_the_last_measured_effort():
    rigid = RigidWorld(yard())
    rigid.add_robot(arm())
    rigid.command("anna", HOME + 0.02)
    step(rigid, 10)
    before = rigid.joint_measurements("anna")[2].copy()
    assert np.abs(before).max() > 1.0
    rigid.set_gains("anna", np.full(3, 50.0), np.full(3, 5.0), np.full(3, 7.0), exact=np.ones(3, bool))
    rigid.command("anna", HOME - 1.0)
    np.testing.assert_allclose(rigid.joint_measurements("anna")[2], before, atol=1e-9)


def test_gravity_compensation_holds_the_pose_and_effort_is_the_weight():
    rigid = RigidWorld(yard())
    rigid.add_robot(arm())
    step(rigid, 300)
    position, velocity, effort, contact = rigid.joint_measurements("anna")
    np.testing.assert_allclose(position, HOME, atol=1e-6)
    np.testing.assert_allclose(velocity, 0.0, atol=1e-6)
    assert (contact == 0.0).all()
    weight = np.zeros(3)
    for link, mass, com in (("upper", 4.0, 0.2), ("lower", 2.0, 0.2), ("slider", 0.5, 0.0)):
        pose = rigid.link_pose("anna", link)
        point = pose[:3] + frames.rotate(pose[3:], np.array([com, 0.0, 0.0]))
        weight += rigid.jacobian("anna", link, point)[2] * -9.81 * mass
    assert abs(weight[0]) > 10.0
    np.testing.assert_allclose(effort, -weight, rtol=1e-4)


def test_a_drive_is_limited_to_its_effort():
    rigid = RigidWorld(yard())
    rigid.add_robot(arm())
    rigid.apply_wrench("anna", "slider", np.array([0.0, 0.0, -300.0]))
    step(rigid, 3)
    _, _, effort, _ = rigid.joint_measurements("anna")
    assert abs(effort[0]) <= 90.0 + 1e-9
    assert np.abs(rigid.mj_data.qfrc_actuator[rigid.robot("anna").v]).max() <= 90.0 + 1e-9


def test_contact_effort_is_measured_and_balanced_by_the_drives():
    """A force on the tool, given as by the contact solver: contact = J^T f, effort balances load and contact."""
    rigid = RigidWorld(yard())
    rigid.add_robot(arm())
    step(rigid, 50)
    _, _, at_rest, _ = rigid.joint_measurements("anna")
    push = np.array([6.0, 0.0, -12.0])
    for _ in range(400):
        rigid.predict()
        point = rigid.mj_data.body("anna/tool").xpos
        J = np.zeros((3, rigid.mj_model.nv))
        mujoco.mj_jac(rigid.mj_model, rigid.mj_data, J, None, point, rigid.mj_data.body("anna/tool").id)
        rigid.integrate(J.T @ push)
    _, velocity, effort, contact = rigid.joint_measurements("anna")
    expected = rigid.jacobian("anna", "tool", rigid.link_pose("anna", "tool")[:3])[:3].T @ push
    assert np.abs(velocity).max() < 1e-6
    np.testing.assert_allclose(contact, expected, rtol=2e-2, atol=1e-2)
    np.testing.assert_allclose(effort - at_rest, -contact, rtol=2e-2, atol=2e-2)


def test_contact_with_a_pole_is_measured_and_the_tracks_slip_at_their_effort():
    rigid = RigidWorld(yard())
    rigid.add_robot(arm(x=2.6))
    rigid.command_base("anna", (0.3, 0.0, 0.0))
    step(rigid, 300)
    pose, _ = rigid.base_state("anna")
    assert pose[0] == pytest.approx(3.0 - 0.05 - 0.3, abs=0.02)
    assert rigid.contact_force[rigid.robot("anna").base_v[0]] == pytest.approx(-800.0, rel=3e-2)


def test_tracks_drive_and_hold():
    rigid = RigidWorld(yard())
    rigid.add_robot(arm(heading=np.pi / 2))
    rigid.command_base("anna", (0.5, 0.0, 0.0))
    step(rigid, 200)
    pose, velocity = rigid.base_state("anna")
    np.testing.assert_allclose(velocity[:2], [0.0, 0.5], atol=1e-3)
    assert pose[1] == pytest.approx(1.0, abs=0.05)
    rigid.command_base("anna", (0.0, 0.0, 0.0))
    step(rigid, 100)
    held, _ = rigid.base_state("anna")
    rigid.apply_wrench("anna", "chassis", np.array([100.0, 0.0, 0.0]))
    step(rigid, 500)
    pushed, velocity = rigid.base_state("anna")
    assert np.abs(pushed[:2] - held[:2]).max() < 2e-3  # 100 N of 800 N: an eighth of the slip
    assert np.abs(velocity).max() < 1e-5


def test_the_base_rotates_about_its_own_axes():
    rigid = RigidWorld(yard())
    rigid.add_robot(arm())
    rigid.command_base("anna", (0.4, 0.0, 0.5))  # a circle of radius 0.8 m
    step(rigid, 400)
    pose, velocity = rigid.base_state("anna")
    yaw = 2.0 * np.arctan2(pose[5], pose[6])
    assert np.hypot(*velocity[:2]) == pytest.approx(0.4, rel=0.02)
    np.testing.assert_allclose(pose[:2], [0.8 * np.sin(yaw), 0.8 * (1 - np.cos(yaw))], atol=0.05)


def test_a_joining_robot_keeps_the_state_of_the_others():
    rigid = RigidWorld(yard(boxes=1))
    rigid.add_robot(arm())
    rigid.command("anna", HOME + np.array([0.5, 0.5, -0.04]), np.array([0.5, 0.0, 0.0]))
    rigid.command_base("anna", (0.2, 0.0, 0.1))
    rigid.apply_wrench("anna", "lower", np.array([0.0, 5.0, 0.0]))
    step(rigid, 13)
    before = (
        rigid.joint_measurements("anna"),
        rigid.base_state("anna"),
        rigid.mj_data.body("box/0").xpos.copy(),
        rigid.link_pose("anna", "tool"),
    )
    undisturbed = RigidWorld(yard(boxes=1))
    undisturbed.add_robot(arm())
    undisturbed.command("anna", HOME + np.array([0.5, 0.5, -0.04]), np.array([0.5, 0.0, 0.0]))
    undisturbed.command_base("anna", (0.2, 0.0, 0.1))
    undisturbed.apply_wrench("anna", "lower", np.array([0.0, 5.0, 0.0]))
    step(undisturbed, 13)

    rigid.add_robot(arm("bert", 1, y=3.0))
    for actual, expected in zip(rigid.joint_measurements("anna"), before[0], strict=True):
        assert (actual == expected).all()
    for actual, expected in zip(rigid.base_state("anna"), before[1], strict=True):
        assert (actual == expected).all()
    assert (rigid.link_pose("anna", "tool") == before[3]).all()
    step(rigid, 20)
    step(undisturbed, 20)
    np.testing.assert_allclose(
        rigid.joint_measurements("anna")[0], undisturbed.joint_measurements("anna")[0], atol=1e-9
    )
    np.testing.assert_allclose(
        rigid.joint_measurements("anna")[1], undisturbed.joint_measurements("anna")[1], atol=1e-8
    )

    rigid.remove_robot("bert")
    assert rigid.robots == ("anna",)
    step(rigid, 20)
    step(undisturbed, 20)
    np.testing.assert_allclose(
        rigid.joint_measurements("anna")[0], undisturbed.joint_measurements("anna")[0], atol=1e-9
    )
    np.testing.assert_allclose(rigid.base_state("anna")[0], undisturbed.base_state("anna")[0], atol=1e-9)


def test_a_copy_follows_the_received_pose_and_velocity():
    rigid = RigidWorld(yard())
    rigid.add_robot(arm())
    rigid.add_robot(arm("copy", 1, y=2.0))
    rigid.command_base("anna", (0.3, 0.0, 0.2))
    for tick in range(300):
        t = 0.01 * tick
        rigid.command("anna", HOME + 0.3 * np.sin(t) * np.array([1, 1, 0.1]), 0.3 * np.cos(t) * np.array([1, 1, 0.1]))
        base_q, base_qd = rigid.base_state("anna")
        position, velocity, _, _ = rigid.joint_measurements("anna")
        base_q[1] += 2.0
        rigid.follow_remote("copy", base_q, base_qd, position, velocity)
        step(rigid)
    (actual, _) = rigid.base_state("anna")
    (copy, _) = rigid.base_state("copy")
    np.testing.assert_allclose(copy[:2] - actual[:2], [0.0, 2.0], atol=5e-3)
    np.testing.assert_allclose(rigid.joint_measurements("copy")[0], rigid.joint_measurements("anna")[0], atol=1e-2)


def test_robots_collide_with_each_other_but_not_with_themselves():
    rigid = RigidWorld(yard())
    rigid.add_robot(arm())
    rigid.command("anna", np.array([-1.0, 2.5, 0.0]))  # folded into its own chassis
    step(rigid, 100)
    assert rigid.mj_data.ncon == 0
    rigid.add_robot(arm("bert", 1, x=-0.65))
    rigid.command_base("bert", (0.2, 0.0, 0.0))
    step(rigid, 100)
    assert rigid.mj_data.ncon > 0
    assert rigid.base_state("anna")[0][0] - rigid.base_state("bert")[0][0] == pytest.approx(0.6, abs=2e-3)


def test_visuals_move_with_their_bodies():
    rigid = RigidWorld(yard(boxes=1))
    rigid.add_robot(arm("anna", 7, x=1.0, heading=0.5))
    step(rigid, 30)
    links = rigid.visuals()
    poses = rigid.visual_q()
    assert links is rigid.visuals()
    assert [link.name for link in links] == ["box/0", "anna/chassis", "anna/upper", "anna/lower", "anna/slider"]
    assert links[0].organ == Organ.BOX
    assert {shape.kind for shape in links[0].shapes} == {"box"}
    assert links[1].index == 7
    assert links[1].shapes[0].rgba == (0.8, 0.1, 0.1, 1.0)
    np.testing.assert_allclose(poses[1, :3], [1.0, 0.0, 0.25], atol=1e-9)
    np.testing.assert_allclose(poses[4], rigid.link_pose("anna", "slider"), atol=1e-12)
    np.testing.assert_allclose(links[2].shapes[0].pose[3:], [0, np.sqrt(0.5), 0, np.sqrt(0.5)], atol=1e-6)
    np.testing.assert_allclose(poses[0, 2], 0.0, atol=2e-3)  # the box is on the ground
    # the axle has no drive: it is fixed, and the wheel has no shape
    assert "anna/axle" not in [rigid.mj_model.joint(i).name for i in range(rigid.mj_model.njnt)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": "a/b"}, "must not"),
        ({"base": "chassis"}, "root"),
        ({"home": np.zeros(2)}, "3 drives"),
        ({"urdf": "<robot"}, "not XML"),
        ({"urdf": ARM.replace('<mass value="4"/>', '<mass value="-4"/>')}, "MuJoCo"),
        ({"drives": (*DRIVES[:2], Drive("nose", 1, 1, 1, 1, 0, 1))}, "nose"),
        ({"drives": (*DRIVES[:2], Drive("mount", 1, 1, 1, 1, 0, 1))}, "fixed"),
    ],
)
def test_an_invalid_robot_is_refused_and_the_world_is_unchanged(change, message):
    rigid = RigidWorld(yard())
    rigid.add_robot(arm("other"))
    with pytest.raises(RobotError, match=message) as caught:
        rigid.add_robot(dataclasses.replace(arm(), **change))
    assert "\n" not in str(caught.value)
    assert rigid.robots == ("other",)
    step(rigid, 2)
    with pytest.raises(ValueError, match="there are: other"):
        rigid.joint_measurements("anna")
    with pytest.raises(RobotError, match="already here"):
        rigid.add_robot(arm("other"))


def test_a_mimicking_finger_follows_the_driven_one():
    reference = ARM.replace(
        '<link name="tool"/>',
        '<link name="thumb"><inertial><mass value="0.2"/>'
        '<inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="oppose" type="prismatic"><parent link="lower"/><child link="thumb"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" effort="10" velocity="1"/><mimic joint="extend" multiplier="-2" offset="0.3"/>'
        '</joint><link name="tool"/>',
    )
    rigid = RigidWorld(yard())
    rigid.add_robot(dataclasses.replace(arm(), urdf=reference))
    thumb = rigid.mj_data.joint("anna/oppose")
    assert thumb.qpos[0] == pytest.approx(0.3 - 2 * 0.05)
    rigid.command("anna", np.array([0.4, -0.9, 0.09]))
    step(rigid, 200)
    assert rigid.joint_measurements("anna")[0][2] == pytest.approx(0.09, abs=1e-4)
    assert rigid.mj_data.joint("anna/oppose").qpos[0] == pytest.approx(0.3 - 2 * 0.09, abs=1e-3)


def test_a_mesh_collides_as_its_hull(tmp_path):
    """An STL of a brick, off its link's origin: contacts use its hull, sensors get the file."""
    low = np.array([0.1, -0.05, 0.2])
    high = np.array([0.16, 0.07, 0.5])
    corner = [np.where([i & 1, i & 2, i & 4], high, low) for i in range(8)]
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    record = np.zeros(12, dtype=[("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("attribute", "<u2")])
    record["corner"] = [[corner[i] for i in t] for t in triangles]
    file = tmp_path / "brick.stl"
    file.write_bytes(b" " * 80 + np.uint32(12).tobytes() + record.tobytes())
    mesh = f'<mesh filename="{file}"/>'
    urdf = ARM.replace('<sphere radius="0.04"/>', mesh)
    rigid = RigidWorld(yard())
    rigid.add_robot(dataclasses.replace(arm(), urdf=urdf))
    rigid.predict()
    geom = rigid.geoms.link.index("slider")
    assert rigid.geoms.kind[geom] == 7
    assert rigid.geoms.hull[geom] >= 0
    np.testing.assert_allclose(np.sort(rigid.geoms.size[geom]), np.sort((high - low) / 2), atol=1e-6)
    index = rigid.geoms.id[geom]
    center = rigid.mj_data.geom_xpos[index] + rigid.mj_data.geom_xmat[index].reshape(3, 3) @ rigid.geoms.center[geom]
    pose = rigid.link_pose("anna", "slider")
    np.testing.assert_allclose(center, pose[:3] + frames.rotate(pose[3:], (low + high) / 2), atol=1e-6)
    shape = next(link for link in rigid.visuals() if link.name == "anna/slider").shapes[0]
    assert (shape.kind, shape.file, shape.size) == ("mesh", str(file), (1.0, 1.0, 1.0))


@pytest.mark.parametrize("content", [b"", b"solid of nothing", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"])
def test_an_unreadable_mesh_is_named(content, tmp_path):
    file = tmp_path / f"shell.{'obj' if content.startswith(b'v') else 'stl'}"
    file.write_bytes(content)
    urdf = ARM.replace('<sphere radius="0.04"/>', f'<mesh filename="{file}"/>')
    rigid = RigidWorld(yard())
    with pytest.raises(RobotError, match=r"'anna'.*shell") as caught:
        rigid.add_robot(dataclasses.replace(arm(), urdf=urdf))
    assert "\n" not in str(caught.value)
    assert rigid.robots == ()


def test_gains_can_be_set_and_persist_when_a_robot_joins():
    rigid = RigidWorld(yard())
    rigid.add_robot(arm())
    rigid.set_gains("anna", np.array([4000.0, 0.0, 8000.0]), np.array([250.0, 5.0, 400.0]), np.array([0.0, 2.0, 0.0]))
    rigid.add_robot(arm("bert", 1, y=3.0))
    step(rigid, 20)
    _, velocity, effort, _ = rigid.joint_measurements("anna")
    gravity = rigid.mj_data.qfrc_gravcomp[rigid.robot("anna").v[1]]
    assert effort[1] - gravity == pytest.approx(2.0 - 5.0 * velocity[1], abs=1e-9)
    assert velocity[1] > 0.1


def test_boxes_at_rest_sleep_until_they_are_pushed():
    rigid = RigidWorld(yard(boxes=3))
    rigid.add_robot(arm())
    no_force = np.full(rigid.mj_model.nv, -0.0)
    for _ in range(100):
        rigid.predict()
        rigid.integrate(no_force)
    assert rigid.mj_data.ncon == 0
    assert (rigid.velocity_free[:18] == 0.0).all()
    push = no_force.copy()
    dof = rigid.mj_model.joint("box/1").dofadr[0]
    steps = 60
    dt = rigid.dt
    mu = rigid.parameters.friction
    push[dof] = 30.0  # mu m g is 15.7 N
    impulse = np.zeros(3)  # of the ground on the box
    for _ in range(steps):
        rigid.predict()
        rigid.integrate(push)
        impulse += dt * rigid.mj_data.qfrc_constraint[dof : dof + 3]
    # Coulomb: friction opposes the motion and is mu times the normal force
    np.testing.assert_allclose(impulse[:2], [-mu * impulse[2], 0.0], atol=1e-6 * impulse[2])
    # F / m = 7.15 m/s^2, summed in steps; the normal force is zero in some steps, so that the box hops
    rigid.predict()
    moved = rigid.mj_data.joint("box/1").qpos[0]
    acceleration = (30.0 - mu * 2.0 * 9.81) / 2.0
    assert moved == pytest.approx(acceleration * dt**2 * steps * (steps + 1) / 2.0, rel=0.05)
    assert rigid.mj_data.joint("box/0").qpos[0] == 0.0
    assert rigid.mj_data.joint("box/0").qvel[0] == 0.0


@pytest.mark.parametrize("rate", [np.nan, 1e6, -1e6])
def test_a_faulty_robot_stops_and_the_others_continue(rate: float):
    """One of its joint rates is not finite, or beyond what any body reaches in a stable simulation [rad/s]."""
    rigid = RigidWorld(yard())
    undisturbed = RigidWorld(yard())
    for world in (rigid, undisturbed):
        world.add_robot(arm())
        world.add_robot(arm("bert", 1, y=3.0))
        world.command_base("bert", (0.3, 0.0, 0.0))
    step(rigid, 20)
    step(undisturbed, 20)
    pose_before = rigid.base_state("anna")[0]
    rigid.predict()
    rigid.mj_data.qvel[rigid.robot("anna").v[1]] = rate
    rigid.integrate()
    step(rigid, 30)
    step(undisturbed, 31)
    assert rigid.faults == 1
    assert "anna" in rigid.last_fault
    assert "bert" not in rigid.last_fault
    np.testing.assert_allclose(rigid.base_state("anna")[0], pose_before, atol=1e-3)
    np.testing.assert_allclose(rigid.joint_measurements("anna")[0], HOME, atol=1e-2)
    np.testing.assert_allclose(rigid.base_state("bert")[0], undisturbed.base_state("bert")[0], atol=1e-6)
    assert rigid.mj_data.time == pytest.approx(undisturbed.mj_data.time)


def free_bunch_of(shapes: int, mass: float = 0.6) -> free_bunch.FreeBunch:
    """A bunch of spheres and, last, a capsule."""
    start = np.stack([0.02 * np.arange(shapes), 0.003 * np.arange(shapes), np.zeros(shapes)], 1)
    end = start.copy()
    end[-1, 0] += 0.03
    inertia = np.array([6e-4, 1.5e-3, 1.4e-3])
    radius = 0.04 - 0.001 * np.arange(shapes)
    product = np.array([1e-5, -3e-5, 4e-5])
    return free_bunch.FreeBunch(mass, np.array([0.07, 2e-3, 0.0]), inertia, product, start, end, radius)


@pytest.mark.parametrize("shapes", [1, 5, free_bunch.MAX_GEOMS])
def test_a_pooled_body_equals_a_compiled_one(shapes):
    """All constants that MuJoCo derives from mass and shapes, against a world compiled with the bunch."""
    model = assemble([], box_pose=[[1.0, 0, 0, 0, 0, 0, 1]], box_size=[[0.6, 0.4, 0.3]], box_mass=[[2.0]])
    rigid = RigidWorld(model)
    bunch = free_bunch_of(shapes)
    rigid.add_bunch(3, bunch, frames.pose(np.array([0.0, 0.0, 1.0])), np.zeros(6))
    spec = static_world.build_static_world(model, rigid.parameters)
    free_bunch.add_free_bunch(spec, bunch, rigid.parameters)
    pooled = rigid.mj_model
    compiled = spec.compile()
    a = pooled.body("free_bunch/0").id
    b = compiled.nbody - 1
    for name in free_bunch.BODY_ARRAYS:
        np.testing.assert_allclose(getattr(pooled, name)[a], getattr(compiled, name)[b], rtol=1e-12, err_msg=name)
    at = pooled.body_geomadr[a]
    there = compiled.body_geomadr[b]
    for name in free_bunch.GEOM_ARRAYS:
        actual = getattr(pooled, name)[at : at + shapes]
        other = getattr(compiled, name)[there : there + shapes]
        np.testing.assert_allclose(actual, other, rtol=1e-12, err_msg=name)
    actual = slice(pooled.body_dofadr[a], pooled.body_dofadr[a] + 6)
    other = slice(compiled.nv - 6, compiled.nv)
    for name in ("dof_M0", "dof_invweight0", "dof_length", "dof_simplenum"):
        np.testing.assert_allclose(
            getattr(pooled, name)[actual], getattr(compiled, name)[other], rtol=1e-12, err_msg=name
        )
    actual = slice(pooled.body_bvhadr[a], pooled.body_bvhadr[a] + pooled.body_bvhnum[a])
    other = slice(compiled.body_bvhadr[b], compiled.body_bvhadr[b] + compiled.body_bvhnum[b])
    np.testing.assert_allclose(pooled.bvh_aabb[actual], compiled.bvh_aabb[other], rtol=1e-12)
    assert (pooled.bvh_child[actual] == compiled.bvh_child[other]).all()
    nodes = pooled.bvh_nodeid[actual]
    compiled_nodes = compiled.bvh_nodeid[other]
    assert (np.where(nodes < 0, -1, nodes - at) == np.where(compiled_nodes < 0, -1, compiled_nodes - there)).all()


def test_pooled_bodies_sleep_and_are_invisible():
    rigid = RigidWorld(assemble([]))
    for _ in range(20):
        rigid.predict()
        rigid.integrate()
    assert rigid.visuals() == ()
    assert len(rigid.geoms.id) == 0
    assert rigid.mj_data.nv_awake == 0
    assert rigid.mj_data.ncon == 0


def test_the_pool_of_bunches_grows():
    """The pool grows by a compilation when it is used up; falling bunches continue to fall."""
    rigid = RigidWorld(assemble([]))
    generations = []
    for bunch in range(rigid.parameters.bunch_pool_size + 2):
        rigid.add_bunch(bunch, free_bunch_of(3), frames.pose(np.array([float(bunch), 0.0, 5.0])), np.zeros(6))
        generations.append(rigid.mj_model)
        rigid.predict()
        rigid.integrate()
    assert all(world is generations[0] for world in generations[: rigid.parameters.bunch_pool_size])
    assert generations[-1] is not generations[0]
    ticks = np.arange(len(generations), 0, -1)
    fallen = 5.0 - 9.81 * rigid.dt**2 * ticks * (ticks + 1) / 2.0
    heights = [rigid.bunch_pose(bunch)[2] for bunch in rigid.free_bunches]
    np.testing.assert_allclose(heights, fallen, atol=1e-9)
    rigid.remove_bunch(4)
    assert 4 not in rigid.free_bunches
    assert [link.name for link in rigid.visuals()] == [f"bunch/{bunch}" for bunch in rigid.free_bunches]
    with pytest.raises(ValueError, match="collision shapes; a free bunch can have"):
        rigid.add_bunch(4, free_bunch_of(free_bunch.MAX_GEOMS + 1), frames.pose(np.zeros(3)), np.zeros(6))
    assert 4 not in rigid.free_bunches
