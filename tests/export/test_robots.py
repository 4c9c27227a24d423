"""Robots in an exported MJCF: MuJoCo has their masses and joints, and they rest as in vinesim."""

from __future__ import annotations

import pathlib
import subprocess
import sys

import mujoco
import numpy as np
import pytest

import vinesim
from tests.export.scenes import one_vine
from tests.robot.test_legged_robots import dog
from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.rigid.urdf import RobotError

PLACE = (3.0, -2.0, 0.7)
"""x, y [m] and yaw [rad] of the robot, beside the vine."""


@pytest.mark.parametrize("kind", ["vinebot", "dog"])
def test_a_robot_rests_beside_the_plants_as_in_vinesim(kind: str, tmp_path: pathlib.Path) -> None:
    name = dog(tmp_path / "dog.urdf") if kind == "dog" else kind
    model = one_vine()
    file = tmp_path / "vineyard.xml"
    vinesim.export_vineyard(model, file, robots={"anna": (name, PLACE)})
    world = mujoco.MjModel.from_xml_path(str(file))
    simulation = vinesim.Simulation(model)
    robot = simulation.add_robot(name, PLACE, name="anna")
    rigid = simulation.physics.rigid
    links = rigid.robot("anna").bodies

    here = [world.body(f"anna/{link}").id for link in links]
    there = list(links.values())
    np.testing.assert_allclose(world.body_mass[here], rigid.mj_model.body_mass[there], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(world.body_inertia[here], rigid.mj_model.body_inertia[there], rtol=1e-6, atol=1e-12)
    joints = {world.joint(i).name for i in range(world.njnt)}
    assert {f"anna/{joint}" for joint in robot.description.joints} <= joints
    assert world.nu == len(robot.description.joints) + (0 if kind == "dog" else 3)

    data = mujoco.MjData(world)
    mujoco.mj_resetDataKeyframe(world, data, world.key("home").id)
    plants = [i for i in range(1, world.nbody) if not world.body(i).name.startswith("anna")]
    mujoco.mj_forward(world, data)
    drawn = data.xpos[plants].copy()
    for _ in range(round(2.0 / world.opt.timestep)):
        mujoco.mj_step(world, data)
    simulation.step(200)
    rigid.update_kinematics()
    np.testing.assert_allclose(data.xpos[here], rigid.mj_data.xpos[there], atol=1e-3)
    turned = frames.multiply(
        frames.conjugate(frames.from_wxyz(rigid.mj_data.xquat[there])), frames.from_wxyz(data.xquat[here])
    )
    assert np.linalg.norm(frames.log(turned), axis=-1).max() < 2e-3
    position = [data.qpos[world.jnt_qposadr[world.joint(f"anna/{joint}").id]] for joint in robot.description.joints]
    np.testing.assert_allclose(position, rigid.joint_state("anna")[0], atol=1e-3)
    np.testing.assert_allclose(data.xpos[plants], drawn, atol=1e-3)  # the plants beside it rest, too


def test_a_robot_touches_plants_and_its_meshes_are_in_the_file(tmp_path: pathlib.Path) -> None:
    file = tmp_path / "cane.xml"
    vinesim.export_vineyard(vinesim.CaneBuilder(), file, robots={"anna": ("vinebot", PLACE)})
    world = mujoco.MjModel.from_xml_path(str(file))
    shape = world.body("anna/base_lidar_link").geomadr[0]
    cane = next(i for i in range(world.ngeom) if world.body(world.geom_bodyid[i]).name.startswith("cane"))
    ground = world.geom("ground").id

    def collide(a: int, b: int) -> bool:
        types, affinities = world.geom_contype, world.geom_conaffinity
        return bool((types[a] & affinities[b]) | (types[b] & affinities[a]))

    assert collide(shape, cane)
    assert collide(cane, ground)
    chassis = world.body("anna/base_link").geomadr[0]
    assert collide(chassis, cane)
    assert not collide(chassis, ground)
    assert "file=" not in file.read_text()


def test_what_cannot_be_written_is_told_in_one_line(tmp_path: pathlib.Path) -> None:
    for suffix in ("urdf", "usda"):
        with pytest.raises(UsageError, match=r"MJCF \(\.xml\) only"):
            vinesim.export_vineyard(
                vinesim.CaneBuilder(), tmp_path / f"cane.{suffix}", robots={"anna": ("vinebot", PLACE)}
            )
    from tests.export.scenes import vine_on_a_slope

    with pytest.raises(RobotError, match="uneven ground"):
        vinesim.export_vineyard(vine_on_a_slope(), tmp_path / "slope.xml", robots={"anna": ("vinebot", PLACE)})


def test_the_command_writes_a_robot(tmp_path: pathlib.Path) -> None:
    arguments = ("export", "tendone", "--robot", f"{dog(tmp_path / 'dog.urdf')}@1.5,0.4,0", "--out", "with.xml")
    done = subprocess.run([sys.executable, "-m", "vinesim", *arguments], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "with.xml").read_text()
    assert 'name="robot_0/trunk"' in text
