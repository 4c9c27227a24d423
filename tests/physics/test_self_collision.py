"""Robots collide with themselves and with the ground: where an arm stops, and which links never touch."""

from __future__ import annotations

import pathlib

import numpy as np
import pytest

from tests.support.robot_yard import Yard
from vinesim.rigid.mujoco_contacts import disabled_pairs
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.urdf import DescriptionError
from vinesim.scene.builder import assemble

BOX = '<collision><origin xyz="{at}"/><geometry><box size="{size}"/></geometry></collision>'
TORSO_FACE = 0.2
ARM_HALF = 0.05


def _link(name: str, shape: str) -> str:
    inertia = '<inertia ixx="0.05" iyy="0.05" izz="0.05" ixy="0" ixz="0" iyz="0"/>'
    return f'<link name="{name}"><inertial><mass value="3"/>{inertia}</inertial>{shape}</link>'


def _joint(name: str, parent: str, child: str, at: str, axis: str, kind: str = "revolute") -> str:
    limit = '<limit lower="-3" upper="3" effort="40" velocity="2"/>'
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>'
        f'<axis xyz="{axis}"/>{limit}</joint>'
    )


def robot_file(folder: pathlib.Path, arm_at: float = 0.5) -> pathlib.Path:
    """A torso, a carriage beside it, and an arm on the carriage that slides along x: to the torso and away from it."""
    file = folder / "slider.urdf"
    arm = BOX.format(at="0 0 0", size=f"{2 * ARM_HALF} 0.1 0.1")
    file.write_text(
        '<robot name="slider">'
        + _link("torso", BOX.format(at="0 0 0.5", size=f"{2 * TORSO_FACE} 0.4 1"))
        + _link("carriage", "")
        + _link("arm", arm)
        + _joint("lift", "torso", "carriage", f"{arm_at} 0 0.5", "0 0 1", "prismatic")
        + _joint("reach", "carriage", "arm", "0 0 0", "1 0 0", "prismatic")
        + "</robot>"
    )
    (folder / "slider.toml").write_text(
        '[groups.arm]\njoints = ["lift", "reach"]\nstiffness = [2e4, 2e4]\ndamping = [800, 800]\nhome = [0, 0]\n'
    )
    return file


def test_an_arm_that_is_commanded_through_the_torso_stops_at_it_and_pushes_with_its_effort(
    tmp_path: pathlib.Path,
) -> None:
    """Within 2 mm of the surface, and 40 N, as much as its drive has."""
    yard = Yard(load_description(robot_file(tmp_path)))
    yard.robot.command_position([0.0, -0.45])
    yard.run(3.0)
    position, velocity, effort, contact = yard.rigid.joint_measurements("anna")
    surface = TORSO_FACE + ARM_HALF - 0.5
    assert position[1] == pytest.approx(surface, abs=2e-3)
    assert abs(velocity[1]) < 1e-3
    assert effort[1] == pytest.approx(-40.0, abs=0.01)
    assert contact[1] == pytest.approx(40.0, abs=0.1)


def test_an_arm_that_is_commanded_through_the_ground_stops_at_it(tmp_path: pathlib.Path) -> None:
    yard = Yard(load_description(robot_file(tmp_path)))
    yard.robot.command_position([-0.8, 0.0])
    yard.run(3.0)
    assert yard.rigid.link_pose("anna", "arm")[2] == pytest.approx(ARM_HALF, abs=2e-3)


def test_links_that_overlap_at_home_do_not_touch(tmp_path: pathlib.Path) -> None:
    """Neither where they overlap nor anywhere else: nothing would hold the arm where it is put."""
    yard = Yard(load_description(robot_file(tmp_path, arm_at=0.24)))
    yard.robot.command_position([0.0, -0.1])
    rows = yard.run(1.0)
    assert yard.rigid.mj_data.ncon == 0
    assert rows[-1, 0, 1] == pytest.approx(-0.1, abs=1e-4)


@pytest.mark.parametrize("named", [False, True])
def test_pairs_of_an_srdf_do_not_touch(named: bool, tmp_path: pathlib.Path) -> None:
    """Whether it has the URDF's name or the TOML file names it; pairs of links that the robot lacks change nothing."""
    file = robot_file(tmp_path)
    srdf = tmp_path / ("other.srdf" if named else "slider.srdf")
    pairs = "".join(
        f'<disable_collisions link1="{a}" link2="{b}" reason="Never"/>' for a, b in (("arm", "torso"), ("arm", "x"))
    )
    srdf.write_text(f'<robot name="slider">{pairs}</robot>')
    if named:
        toml = tmp_path / "slider.toml"
        toml.write_text('srdf = "other.srdf"\n' + toml.read_text())
    description = load_description(file)
    assert disabled_pairs(description.urdf) == [("arm", "torso")]
    assert any("1 more name" in note for note in description.notes)
    yard = Yard(description)
    yard.robot.command_position([0.0, -0.45])
    assert yard.run(3.0)[-1, 0, 1] == pytest.approx(-0.45, abs=1e-3)


def test_an_srdf_that_is_missing_is_named(tmp_path: pathlib.Path) -> None:
    file = robot_file(tmp_path)
    (tmp_path / "slider.toml").write_text('srdf = "lost.srdf"')
    with pytest.raises(DescriptionError, match=r"lost\.srdf.*missing"):
        load_description(file)


def test_a_copy_does_not_collide_with_itself(tmp_path: pathlib.Path) -> None:
    """It is drawn to the states that its own client sends, where its contacts are counted."""
    yard = Yard(load_description(robot_file(tmp_path), is_remote=True))
    yard.rigid.command("anna", np.array([0.0, -0.45]))
    yard.run(0.5)
    assert yard.rigid.mj_data.ncon == 0


@pytest.mark.parametrize("name", ["vinebot", "logistic"])
def test_robots_of_the_project_touch_neither_themselves_nor_the_ground_at_home(name: str) -> None:
    rigid = RigidWorld(assemble([]))
    rigid.add_robot(load_description(name).to_spec("anna"))
    for _ in range(20):
        rigid.predict()
        rigid.integrate()
    assert rigid.mj_data.ncon == 0
    assert not rigid.contact_force.any()


def test_an_arm_of_the_vinebot_does_not_pass_through_its_torso() -> None:
    """Commanded from one side to a place inside the torso, no pair of links overlaps by more than 2 mm in the end."""
    yard = Yard(load_description("vinebot"))
    description = yard.robot.description
    inside = description.home.copy()
    arm = description.joint_indices("arm_left")
    inside[arm[2:4]] = -1.5, 2.3
    yard.robot.command_position(inside)
    yard.run(3.0)
    m = yard.rigid.mj_model
    d = yard.rigid.mj_data
    touching = {m.body(m.geom_bodyid[geom]).name for geom in d.contact.geom.ravel()}
    assert any("torso" in name for name in touching), touching
    assert d.contact.dist.min() > -2e-3
