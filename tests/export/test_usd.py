"""The exported USD: valid by the validators of UsdPhysics; masses, places and springs as in the MJCF."""

from __future__ import annotations

import subprocess
import sys

import mujoco
import numpy as np
import pytest

import vinesim
from tests.export.scenes import bent_cane, bodies_of, one_vine
from tests.support.clustered_trees import clustered
from vinesim.core.errors import WriteError

pxr = pytest.importorskip("pxr", reason="needs usd-core")
from pxr import Usd, UsdGeom, UsdPhysics  # noqa: E402 # after the check


def open_stage(source, tmp_path, name: str = "vineyard.usda", **options):
    file = tmp_path / name
    vinesim.export_vineyard(source, file, **options)
    return Usd.Stage.Open(str(file))


@pytest.mark.parametrize("make", [bent_cane, clustered, one_vine])
def test_masses_and_places_are_those_of_the_model(make, tmp_path):
    model = make()
    stage = open_stage(model, tmp_path)
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    bodies = [prim for prim in stage.Traverse() if prim.HasAPI(UsdPhysics.RigidBodyAPI)]
    mine = [prim for prim in bodies if not prim.GetName().startswith("box_")]
    numbers = bodies_of(model, [prim.GetName() for prim in mine])
    plants = vinesim.Simulation(model).physics.plants
    masses = [UsdPhysics.MassAPI(prim).GetMassAttr().Get() for prim in mine]
    np.testing.assert_allclose(masses, plants.body_mass[numbers], rtol=1e-6)
    assert sum(masses) == pytest.approx(plants.body_mass[numbers].astype(float).sum(), rel=1e-6)
    drawn = model.forward_kinematics(model.joint_settled)[numbers]
    places = [UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0).ExtractTranslation() for prim in mine]
    np.testing.assert_allclose(places, drawn[:, :3], atol=2e-6)
    assert len(bodies) - len(mine) == len(model.box_mass)


def test_the_validators_find_no_error(tmp_path):
    from pxr import UsdValidation

    stage = open_stage(one_vine(), tmp_path, leaves=True)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    names = {one.GetMetadata().name for one in validators}
    for kind in ("ArticulationChecker", "RigidBodyChecker", "PhysicsJointChecker", "ColliderChecker"):
        assert f"usdPhysicsValidators:{kind}" in names
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [(one.GetName(), one.GetMessage()) for one in errors] == []


def test_both_frames_of_a_joint_coincide_and_its_springs_hold_the_load(tmp_path):
    """At the drawn shape each spring has the torque that the MJCF's have together."""
    model = bent_cane()
    stage = open_stage(model, tmp_path)
    vinesim.export_vineyard(model, tmp_path / "cane.xml")
    world = mujoco.MjModel.from_xml_path(str(tmp_path / "cane.xml"))
    joints = [UsdPhysics.Joint(prim) for prim in stage.Traverse() if prim.IsA(UsdPhysics.Joint)]
    assert len(joints) == len(model.body_mass)
    for joint in joints:
        frames_of_joint = []
        for side in (0, 1):
            targets = getattr(joint, f"GetBody{side}Rel")().GetTargets()
            place, turn = (getattr(joint, f"GetLocal{what}{side}Attr")().Get() for what in ("Pos", "Rot"))
            frame = _matrix(place, turn)
            if targets:
                body = UsdGeom.Xformable(stage.GetPrimAtPath(targets[0])).ComputeLocalToWorldTransform(0)
                frame = np.array(body).T @ frame
            frames_of_joint.append(frame)
        np.testing.assert_allclose(frames_of_joint[0], frames_of_joint[1], atol=2e-6)
        torque = np.zeros(3)
        for i, axis in enumerate(("rotX", "rotY", "rotZ")):
            drive = UsdPhysics.DriveAPI(joint.GetPrim(), axis)
            torque += drive.GetStiffnessAttr().Get() * drive.GetTargetPositionAttr().Get() * frame[:3, i]
        name = joint.GetPrim().GetName().removesuffix("_joint")
        turn = np.array(UsdGeom.Xformable(joint.GetPrim().GetParent().GetChild(name)).ComputeLocalToWorldTransform(0))
        hinges = [world.joint(f"{name}_{hinge}") for hinge in ("twist", "bend_y", "bend_z")]
        force = np.array([one.stiffness[0] * one.qpos_spring[0] for one in hinges])
        axes = np.array([one.axis for one in hinges]) @ turn[:3, :3]
        np.testing.assert_allclose(axes @ torque, force, atol=1e-5)


def _matrix(position, rotation) -> np.ndarray:
    from pxr import Gf

    return np.array(Gf.Matrix4d(Gf.Rotation(Gf.Quatd(rotation)), Gf.Vec3d(position))).T


def test_the_same_scene_gives_the_same_bytes_in_another_process(tmp_path):
    for name in ("one.usda", "two.usda"):
        code = f"import vinesim; vinesim.export_vineyard(vinesim.CaneBuilder(segments=4), {str(tmp_path / name)!r})"
        subprocess.run([sys.executable, "-c", code], check=True)
    assert (tmp_path / "one.usda").read_bytes() == (tmp_path / "two.usda").read_bytes()


def test_a_folder_in_place_of_the_file_is_one_clear_line(tmp_path):
    (tmp_path / "cane.usda").mkdir()
    with pytest.raises(WriteError, match=r"cane\.usda cannot be written"):
        vinesim.export_vineyard(vinesim.CaneBuilder(), tmp_path / "cane.usda")


@pytest.mark.parametrize("suffix", ["usd", "usdc"])
def test_binary_files_have_the_same_content(suffix, tmp_path):
    stages = open_stage(bent_cane(), tmp_path), open_stage(bent_cane(), tmp_path, f"cane.{suffix}")
    text, binary = (stage.GetRootLayer().ExportToString() for stage in stages)
    assert binary == text
