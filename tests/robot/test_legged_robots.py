"""A robot on legs has a free base: its feet carry its weight, and it obeys the laws of momentum (docs/robots.md)."""

from __future__ import annotations

import logging
import math
import pathlib
import re

import mujoco
import numpy as np
import pytest

import vinesim
from tests.support.robot_yard import Yard
from tests.support.terrain_scenes import incline
from vinesim.client.client import Client
from vinesim.client.tasks.ros_command_handler import RosCommandHandler
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.control.controller_manager import ControllerManager
from vinesim.robot.control.trajectory_controller import Trajectory
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.packages import find_installed
from vinesim.robot.description.urdf import DescriptionError
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.ros.commands.types import BaseVelocity
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
from vinesim.scene.values import ControllerKind

GRAVITY = 9.81
TRUNK = 10.0
LEG = 1.0
WEIGHT = (TRUNK + 4.0 * LEG) * GRAVITY
FOOT = 0.02
"""Radius of a foot [m]."""
EFFORT = 60.0
"""Effort limit of a leg [N]."""
LEGS = {"fl": (0.2, 0.1), "fr": (0.2, -0.1), "hl": (-0.2, 0.1), "hr": (-0.2, -0.1)}
FLOATING = '<link name="world"/><joint name="free" type="floating"><parent link="world"/><child link="trunk"/></joint>'


def inertial(mass: float) -> str:
    moment = 0.01 * mass
    return (
        f'<inertial><mass value="{mass}"/><inertia ixx="{moment}" iyy="{moment}" izz="{moment}" ixy="0" ixz="0" '
        'iyz="0"/></inertial>'
    )


def dog(file: pathlib.Path, root: str = FLOATING, legs: dict[str, tuple[float, float]] = LEGS, more: str = "") -> str:
    """Path of a robot whose legs slide up and down in its trunk."""
    box = '<geometry><box size="0.5 0.25 0.1"/></geometry>'
    parts = [f'<link name="trunk">{inertial(TRUNK)}<visual>{box}</visual><collision>{box}</collision></link>']
    for leg, (x, y) in legs.items():
        ball = f'<collision><origin xyz="0 0 -0.2"/><geometry><sphere radius="{FOOT}"/></geometry></collision>'
        parts.append(f'<link name="{leg}_leg">{inertial(LEG)}{ball}</link>')
        parts.append(
            f'<joint name="{leg}" type="prismatic"><origin xyz="{x} {y} -0.05"/><parent link="trunk"/>'
            f'<child link="{leg}_leg"/><axis xyz="0 0 1"/><limit lower="-0.06" upper="0.06" effort="{EFFORT}" '
            'velocity="0.5"/></joint>'
        )
    file.write_text(f'<robot name="dog">{root}{"".join(parts)}{more}</robot>')
    return str(file)


@pytest.fixture
def described(tmp_path: pathlib.Path) -> RobotDescription:
    return load_description(dog(tmp_path / "dog.urdf"))


def feet_force(yard: Yard) -> np.ndarray:
    """Total force of the ground on the feet in the last step [3] N; only feet touch the ground."""
    m, d = yard.rigid.mj_model, yard.rigid.mj_data
    total = np.zeros(3)
    for number, contact in enumerate(d.contact):
        links = {yard.rigid.owners[int(body)][1] for body in m.geom_bodyid[contact.geom] if body != 0}
        assert {link[2:] for link in links} == {"_leg"}
        force = np.zeros(6)
        mujoco.mj_contactForce(m, d, number, force)
        sign = 1.0 if m.geom_bodyid[contact.geom[0]] == 0 else -1.0
        total += sign * force[:3] @ contact.frame.reshape(3, 3)
    return total


def tilt(pose: np.ndarray) -> float:
    """Angle [rad] between the z axis of a pose [7] and the vertical."""
    return float(np.arccos(min(frames.to_matrix(pose[3:])[2, 2], 1.0)))


# ---------------------------------------------------------------------- standing


def test_a_quadruped_stands_on_its_springs(described: RobotDescription) -> None:
    """Law: at rest each leg's servo carries a quarter of the weight, so the trunk is lower by that force over the
    stiffness; the feet carry the whole weight, and the legs the trunk."""
    yard = Yard(described)
    yard.run(2.0)
    early = yard.rigid.base_state("anna")[0]
    rows = yard.run(3.0)
    pose, velocity = yard.rigid.base_state("anna")
    sag = WEIGHT / 4.0 / described.drives[0].stiffness
    assert sag > 2e-3
    assert pose[2] == pytest.approx(-sag, abs=3e-4)  # and the feet are pressed into the ground
    np.testing.assert_allclose(rows[-1, 0], sag, rtol=0.01)
    np.testing.assert_allclose(rows[-1, 2], -TRUNK * GRAVITY / 4.0, rtol=0.01)
    np.testing.assert_allclose(feet_force(yard), [0.0, 0.0, WEIGHT], rtol=0.01, atol=0.01 * WEIGHT)
    np.testing.assert_allclose(pose, early, atol=1e-5)  # it neither sinks nor creeps
    assert tilt(pose) < 1e-3
    assert np.abs(velocity).max() < 1e-4


def test_a_push_changes_the_momentum_by_its_impulse(described: RobotDescription) -> None:
    """Law: momentum = impulses of push, ground and weight. The push lifts the robot; while it flies, only its weight
    acts."""
    yard = Yard(described)
    yard.run(1.0)
    rigid, dt = yard.rigid, yard.rigid.dt
    joint = rigid.robot("anna").free_base
    assert joint is not None
    total = rigid.mj_model.body_subtreemass[rigid.robot("anna").bodies[described.base]]
    assert total * GRAVITY == pytest.approx(WEIGHT, rel=1e-6)

    def momentum() -> np.ndarray:
        m, d = rigid.mj_model, rigid.mj_data
        rigid.update_kinematics()
        mujoco.mj_comVel(m, d)
        mujoco.mj_subtreeVel(m, d)
        return total * d.subtree_linvel[rigid.robot("anna").bodies[described.base]]

    before = momentum()
    ground = np.zeros(3)
    push = np.array([40.0, -25.0, 900.0])
    steps = 6
    for step in range(25):
        rigid.apply_wrench("anna", "trunk", push if step < steps else np.zeros(3))
        yard.run(dt)
        ground += dt * rigid.contact_force[joint.v[:3]]
        impulse = push * dt * min(step + 1, steps)
        expected = before + impulse + ground - [0.0, 0.0, (step + 1) * dt * WEIGHT]
        np.testing.assert_allclose(momentum(), expected, atol=0.01 * np.linalg.norm(push * dt * steps))
    assert rigid.mj_data.ncon == 0  # it flies
    yard.run(3.0)
    assert tilt(rigid.base_state("anna")[0]) < 0.01  # it landed on its feet


def test_two_runs_are_equal_to_the_bit(described: RobotDescription) -> None:
    ends = []
    for _ in range(2):
        yard = Yard(described)
        yard.rigid.apply_wrench("anna", "trunk", np.array([30.0, 10.0, 0.0]))
        yard.run(2.0)
        ends.append((yard.rigid.mj_data.qpos.tobytes(), yard.rigid.mj_data.qvel.tobytes()))
    assert ends[0] == ends[1]


def test_a_quadruped_stands_on_a_slope(described: RobotDescription) -> None:
    """Friction holds it: the ground's force is vertical, and the trunk is as steep as the ground."""
    slope = 0.1
    yard = Yard(described, terrain=incline(slope))
    yard.run(2.0)
    early = yard.rigid.base_state("anna")[0]
    yard.run(3.0)
    pose = yard.rigid.base_state("anna")[0]
    np.testing.assert_allclose(feet_force(yard), [0.0, 0.0, WEIGHT], atol=0.01 * WEIGHT)
    assert tilt(pose) == pytest.approx(math.atan(slope), abs=5e-3)
    np.testing.assert_allclose(pose[:3], early[:3], atol=1e-4)


def test_the_feet_carry_what_lies_on_the_robot(described: RobotDescription) -> None:
    """A cane is bent down by the trunk: the force of the feet exceeds the weight by the force of the cane."""
    cane = vinesim.CaneBuilder(pose=(-0.6, 0.0, 0.34, 0.0, 0.0, 0.0, 1.0), length=1.2, tip_mass=0.3, damping_ratio=0.3)
    simulation = vinesim.Simulation(cane, sleep=False)
    robot = simulation.add_robot(described.file, name="anna")
    simulation.step(500)
    contacts = [one for one in simulation.physics.contacts if one.actor == "anna"]
    load = sum(one.force[2] for one in contacts)
    joint = simulation.physics.rigid.robot("anna").free_base
    assert joint is not None
    feet = simulation.physics.rigid.contact_force[joint.v[2]] - load  # of all contacts, less those with plants
    assert load < -0.5
    assert feet == pytest.approx(WEIGHT - load, rel=0.01)
    assert tilt(robot.sample(simulation.time).base_q) < 0.02


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("anymal", "anymal_b_simple_description/robots/anymal.urdf"),
        ("go1", "go1_description/urdf/go1.urdf"),
        ("solo12", "solo_description/robots/solo12.urdf"),
    ],
)
def test_quadrupeds_of_the_package_example_robot_data_stand(name: str, file: str) -> None:
    found = find_installed(f"example-robot-data/robots/{file}")
    if found is None:
        pytest.skip("example-robot-data is not installed")
    described = load_description(found, base="free")
    yard = Yard(described)
    yard.run(1.0)
    early = yard.rigid.base_state("anna")[0]
    yard.run(4.0)
    pose = yard.rigid.base_state("anna")[0]
    joint = yard.rigid.robot("anna").free_base
    assert joint is not None
    weight = GRAVITY * yard.rigid.mj_model.body_subtreemass[yard.rigid.robot("anna").bodies[described.base]]
    assert yard.rigid.contact_force[joint.v[2]] == pytest.approx(weight, rel=0.01)
    assert tilt(pose) < 0.01
    np.testing.assert_allclose(pose[:3], early[:3], atol=1e-3)
    assert abs(pose[2]) < 0.01


# ---------------------------------------------------------------------- which base

MJCF = """<mujoco model="crab"><worldbody><body name="trunk" pos="0 0 0.5">{free}<geom type="box" size="0.2 0.1 0.05"/>
<body name="left" pos="0 0.1 0"><joint name="l" axis="1 0 0" range="-1 1"/><geom size="0.03" pos="0 0 -0.2"/></body>
<body name="right" pos="0 -0.1 0"><joint name="r" axis="1 0 0" range="-1 1"/><geom size="0.03" pos="0 0 -0.2"/></body>
</body></worldbody></mujoco>"""
SDF = """<sdf version="1.8"><model name="crab">{static}<link name="trunk"><collision name="c"><geometry><box>
<size>0.4 0.2 0.1</size></box></geometry></collision></link>
<link name="left"><pose>0 0.1 0 0 0 0</pose><collision name="c"><pose>0 0 -0.2 0 0 0</pose><geometry><sphere>
<radius>0.03</radius></sphere></geometry></collision></link><link name="right"><pose>0 -0.1 0 0 0 0</pose><collision
name="c"><pose>0 0 -0.2 0 0 0</pose><geometry><sphere><radius>0.03</radius></sphere></geometry></collision></link>
<joint name="l" type="revolute"><parent>trunk</parent><child>left</child><axis><xyz>1 0 0</xyz></axis></joint>
<joint name="r" type="revolute"><parent>trunk</parent><child>right</child><axis><xyz>1 0 0</xyz></axis></joint>
</model></sdf>"""


def test_the_robot_file_says_how_the_base_moves(tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture) -> None:
    def kind(text: str, name: str, base: str = "auto") -> str:
        (tmp_path / name).write_text(text)
        return load_description(tmp_path / name, base=base).base_limits.kind

    assert load_description(dog(tmp_path / "a.urdf")).base_limits.kind == "free"
    bare = dog(tmp_path / "b.urdf", root="")
    assert load_description(bare).base_limits.kind == "planar"
    assert "stands on legs, 'fl_leg' (and 3 more): with --base free" in caplog.text
    assert load_description(bare, base="free").base_limits.kind == "free"
    assert load_description(bare, base="fixed").base_limits.linear == 0.0
    (tmp_path / "b.toml").write_text('[base]\nkind = "free"\n')
    assert load_description(bare).base_limits.kind == "free"
    assert load_description(bare, base="planar").base_limits.kind == "planar"
    (tmp_path / "c.srdf").write_text(
        '<robot name="dog"><virtual_joint name="v" type="floating" parent_frame="odom" child_link="trunk"/></robot>'
    )
    assert load_description(dog(tmp_path / "c.urdf", root="")).base_limits.kind == "free"
    assert load_description(dog(tmp_path / "d.urdf", legs={"fl": (0.0, 0.0)})).base_limits.kind == "planar"
    assert kind(MJCF.format(free="<freejoint/>"), "e.xml") == "free"
    assert kind(MJCF.format(free=""), "f.xml") == "fixed"
    assert kind(SDF.format(static=""), "g.sdf") == "free"
    assert kind(SDF.format(static="<static>1</static>"), "h.sdf") == "fixed"


def test_a_robot_with_wheels_is_driven(tmp_path: pathlib.Path) -> None:
    wheels = dog(tmp_path / "a.urdf")
    file = pathlib.Path(wheels)
    text = file.read_text()
    for leg in LEGS:
        text = text.replace(f'name="{leg}"', f'name="{leg}_wheel"')
    file.write_text(text)
    assert load_description(file).base_limits.kind == "planar"
    notes = load_description(file, base="free").notes
    assert any("wheels do not turn" in note for note in notes)


def test_what_cannot_be_is_told_in_one_line(tmp_path: pathlib.Path) -> None:
    bolted = '<link name="world"/><joint name="j" type="fixed"><parent link="world"/><child link="trunk"/></joint>'
    file = dog(tmp_path / "a.urdf", root=bolted)
    with pytest.raises(
        DescriptionError, match=r"bolts it down to 'world', so its base cannot be free; remove"
    ) as caught:
        load_description(file, base="free")
    assert "\n" not in str(caught.value)
    airy = pathlib.Path(dog(tmp_path / "b.urdf"))
    airy.write_text(re.sub("<collision>.*?</collision>", "", airy.read_text()))
    assert load_description(airy).base_limits.kind == "planar"
    with pytest.raises(DescriptionError, match="nothing of it collides"):
        load_description(airy, base="free")
    with pytest.raises(DescriptionError, match="the base is 'loose'; give auto, planar, free, fixed"):
        load_description(file, base="loose")


# ---------------------------------------------------------------------- commands and other clients


def test_wheels_are_refused_and_legs_obey(described: RobotDescription, caplog: pytest.LogCaptureFixture) -> None:
    yard = Yard(described)
    with pytest.raises(CommandError, match="anna stands on its legs: it has no wheels"):
        yard.robot.command_base(0.2, 0.0, 0.0)
    handler = RosCommandHandler(yard.robot, lambda: [BaseVelocity(0.0, np.array([0.2, 0.0, 0.0]), np.zeros(3))])
    with caplog.at_level(logging.WARNING):
        handler(0.0)
        handler(0.01)
    assert handler.rejected_count == 2
    assert caplog.text.count("it has no wheels to drive; command its joints") == 1

    controllers = ControllerManager(yard.robot)
    legs = [one for one in described.controllers if one.kind is ControllerKind.JOINT_TRAJECTORY]
    assert sorted(joint for leg in legs for joint in leg.joints) == sorted(LEGS)
    for leg in legs:
        goal = np.full((1, len(leg.joints)), -0.02)
        controllers.start_trajectory(leg.name, Trajectory(leg.joints, np.array([1.0]), goal, None), yard.time)
    for _ in range(300):
        controllers(yard.time)
        yard.run(yard.rigid.dt)
    pose = yard.rigid.base_state("anna")[0]
    sag = WEIGHT / 4.0 / described.drives[0].stiffness
    assert pose[2] == pytest.approx(0.02 - sag, abs=5e-4)  # the legs lift the trunk
    sample = yard.robot.sample(yard.time)
    np.testing.assert_allclose(sample.odom_q, pose, atol=1e-9)
    assert sample.odom_is_spatial


def test_another_client_sees_the_robot_stand_and_tip(described: RobotDescription) -> None:
    """The copy has the pose of the robot in all six degrees of freedom, though it does not know the robot's file."""
    scene = load_scene("demo")
    model = generate(scene)
    hub = MemoryHub(delay=0.02)
    now = 100.0
    start = spawn_pose(scene, 0, 3.0)

    def join(name: str, description: RobotDescription, pose: np.ndarray) -> Client:
        return Client(scene, model, description, hub.bus(name), name=name, pose=pose, clock=lambda: now)

    walker = join("walker", described, start)
    visitor = join("visitor", load_description("vinebot"), spawn_pose(scene, 1))

    def until(seconds: float) -> None:
        nonlocal now
        for _ in range(round(seconds / 0.01)):
            walker.tick()
            visitor.tick()
            hub.advance(0.01)
            now += 0.01

    def compare() -> np.ndarray:
        own, copy = (one.physics.rigid.base_state("walker")[0] for one in (walker, visitor))
        np.testing.assert_allclose(copy[:3], own[:3], atol=2e-3)
        away = frames.log(frames.multiply(frames.conjugate(own[3:]), copy[3:]))
        assert np.linalg.norm(away) < 5e-3
        return own

    until(2.0)
    assert "walker" in visitor.remote_actors
    level = compare()
    walker.robot.command_position([0.05, 0.05], ["fl", "fr"])  # the front legs are drawn in
    until(2.0)
    nose_down = compare()
    assert tilt(nose_down) == pytest.approx(0.05 / 0.4, rel=0.1)
    assert nose_down[2] < level[2] - 0.01
