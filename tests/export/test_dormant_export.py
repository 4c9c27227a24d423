"""Exported dormant vines name their buds where they are."""

import pathlib
from xml.etree import ElementTree

import msgspec
import mujoco
import numpy as np
import pytest

import vinesim
from vinesim.core import frames
from vinesim.scene.model import Model

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def vine() -> Model:
    scene = vinesim.load_scene("winter_spur")
    layout = msgspec.structs.replace(scene.layout, rows=1, vines=1)
    return vinesim.generate(msgspec.structs.replace(scene, layout=layout, spawns=()))


def _buds(model: Model) -> np.ndarray:
    return model.nodes.bud_poses(model.forward_kinematics(model.joint_settled))


def test_buds_are_sites_of_mjcf(vine: Model, tmp_path: pathlib.Path) -> None:
    file = tmp_path / "vine.xml"
    vinesim.export_vineyard(vine, file)
    world = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(world)
    mujoco.mj_forward(world, data)
    wanted = _buds(vine)
    for bud in range(0, len(wanted), 7):
        site = world.site(f"bud_{bud:05d}").id
        np.testing.assert_allclose(data.site_xpos[site], wanted[bud, :3], atol=5e-6)
        way = data.site_xmat[site].reshape(3, 3)[:, 0]
        np.testing.assert_allclose(way, frames.rotate(wanted[bud, 3:], np.array([1.0, 0.0, 0.0])), atol=1e-5)


def test_buds_are_links_of_a_urdf(vine: Model, tmp_path: pathlib.Path) -> None:
    file = tmp_path / "vine.urdf"
    vinesim.export_vineyard(vine, file)
    root = ElementTree.parse(file).getroot()
    names = {link.get("name") for link in root.iter("link")}
    assert {f"bud_{bud:05d}" for bud in range(len(_buds(vine)))} <= names
    fixed = [joint for joint in root.iter("joint") if joint.get("type") == "fixed" and "bud_" in str(joint.get("name"))]
    assert len(fixed) == len(_buds(vine))


def test_buds_are_prims_of_openusd(vine: Model, tmp_path: pathlib.Path) -> None:
    pxr = pytest.importorskip("pxr")
    file = tmp_path / "vine.usda"
    vinesim.export_vineyard(vine, file)
    stage = pxr.Usd.Stage.Open(str(file))
    found = {
        prim.GetName(): pxr.UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0.0)
        for prim in stage.Traverse()
        if prim.GetName().startswith("bud_")
    }
    wanted = _buds(vine)
    assert len(found) == len(wanted)
    for bud in range(0, len(wanted), 11):
        place = found[f"bud_{bud:05d}"].ExtractTranslation()
        np.testing.assert_allclose(list(place), wanted[bud, :3], atol=1e-5)
