"""The exported URDF: masses, places and axes as in the model, in MuJoCo's and yourdfpy's readers."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import mujoco
import numpy as np
import pytest
import yourdfpy

import vinesim
from tests.export.scenes import bent_cane, bodies_of, one_vine
from tests.support.clustered_trees import clustered
from vinesim.core import frames

OPTIONS = {"fusestatic": "false", "strippath": "false", "balanceinertia": "false", "discardvisual": "true"}


@pytest.mark.parametrize("make", [bent_cane, clustered, one_vine])
def test_masses_and_places_are_those_of_the_model(make, tmp_path):
    model = make()
    file = tmp_path / "vineyard.urdf"
    vinesim.export_vineyard(model, file)
    root = ElementTree.parse(file).getroot()
    ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler", OPTIONS)
    world = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    data = mujoco.MjData(world)
    mujoco.mj_forward(world, data)
    names = [world.body(i).name for i in range(world.nbody)]
    mine = [i for i, name in enumerate(names) if name.rsplit("_")[0] in ("cane", "peduncle", "bunch")]
    last = [i for i in mine if not names[i].endswith("_link")]
    bodies = bodies_of(model, [names[i] for i in last])
    plants = vinesim.Simulation(model).physics.plants
    np.testing.assert_allclose(world.body_mass[last], plants.body_mass[bodies], rtol=1e-6)
    assert world.body_mass[mine].sum() == pytest.approx(plants.body_mass[bodies].astype(float).sum(), rel=1e-7)
    drawn = model.forward_kinematics(model.joint_settled)[bodies]
    np.testing.assert_allclose(data.xpos[last], drawn[:, :3], atol=2e-6)
    com = drawn[:, :3] + frames.rotate(drawn[:, 3:], plants.body_com[bodies].astype(float))
    np.testing.assert_allclose(data.xipos[last], com, atol=5e-6)
    crates = [i for i, name in enumerate(names) if name.startswith("box_")]
    np.testing.assert_allclose(world.body_mass[crates], model.box_mass, rtol=1e-6)
    np.testing.assert_allclose(data.xpos[crates], model.box_pose[:, :3], atol=1e-6)


def test_the_springs_that_gazebo_reads_are_those_of_the_mjcf(tmp_path):
    model = bent_cane()
    for suffix in ("xml", "urdf"):
        vinesim.export_vineyard(model, tmp_path / f"cane.{suffix}")
    world = mujoco.MjModel.from_xml_path(str(tmp_path / "cane.xml"))
    springs = ElementTree.parse(tmp_path / "cane.urdf").getroot().findall("gazebo")
    assert len(springs) == world.njnt
    for spring in springs:
        joint = world.joint(spring.get("reference"))
        assert float(spring.findtext("springStiffness")) == pytest.approx(joint.stiffness[0], rel=1e-6)
        assert float(spring.findtext("springReference")) == pytest.approx(joint.qpos_spring[0], abs=1e-6)


def test_the_file_is_valid(tmp_path):
    file = tmp_path / "vine.urdf"
    vinesim.export_vineyard(one_vine(), file, leaves=True)
    robot = yourdfpy.URDF.load(str(file), load_meshes=False, build_scene_graph=False)
    assert robot.validate(), robot.errors
    children = {joint.child for joint in robot.robot.joints}
    assert [link.name for link in robot.robot.links if link.name not in children] == ["world"]
