"""Compliant joints against mechanics: static deflection F / K, log-decrement of D, springs in series (D6.4, 3.1).

Inertias and weights are computed from the URDF's text, independently of the physics engine.
"""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pytest

from vinesim.core import frames
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.scene.builder import assemble
from vinesim.scene.ids import Organ
from vinesim.scene.physics_parameters import PhysicsParameters

pytestmark = pytest.mark.slow

DT = 0.01
ARM = tuple(f"arm_left_{i}_joint" for i in range(1, 8))
GATE = """<robot name="gate">
<link name="post"><inertial><mass value="80"/>
 <inertia ixx="3" iyy="3" izz="3" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="leaf">
<collision><origin xyz="0.5 0 0" rpy="0 1.57079632679 0"/><geometry><cylinder radius="0.03" length="1"/></geometry>
</collision><inertial><origin xyz="0.5 0 0"/><mass value="4"/>
 <inertia ixx="0.01" iyy="0.2" izz="0.2" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge_joint" type="revolute"><parent link="post"/><child link="leaf"/><origin xyz="0 0 1"/>
 <axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="200" velocity="20"/></joint>
</robot>"""
GATE_INERTIA = 0.2 + 4.0 * 0.5**2
ROTOR = 0.3
"""[kg m2] of the gate's motor."""


@pytest.fixture(scope="module")
def vinebot() -> RobotDescription:
    return load_description("vinebot")


@pytest.fixture(scope="module")
def gate(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    """A single hinge about the vertical."""
    folder = tmp_path_factory.mktemp("gate")
    (folder / "gate.urdf").write_text(GATE)
    (folder / "gate.toml").write_text(
        "[base]\neffort = [1e8, 1e8]\n"  # a post in the ground: tracks would slip and damp the swing
        f'[groups.hinge]\njoints = ["hinge_joint"]\nstiffness = [2000.0]\ndamping = [100.0]\nrotor = [{ROTOR}]\n'
        "elastic = [150.0]\nelastic_damping = [3.0]\n"
    )
    return load_description(folder / "gate.urdf")


class Stand:
    """A robot, and a clock."""

    def __init__(self, description: RobotDescription, **scene: np.ndarray) -> None:
        self.rigid = RigidWorld(assemble([], **scene), parameters=PhysicsParameters(dt=DT))
        self.robot = Robot(self.rigid, description, "anna")
        self.time = 0.0

    def run(self, seconds: float) -> np.ndarray:
        """Positions [tick, joint]."""
        rows = []
        for _ in range(round(seconds / DT)):
            self.robot.control(self.time)
            self.rigid.predict()
            self.rigid.integrate()
            self.time += DT
            rows.append(self.rigid.joint_measurements("anna")[0].copy())
        return np.array(rows)

    def push(self, link: str, force: np.ndarray) -> None:
        """A steady force at a link's centre of mass."""
        self.rigid.apply_wrench("anna", link, np.asarray(force, float))

    def lever(self, link: str) -> np.ndarray:
        """[3, joint] Jacobian of a link's centre of mass, by differences of the description's own kinematics."""
        robot = self.robot
        step = 1e-6
        position = self.rigid.joint_measurements("anna")[0].copy()
        centre = next(
            np.array(measured.find("inertial/origin").get("xyz").split(), float)
            for measured in ElementTree.fromstring(robot.description.urdf).iterfind("link")
            if measured.get("name") == link
        )
        columns = []
        for joint in range(len(position)):
            there = []
            for sign in (-1.0, 1.0):
                moved = position.copy()
                moved[joint] += sign * step
                pose = robot.description.link_poses(moved)[link]
                there.append(pose[:3] + frames.rotate(pose[3:], centre))
            columns.append((there[1] - there[0]) / (2.0 * step))
        base = self.rigid.base_state("anna")[0]
        return frames.to_matrix(base[3:])[:3, :3] @ np.array(columns).T


def weight_beyond(stand: Stand, joint: str) -> float:
    """Moment [N m] about a joint's axis of the weight that it carries: the effort of its drive."""
    description = stand.robot.description
    position = stand.rigid.joint_measurements("anna")[0]
    i = description.joints.index(joint)
    height = []
    for sign in (-1.0, 1.0):
        moved = position.copy()
        moved[i] += sign * 1e-6
        poses = description.link_poses(moved)
        energy = 0.0
        for link in ElementTree.fromstring(description.urdf).iterfind("link"):
            if (mass := link.find("inertial/mass")) is not None:
                origin = link.find("inertial/origin")
                centre = np.array(origin.get("xyz", "0 0 0").split(), float) if origin is not None else np.zeros(3)
                pose = poses[link.get("name")]
                energy += float(mass.get("value")) * 9.81 * (pose[:3] + frames.rotate(pose[3:], centre))[2]
        height.append(energy)
    return (height[1] - height[0]) / 2e-6


def decrement(position: np.ndarray) -> tuple[float, float]:
    """Log-decrement over a whole period, and the period [s], of a decaying swing about zero [tick]."""
    peaks = []
    times = []
    for k in range(1, len(position) - 1):
        before, here, after = position[k - 1 : k + 2]
        if (here - before) * (after - here) <= 0.0:
            bend = before - 2.0 * here + after
            shift = 0.5 * (before - after) / bend
            peaks.append(abs(here - 0.25 * (before - after) * shift))
            times.append(k + shift)
    first = position[0]
    large = [i for i, peak in enumerate(peaks) if peak > 0.02 * abs(first)]
    assert len(large) >= 3, "too few oscillations"
    slope = np.polyfit(large, np.log(np.array(peaks)[large]), 1)[0]
    return -2.0 * slope, 2.0 * DT * float(np.polyfit(large, np.array(times)[large], 1)[0])


def expected(stiffness: float, damping: float, inertia: float) -> tuple[float, float]:
    """Log-decrement and period [s] of a damped oscillator."""
    zeta = damping / (2.0 * np.sqrt(stiffness * inertia))
    root = np.sqrt(1.0 - zeta**2)
    return 2.0 * np.pi * zeta / root, 2.0 * np.pi / np.sqrt(stiffness / inertia) / root


# ---------------------------------------------------------------------- F19, F21: impedance, with no ROS


@pytest.mark.parametrize("zeta", [0.02, 0.05, 0.1, 0.2, 0.3])
@pytest.mark.parametrize("stiffness", [15.0, 60.0, 240.0])
def test_log_decrement_is_that_of_the_commanded_damping(gate: RobotDescription, stiffness: float, zeta: float) -> None:
    """2 %, from 0.5 to 2 Hz: the implicit servo alone would add dt K, at 2 Hz twice the damping of zeta 0.05."""
    inertia = GATE_INERTIA + ROTOR
    damping = 2.0 * zeta * np.sqrt(stiffness * inertia)
    stand = Stand(gate)
    stand.robot.command_impedance([stiffness], [damping])
    stand.rigid.place_robot("anna", np.array([0, 0, 0, 0, 0, 0, 1.0]), np.array([0.3]))
    swing = stand.run(14.0 * np.sqrt(inertia / stiffness))[:, 0]
    measured = decrement(swing)
    desired = expected(stiffness, damping, inertia)
    assert measured[0] == pytest.approx(desired[0], rel=0.02)
    assert measured[1] == pytest.approx(desired[1], rel=0.02)


def test_an_undamped_joint_keeps_oscillating(gate: RobotDescription) -> None:
    stand = Stand(gate)
    stand.robot.command_impedance([60.0], [0.0])
    stand.rigid.place_robot("anna", np.array([0, 0, 0, 0, 0, 0, 1.0]), np.array([0.3]))
    swing = np.abs(stand.run(60.0)[:, 0])
    assert swing[-500:].max() == pytest.approx(0.3, rel=0.01)


@pytest.mark.parametrize("stiffness", [1e3, 1e4, 1e5, 1e6, 1e8])
def test_any_stiffness_is_stable(gate: RobotDescription, stiffness: float) -> None:
    """For any stiffness, even without damping, the scheme adds no energy."""
    stand = Stand(gate)
    stand.robot.command_impedance([stiffness], [0.0])
    stand.run(0.02)
    stand.push("leaf", np.array([0.0, 60.0, 0.0]))
    stand.run(0.3)
    stand.push("leaf", np.zeros(3))
    swing = np.abs(stand.run(10.0)[:, 0])
    bound = 60.0 * 0.5 / stiffness
    assert swing[:200].max() <= 2.0 * bound  # of a load that is applied suddenly and removed at the worst time
    assert swing[-200:].max() <= swing[:200].max() * 1.001


@pytest.mark.parametrize("stiffness", [40.0, 400.0])
def test_contact_moment_at_a_pole_is_stiffness_times_error(gate: RobotDescription, stiffness: float) -> None:
    """A set-point behind a pole: K times the position error is the moment of the contact, without noise."""
    pole = {"fixed_start": [[0.9, 0.3, 0.0]], "fixed_end": [[0.9, 0.3, 2.0]], "fixed_radius": [[0.05, 0.05]]}
    stand = Stand(gate, fixed_organ=[int(Organ.POLE)], **pole)
    stand.robot.command_impedance([stiffness], [0.4 * np.sqrt(stiffness)])
    stand.robot.command_position([0.6])
    stand.run(6.0)
    moments = []
    for _ in range(100):
        angle = stand.run(DT)[-1, 0]
        moments.append(stand.rigid.joint_measurements("anna")[3][0])
    touching = np.arctan2(0.3, 0.9) - np.arcsin(0.08 / np.hypot(0.3, 0.9))
    assert angle == pytest.approx(touching, abs=5e-4)
    assert -moments[-1] == pytest.approx(stiffness * (0.6 - angle), rel=1e-5)
    assert np.ptp(moments) < 1e-3 * abs(moments[-1])


def test_a_whole_arm_deflects_by_f_over_k(vinebot: RobotDescription) -> None:
    """All seven joints compliant: K times deflection is J^T F where the arm comes to rest."""
    stand = Stand(vinebot)
    joints = stand.robot.joint_indices(ARM)
    stiffness = np.array([60.0, 60.0, 40.0, 40.0, 15.0, 15.0, 15.0])
    stand.robot.command_impedance(stiffness, 0.25 * stiffness, joints)
    start = stand.run(0.1)[-1, joints]
    force = np.array([4.0, -3.0, 5.0])
    stand.push("arm_left_7_link", force)
    end = stand.run(8.0)[-1, joints]
    moment = (stand.lever("arm_left_7_link").T @ force)[joints]
    assert np.abs(end - start).max() > 0.03
    np.testing.assert_allclose(stiffness * (end - start), moment, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("joint", "stiffness", "zeta"), [(0, 80.0, 0.08), (3, 30.0, 0.15), (5, 40.0, 0.25)])
def test_a_joint_of_an_arm_oscillates_as_commanded(
    vinebot: RobotDescription, joint: int, stiffness: float, zeta: float
) -> None:
    """The robot's own hinge friction (URDF) adds to the commanded damping; inertia from the URDF and the rotor."""
    stand = Stand(vinebot)
    name = ARM[joint]
    inertia = inertia_about(vinebot, name) + next(d.armature for d in vinebot.drives if d.joint == name)
    friction = next(
        float(measured.find("dynamics").get("damping"))
        for measured in ElementTree.fromstring(vinebot.urdf).iterfind("joint")
        if measured.get("name") == name
    )
    total = 2.0 * zeta * np.sqrt(stiffness * inertia)
    stand.robot.command_impedance([stiffness], [total - friction], [name])
    i = stand.robot.joint_indices([name])[0]
    start = vinebot.home.copy()
    start[i] += 0.05
    stand.rigid.place_robot("anna", np.array([0, 0, 0, 0, 0, 0, 1.0]), start)
    swing = stand.run(14.0 * np.sqrt(inertia / stiffness))[:, i] - vinebot.home[i]
    measured = decrement(swing)
    desired = expected(stiffness, total, inertia)
    assert measured[0] == pytest.approx(desired[0], rel=0.02)
    assert measured[1] == pytest.approx(desired[1], rel=0.02)


def inertia_about(description: RobotDescription, joint: str) -> float:
    """[kg m2] of all that a joint carries at home, about its axis, from the URDF's text."""
    root = ElementTree.fromstring(description.urdf)
    poses = description.link_poses(description.home)
    joints = {measured.get("name"): measured for measured in root.iterfind("joint")}
    carried = {joints[joint].find("child").get("link")}
    while (
        children := {
            measured.find("child").get("link")
            for measured in joints.values()
            if measured.find("parent").get("link") in carried
        }
        - carried
    ):
        carried |= children
    pose = poses[joints[joint].find("child").get("link")]
    axis = frames.rotate(pose[3:], np.array(joints[joint].find("axis").get("xyz").split(), float))
    total = 0.0
    for link in root.iterfind("link"):
        inertial = link.find("inertial")
        if link.get("name") not in carried or inertial is None:
            continue
        mass = float(inertial.find("mass").get("value"))
        tensor = inertial.find("inertia")
        at = poses[link.get("name")]
        centre = at[:3] + frames.rotate(at[3:], np.array(inertial.find("origin").get("xyz").split(), float))
        xx, yy, zz, xy, xz, yz = (float(tensor.get(key)) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))
        own = frames.rotate(frames.conjugate(at[3:]), axis)
        total += own @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ own
        arm = centre - pose[:3]
        total += mass * (arm @ arm - (arm @ axis) ** 2)
    return float(total)


# ---------------------------------------------------------------------- F20: a series elastic element per joint


def test_behind_a_locked_motor_the_gate_oscillates_on_its_spring(gate: RobotDescription) -> None:
    stand = Stand(gate)
    inertia = GATE_INERTIA + ROTOR
    stand.robot.command_motor_position([0.0])
    stand.rigid.place_robot("anna", np.array([0, 0, 0, 0, 0, 0, 1.0]), np.array([0.2]))
    swing = stand.run(3.0)[:, 0]
    measured = decrement(swing)
    desired = expected(150.0, 3.0, inertia)
    assert measured[0] == pytest.approx(desired[0], rel=0.02)
    assert measured[1] == pytest.approx(desired[1], rel=0.02)


def test_spring_torque_is_the_load_and_deflection_is_load_over_k(vinebot: RobotDescription) -> None:
    """Locked motors behind their springs: each joint carries its weight and a push, known from the URDF alone."""
    stand = Stand(vinebot)
    joints = stand.robot.joint_indices(ARM)
    motor = vinebot.home[joints]
    stand.robot.command_motor_position(motor, joints)
    force = np.array([0.0, 10.0, -15.0])
    stand.push("arm_left_7_link", force)
    stand.run(4.0)
    elements = stand.robot.sample(stand.time).elements
    pushed = stand.lever("arm_left_7_link").T @ force
    load = np.array([weight_beyond(stand, name) for name in ARM]) - pushed[joints]
    assert np.abs(load).max() > 10.0
    np.testing.assert_allclose(elements.torque[joints], load, rtol=1e-5, atol=1e-5)
    position = stand.rigid.joint_measurements("anna")[0][joints]
    springs = np.array([d.series_stiffness or d.stiffness for d in vinebot.drives])[joints]
    np.testing.assert_allclose(springs * (motor - position), load, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(elements.motor[joints], motor, atol=1e-7)
    np.testing.assert_array_equal(elements.torque, elements.stiffness * elements.deflection)
    assert elements.names == vinebot.joints


def test_motor_command_is_followed_by_the_link(gate: RobotDescription) -> None:
    stand = Stand(gate)
    stand.robot.command_motor_position([0.4])
    stand.run(12.0)
    elements = stand.robot.sample(stand.time).elements
    assert stand.rigid.joint_measurements("anna")[0][0] == pytest.approx(0.4, abs=1e-5)
    assert elements.motor[0] == pytest.approx(0.4, abs=1e-5)
    stand.push("leaf", np.array([0.0, 20.0, 0.0]))  # rotated by 0.4 rad: its lever is 0.5 cos
    stand.run(12.0)
    elements = stand.robot.sample(stand.time).elements
    angle = stand.rigid.joint_measurements("anna")[0][0]
    assert elements.torque[0] == pytest.approx(-20.0 * 0.5 * np.cos(angle), rel=1e-5)
    assert angle - 0.4 == pytest.approx(20.0 * 0.5 * np.cos(angle) / 150.0, rel=1e-5)


# ---------------------------------------------------------------------- F15, F17: effort and stiffness under a push


def test_effort_is_weight_less_j_transposed_f(vinebot: RobotDescription) -> None:
    stand = Stand(vinebot)
    force = np.array([-20.0, 30.0, 25.0])
    stand.push("arm_left_7_link", force)
    stand.run(3.0)
    effort = stand.rigid.joint_measurements("anna")[2]
    moment = stand.lever("arm_left_7_link").T @ force
    for name in ("torso_lift_joint", *ARM):
        i = stand.robot.joint_indices([name])[0]
        assert effort[i] == pytest.approx(weight_beyond(stand, name) - moment[i], rel=1e-5, abs=1e-5), name


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, 1, 0), (0, 0, -1)])
def test_pose_is_held_against_50_newtons(vinebot: RobotDescription, direction: tuple[int, int, int]) -> None:
    """F17: at rest every servo's stiffness times its deflection is J^T F, that of the base included; and back after
    it."""
    stand = Stand(vinebot)
    link = "arm_left_7_link"
    start = stand.run(0.2)[-1]
    base = stand.rigid.base_state("anna")[0]
    place = stand.robot.frame_pose(link)[:3]
    force = 50.0 * np.array(direction, float)
    stand.push(link, force)
    end = stand.run(2.0)[-1]
    stiffness = np.array([d.stiffness for d in vinebot.drives])
    np.testing.assert_allclose(stiffness * (end - start), stand.lever(link).T @ force, rtol=1e-6, atol=1e-6)
    base_stiffness = vinebot.base_limits.effort[0] / stand.rigid.parameters.base_slip
    offset = stand.rigid.base_state("anna")[0][:2] - base[:2]
    np.testing.assert_allclose(base_stiffness * offset, force[:2], rtol=1e-6, atol=1e-6)
    assert 1e-4 < np.linalg.norm(stand.robot.frame_pose(link)[:3] - place) < 3e-3
    stand.push(link, np.zeros(3))
    back = stand.run(2.0)[-1]
    np.testing.assert_allclose(back, start, atol=1e-9)
