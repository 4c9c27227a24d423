"""URDFs as they are found: what they leave out is assumed with one warning; example-robot-data's robots hold."""

from __future__ import annotations

import importlib
import logging
import pathlib
import sys
import tempfile

import numpy as np
import pytest
import trimesh

from tests.support.long_rows import long
from tests.support.robot_yard import Yard
from vinesim.core import frames
from vinesim.net.codec.robot import decode_robot, encode_robot
from vinesim.rigid.urdf import shapes_of
from vinesim.robot.description.drive_parameters import FULL_EFFORT_ANGLE
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.packages import find_installed
from vinesim.robot.description.urdf import DescriptionError

MOMENTS = 'ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"'
LIMIT = '<limit lower="-1" upper="2" effort="30" velocity="1"/>'


def link(name: str, mass: float = 1.0, centre: str = "0 0 0", moments: str = MOMENTS) -> str:
    return (
        f'<link name="{name}"><inertial><origin xyz="{centre}"/><mass value="{mass}"/><inertia {moments}/></inertial>'
        "</link>"
    )


def joint(name: str, parent: str, child: str, limit: str = LIMIT, axis: str = "0 1 0", kind: str = "revolute") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
        f"{limit}</joint>"
    )


@pytest.mark.parametrize("name", ["vinebot", "logistic"])
def test_own_robots_are_what_their_tools_write(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    root = pathlib.Path(__file__).resolve().parents[2]
    monkeypatch.syspath_prepend(root / "tools")
    written = getattr(importlib.import_module(f"make_{name}"), name)()
    assert written == (root / "data" / "robots" / f"{name}.urdf").read_text()


def write(folder: pathlib.Path, *parts: str) -> pathlib.Path:
    file = folder / "simple.urdf"
    file.write_text(f'<robot name="simple">{"".join(parts)}</robot>')
    return file


def warnings_of(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


# ---------------------------------------------------------------------- bolted down

WORLD = '<link name="world"/><joint name="fix" type="fixed"><parent link="world"/><child link="base"/></joint>'


@pytest.mark.parametrize("mass", [9.0, 0.0])
def test_a_root_called_world_bolts_the_robot_down(
    mass: float, tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A push of 2,000 N at the base and an order to drive move it by less than a tenth of a millimetre."""
    description = load_description(write(tmp_path, WORLD, link("base", mass), link("arm"), joint("j", "base", "arm")))
    assert not warnings_of(caplog) or mass == 0.0
    yard = Yard(description, frames.pose([1.0, 2.0, 0.5]))
    yard.robot.command_base(0.5, 0.5, 0.0)
    yard.rigid.apply_wrench("anna", "base", np.array([2000.0, 500.0, 0.0]))
    yard.run(1.0)
    place = yard.rigid.link_pose("anna", "base")
    np.testing.assert_allclose(place, frames.pose([1.0, 2.0, 0.5]), atol=1e-4)


def test_the_offset_of_the_base_from_the_world_is_kept(tmp_path: pathlib.Path) -> None:
    stand = WORLD.replace("</joint>", '<origin xyz="0 0 0.7"/></joint>')
    yard = Yard(load_description(write(tmp_path, stand, link("base"), link("arm"), joint("j", "base", "arm"))))
    assert yard.rigid.link_pose("anna", "base")[2] == pytest.approx(0.7)


def test_a_copy_of_a_bolted_robot_is_bolted_down_too(tmp_path: pathlib.Path) -> None:
    """Another client loads the text that this one sends: the same base, and nothing to repair any more."""
    first = load_description(write(tmp_path, WORLD, link("base"), link("arm"), joint("j", "base", "arm")))
    copy = tmp_path / "copy.urdf"
    copy.write_text(first.urdf)
    second = load_description(copy)
    assert second.urdf == first.urdf
    assert second.base_limits == first.base_limits


# ---------------------------------------------------------------------- what a URDF leaves out


def test_missing_limits_masses_and_mimic_sources_are_assumed_with_one_warning(
    tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture
) -> None:
    text = (
        link("base"),
        "<link name='a'/>",
        link("b", moments=MOMENTS.replace("0.1", "0")),
        link("c"),
        link("d", moments='ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="1e-6" ixz="1e-6" iyz="1e-6"'),
        joint("ja", "base", "a", '<limit effort="0" velocity="0" lower="0" upper="1"/>'),
        joint("jb", "a", "b", ""),
        joint("jc", "b", "c", '<limit effort="5" velocity="1"/>', kind="continuous"),
        joint("jd", "c", "d", LIMIT + '<mimic joint="missing"/>'),
    )
    description = load_description(write(tmp_path, *text))
    (warning,) = warnings_of(caplog)
    for words in ("'ja' (and 1 more)", "'jb' turns", "'a' (and 1 more) moves without", "'jd' mimics", "inertia of 'd'"):
        assert words in warning
    assert description.joints == ("ja", "jb", "jc", "jd")
    assert (description.drives[0].effort, description.drives[0].velocity) == (10.0, 1.0)
    assert (description.drives[1].lower, description.drives[1].upper) == pytest.approx((-np.pi, np.pi))
    np.testing.assert_allclose(Yard(description).run(0.5)[-1, 0], description.home, atol=1e-6)


def test_a_joint_that_mimics_a_mimicking_one_follows_the_driven_joint(tmp_path: pathlib.Path) -> None:
    """c = -0.5 b + 0.2 and b = 2 a + 0.1: a = 0.3 makes them 0.7 and -0.15, whatever their order in the file."""
    chain = (
        joint("c", "base", "lc", LIMIT + '<mimic joint="b" multiplier="-0.5" offset="0.2"/>'),
        joint("b", "base", "lb", LIMIT + '<mimic joint="a" multiplier="2" offset="0.1"/>'),
        joint("a", "base", "la"),
    )
    for joints in (chain, chain[::-1]):
        description = load_description(write(tmp_path, *map(link, ("base", "la", "lb", "lc")), *joints))
        assert description.joints == ("a",)
        poses = dict(
            zip(description.moving_joints.names, description.moving_joints.poses(np.array([0.3])), strict=True)
        )
        for name, angle in (("a", 0.3), ("b", 0.7), ("c", -0.15)):
            np.testing.assert_allclose(poses[name][3:], frames.exp(np.array([0.0, angle, 0.0])), atol=1e-12)
        assert 'joint="b"' not in description.urdf  # physics and other clients read the composed one
        Yard(description).run(0.1)


@pytest.mark.parametrize("source", ["a", "b"])
def test_joints_that_mimic_each_other_in_a_cycle_are_refused(source: str, tmp_path: pathlib.Path) -> None:
    text = (
        joint("a", "base", "la", LIMIT + f'<mimic joint="{source}" multiplier="3"/>'),
        joint("b", "base", "lb", LIMIT + '<mimic joint="a"/>'),
    )
    with pytest.raises(DescriptionError, match="make it mimic a driven joint"):
        load_description(write(tmp_path, *map(link, ("base", "la", "lb")), *text))


def test_a_joint_too_weak_for_its_weight_is_counterbalanced(
    tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture
) -> None:
    """10 kg at 1 m weigh 98.1 N m, the drive gives 30: it holds, and has its 30 N m besides. 2 kg need nothing."""
    strong = write(tmp_path, link("base"), link("arm", 2.0, "1 0 0"), joint("j", "base", "arm"))
    assert load_description(strong).drives[0].effort == 30.0
    assert warnings_of(caplog) == []
    weak = load_description(write(tmp_path, link("base"), link("arm", 10.0, "1 0 0"), joint("j", "base", "arm")))
    home = weak.home[0]
    assert weak.drives[0].effort == pytest.approx(30.0 + 98.0665 * np.cos(home))
    assert "'j' is too weak" in warnings_of(caplog)[0]
    assert Yard(weak).run(1.0)[-1, 0, 0] == pytest.approx(home, abs=1e-3)


def test_a_platform_on_wheels_alone_drives(tmp_path: pathlib.Path) -> None:
    """Its wheels are fixed, so it has no drive at all; another client can hold a copy of it."""
    wheel = joint("wheel_joint", "base", "wheel", '<limit effort="1" velocity="1"/>', kind="continuous")
    description = load_description(write(tmp_path, link("base", 20.0), link("wheel"), wheel))
    assert description.joints == ()
    yard = Yard(description)
    for _ in range(100):
        yard.robot.command_base(0.4, 0.0, yard.time)
        yard.run(yard.rigid.dt)
    assert yard.rigid.base_state("anna")[1][0] == pytest.approx(0.4, rel=0.02)
    update = yard.robot.update(yard.time)
    received = decode_robot(encode_robot(update), "anna")
    np.testing.assert_array_equal(received.position, update.position)


def test_a_joint_without_limits_slides_nowhere(tmp_path: pathlib.Path) -> None:
    with pytest.raises(DescriptionError, match="lower, upper"):
        load_description(write(tmp_path, link("base"), link("a"), joint("j", "base", "a", "", kind="prismatic")))


# ---------------------------------------------------------------------- mimic grippers


@pytest.mark.parametrize(("multiplier", "offset"), [(1.0, 0.0), (0.5, 0.0), (1.0, 0.004)])
def test_a_gripper_with_a_mimic_finger_opens_as_far_as_asked(
    multiplier: float, offset: float, tmp_path: pathlib.Path
) -> None:
    limit = '<limit lower="0" upper="0.08" effort="100" velocity="0.5"/>'
    mimic = f'<mimic joint="gripper_left_1_joint" multiplier="{multiplier}" offset="{offset}"/>'
    light = MOMENTS.replace("0.1", "1e-4")
    description = load_description(
        write(
            tmp_path,
            link("base", 9.0),
            link("left", 0.1, moments=light),
            link("right", 0.1, moments=light),
            joint("gripper_left_1_joint", "base", "left", limit, "0 1 0", "prismatic"),
            joint("gripper_left_2_joint", "base", "right", limit + mimic, "0 -1 0", "prismatic"),
        )
    )
    yard = Yard(description)
    yard.robot.command_gripper("gripper_left", 0.05)
    yard.run(1.0)
    left, right = (yard.rigid.link_pose("anna", name)[1] for name in ("left", "right"))
    assert left - right == pytest.approx(0.05, abs=1e-4)
    assert yard.robot.gripper_opening("gripper_left") == pytest.approx(left - right, abs=1e-4)


# ---------------------------------------------------------------------- the robots of example-robot-data

FOLDER = "example-robot-data/robots"
ANCHOR = find_installed(f"{FOLDER}/panda_description/urdf/panda.urdf")
ROBOTS = ANCHOR.parents[2] if ANCHOR is not None else None
FILES = sorted(str(file.relative_to(ROBOTS)) for file in ROBOTS.rglob("*.urdf")) if ROBOTS is not None else []
REFUSED = {"romeo_laas_small.urdf": "is missing", "ur3.urdf": "has no name"}
"""Files that no simulator can load, and why: its meshes are not in the package; it holds no robot."""


def is_refused(file: str) -> bool:
    return pathlib.Path(file).name in REFUSED


FIT = [file for file in FILES if not is_refused(file)]


@pytest.mark.slow
@pytest.mark.parametrize("file", [*FIT[::8], *long(*(file for file in FIT if file not in FIT[::8]))])
def test_each_robot_of_example_robot_data_holds_its_pose(file: str, caplog: pytest.LogCaptureFixture) -> None:
    """For 2 s all joints stay within 2 mrad (mm) and the base within 0.1 mm; at most one warning. Legs that carry the
    robot give way, by less than the angle at which their servos have full effort."""
    assert ROBOTS is not None
    description = load_description(ROBOTS / file)
    yard = Yard(description)
    warned = warnings_of(caplog)
    assert len(warned) <= 1, warned
    rows = yard.run(2.0)
    stands = description.base_limits.kind == "free"
    assert np.abs(rows[:, 0] - description.home).max(initial=0.0) < (FULL_EFFORT_ANGLE if stands else 2e-3)
    assert np.abs(rows[-1, 1]).max(initial=0.0) < 1e-3
    away = 1e-2 if stands else 1e-4
    np.testing.assert_allclose(yard.rigid.base_state("anna")[0], frames.pose([0.0, 0.0, 0.0]), atol=away)


@pytest.mark.parametrize("file", [file for file in FILES if is_refused(file)])
def test_the_unfit_files_of_example_robot_data_are_refused_in_one_line(file: str) -> None:
    assert ROBOTS is not None
    with pytest.raises(DescriptionError) as caught:
        load_description(ROBOTS / file)
    assert REFUSED[pathlib.Path(file).name] in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(ANCHOR is None, reason="example-robot-data is not installed")
def test_the_hand_of_a_panda_opens_as_far_as_asked() -> None:
    assert ANCHOR is not None
    yard = Yard(load_description(ANCHOR))
    group = next(name for name, one in yard.robot.description.groups.items() if "panda_finger_joint1" in one.joints)
    yard.robot.command_gripper(group, 0.05)
    yard.run(1.0)
    left, right = (yard.rigid.link_pose("anna", f"panda_{side}finger")[:3] for side in ("left", "right"))
    assert np.linalg.norm(left - right) == pytest.approx(0.05, abs=1e-4)


# ---------------------------------------------------------------------- text from the network


def remote_text(folder: pathlib.Path, shapes: str) -> pathlib.Path:
    shell = f'<link name="shell">{shapes}</link>'
    fixed = '<joint name="fix" type="fixed"><parent link="arm"/><child link="shell"/></joint>'
    return write(folder, link("base"), link("arm"), joint("j", "base", "arm"), shell, fixed)


OPENED: list[str] = []
"""Names of the files that Python opened since the list was cleared."""
sys.addaudithook(lambda event, arguments: OPENED.append(str(arguments[0])) if event == "open" else None)


def test_no_file_that_a_text_from_the_network_names_is_opened(
    tmp_path: pathlib.Path,
) -> None:
    """A box of the bounds it gives stands in; a mesh without bounds is left out, even where the file exists."""
    (tmp_path / "secret.stl").write_bytes(b"solid")
    meshes = "".join(
        f'<{tag}><geometry><mesh filename="{tmp_path}/secret.stl"{bounds}/></geometry></{tag}>'
        for tag, bounds in (("visual", ' bounds="-0.1 -0.2 0 0.3 0.2 0.5" scale="2 1 1"'), ("collision", ""))
    )
    file = remote_text(tmp_path, meshes)
    OPENED.clear()
    description = load_description(file, is_remote=True)
    yard = Yard(description)
    assert str(file) in OPENED
    assert not [name for name in OPENED if "secret" in name]
    (shape,) = shapes_of(description.urdf)["shell"]
    assert shape.kind == "box"
    np.testing.assert_allclose(shape.size, [0.4, 0.2, 0.25])
    np.testing.assert_allclose(shape.pose[:3], [0.2, 0.0, 0.25], atol=1e-9)
    assert np.isfinite(yard.run(0.1)).all()


@pytest.mark.parametrize("effort", ["1e16", "1e-300"])
def test_extreme_limits_leave_the_physics_finite(effort: str, tmp_path: pathlib.Path) -> None:
    limit = f'<limit lower="-1e16" upper="1e16" effort="{effort}" velocity="{effort}"/>'
    file = write(tmp_path, link("base"), link("arm", 1.0, "1 0 0"), joint("j", "base", "arm", limit))
    yard = Yard(load_description(file, is_remote=True))
    assert np.isfinite(yard.run(0.2)).all()
    assert np.isfinite(yard.rigid.base_state("anna")[0]).all()


@pytest.mark.parametrize("declared", ["SYSTEM 'file:///dev/null'", "[<!ENTITY secret SYSTEM 'secret.txt'>]"])
def test_a_text_with_a_document_type_is_refused(declared: str, tmp_path: pathlib.Path) -> None:
    """So no entity exists: neither one of a file nor one that grows."""
    (tmp_path / "secret.txt").write_text("secret")
    file = write(tmp_path, link("base"), link("arm"), joint("j", "base", "arm"), "<author>&secret;</author>")
    file.write_text(f"<!DOCTYPE robot {declared}>" + file.read_text())
    with pytest.raises(DescriptionError, match="document type"):
        load_description(file, is_remote=True)


@pytest.mark.skipif(ANCHOR is None, reason="example-robot-data is not installed")
def test_a_robot_with_meshes_is_boxes_on_another_machine() -> None:
    """The boxes enclose what the meshes of the sender do: the same bounds of each link."""
    assert ANCHOR is not None
    file = ANCHOR.parents[2] / "talos_data/robots/talos_left_arm.urdf"
    own = load_description(file)
    with tempfile.TemporaryDirectory() as folder:
        copy = pathlib.Path(folder) / "talos.urdf"
        copy.write_text(own.urdf)
        other = load_description(copy, is_remote=True)
    boxes = 0
    for name, shapes in shapes_of(other.urdf).items():
        meshes = [shape for shape in shapes_of(own.urdf)[name] if shape.kind == "mesh"]
        stand_ins = [shape for shape in shapes if shape.kind == "box"]
        for box, mesh in zip(stand_ins, meshes, strict=True):
            extents = trimesh.load(mesh.file, force="mesh").extents * np.abs(mesh.size)
            np.testing.assert_allclose(2.0 * np.array(box.size), extents, rtol=1e-3, atol=2e-4)
            boxes += 1
    assert boxes > 10
