"""Robot descriptions: vinebot's numbers, other URDFs, and every kind of invalid description."""

from __future__ import annotations

import dataclasses
import importlib
import io
import pathlib
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
import yourdfpy
from lxml import etree

from vinesim.core import data_files, frames
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.urdf import DescriptionError, parse_robot


@pytest.fixture(scope="module")
def vinebot() -> RobotDescription:
    return load_description("vinebot")


@pytest.fixture(scope="module")
def parsed(vinebot: RobotDescription) -> yourdfpy.Robot:
    return parse(vinebot.urdf)


def parse(urdf: str) -> yourdfpy.Robot:
    return yourdfpy.URDF.load(io.BytesIO(urdf.encode()), build_scene_graph=False, load_meshes=False).robot


# ---------------------------------------------------------------------- vinebot


@pytest.mark.parametrize("name", ["vinebot", "logistic"])
def test_the_urdf_is_the_output_of_its_generator(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Structure, names and text are equal, numbers to the last digits, which differ between processors."""
    root = data_files.data_dir().parent
    monkeypatch.syspath_prepend(root / "tools")
    writer = importlib.import_module(f"make_{name}")
    written = ElementTree.fromstring(getattr(writer, name)())
    kept = ElementTree.parse(root / "data" / "robots" / f"{name}.urdf").getroot()
    assert [element.tag for element in written.iter()] == [element.tag for element in kept.iter()]
    for ours, theirs in zip(written.iter(), kept.iter(), strict=True):
        assert len(ours) == len(theirs)
        assert list(ours.attrib) == list(theirs.attrib)
        for key, text in ours.attrib.items():
            assert_same_text(text, theirs.attrib[key], f"<{ours.tag} {key}=...>")


def assert_same_text(left: str, right: str, where: str) -> None:
    """Two texts of words and numbers are equal, numbers within 1e-6 of their size and 1e-12."""
    assert len(left.split()) == len(right.split()), where
    for one, other in zip(left.split(), right.split(), strict=True):
        try:
            numbers = float(one), float(other)
        except ValueError:
            assert one == other, where
        else:
            assert numbers[0] == pytest.approx(numbers[1], rel=1e-6, abs=1e-12), where


def test_vinebot_is_a_dual_arm_carrier(vinebot: RobotDescription) -> None:
    assert vinebot.base == "base_footprint"
    assert 150.0 < vinebot.mass < 250.0
    assert len(vinebot.drives) == 21
    for side in ("left", "right"):
        assert vinebot.groups[f"arm_{side}"].joints == tuple(f"arm_{side}_{i}_joint" for i in range(1, 8))
        assert f"gripper_{side}_cutter_link" in vinebot.link_anchors
    assert vinebot.sensors_of("camera")[0].frame == "head_front_camera_rgb_optical_frame"
    assert vinebot.notes == ()
    for drive, home in zip(vinebot.drives, vinebot.home, strict=True):
        assert drive.lower <= home <= drive.upper, drive.joint


def test_arms_have_plausible_masses(vinebot: RobotDescription, parsed: yourdfpy.Robot) -> None:
    for side in ("left", "right"):
        parts = [
            link for link in parsed.links if link.name.startswith((f"arm_{side}", f"gripper_{side}", f"wrist_{side}"))
        ]
        assert 15.0 < sum(link.inertial.mass for link in parts if link.inertial) < 20.0


def test_inertias_are_those_of_the_collision_shapes(parsed: yourdfpy.Robot) -> None:
    """Oracle: trimesh integrates mass, centre and inertia over the surface of each link's collision shapes."""
    checked = 0
    for link in parsed.links:
        if link.inertial is None:
            continue
        inertia = link.inertial.inertia
        moments = np.linalg.eigvalsh(inertia)
        assert moments[0] > 0.0, link.name
        assert moments[0] + moments[1] >= moments[2] * (1.0 - 1e-6), link.name
        meshes = []
        for shape in link.collisions:
            geometry = shape.geometry
            if geometry.box is not None:
                mesh = trimesh.creation.box(geometry.box.size)
            elif geometry.cylinder is not None:
                mesh = trimesh.creation.cylinder(geometry.cylinder.radius, geometry.cylinder.length, sections=64)
            else:
                mesh = trimesh.creation.icosphere(radius=geometry.sphere.radius, subdivisions=4)
            meshes.append(mesh.apply_transform(shape.origin))
        whole = trimesh.util.concatenate(meshes)
        whole.density = link.inertial.mass / whole.volume
        np.testing.assert_allclose(link.inertial.origin[:3, 3], whole.center_mass, atol=1e-3, err_msg=link.name)
        np.testing.assert_allclose(inertia, whole.moment_inertia, atol=0.01 * moments[2], rtol=0.01, err_msg=link.name)
        checked += 1
    assert checked == 32


def test_each_gripper_has_a_cutter_over_its_fingers(vinebot: RobotDescription) -> None:
    """Wood across the fingertips passes between the blades."""
    assert [cutter.group for cutter in vinebot.cutters] == ["gripper_left", "gripper_right"]
    poses = vinebot.link_poses(vinebot.home)
    for cutter in vinebot.cutters:
        tips = poses[f"{cutter.group}_grasping_link"]
        mouth = frames.compose(poses[cutter.frame], frames.pose(np.array(cutter.origin)))
        off = frames.compose(frames.inverse(mouth), tips)[:3]
        assert abs(off[0]) < cutter.half[0]
        assert abs(off[1]) < cutter.half[1]
        assert -0.10 < off[2] < -0.02


def test_bunches_are_within_reach(vinebot: RobotDescription) -> None:
    """From the shoulder, with the lift inside its range, the arm's length covers 0.45-0.9 m ahead, 1.3-1.8 m high."""
    zero = vinebot.home.copy()
    zero[vinebot.joint_indices("arm_left")] = 0.0
    poses = vinebot.link_poses(zero)
    shoulder = poses["arm_left_2_link"][:3]
    tool = poses["gripper_left_grasping_link"][:3]
    length = np.linalg.norm(shoulder - tool)
    assert 0.85 < length < 1.05
    lift = vinebot.drives[vinebot.joints.index("torso_lift_joint")]
    for ahead in (0.45, 0.9):
        for height in (1.3, 1.8):
            target = np.array([ahead, 0.15, height])
            raised = shoulder + np.array([0.0, 0.0, np.clip(height - shoulder[2], 0.0, lift.upper - 0.15)])
            assert np.linalg.norm(target - raised) < length


def test_sides_mirror_each_other(vinebot: RobotDescription) -> None:
    poses = vinebot.link_poses(vinebot.home)
    left = poses["gripper_left_grasping_link"]
    right = poses["gripper_right_grasping_link"]
    np.testing.assert_allclose(left[:3] * [1, -1, 1], right[:3], atol=1e-12)


def test_moving_joints_agree_with_yourdfpy(vinebot: RobotDescription, parsed: yourdfpy.Robot) -> None:
    """Oracle: yourdfpy's forward kinematics at a random configuration."""
    oracle = yourdfpy.URDF(parsed, build_scene_graph=True, load_meshes=False)
    rng = np.random.default_rng(4)
    position = np.array([rng.uniform(drive.lower, drive.upper) for drive in vinebot.drives])
    oracle.update_cfg(dict(zip(vinebot.joints, position, strict=True)))
    poses = vinebot.link_poses(position)
    for link in ("gripper_left_left_finger_link", "head_front_camera_depth_optical_frame", "arm_right_5_link"):
        expected = oracle.get_transform(link, "base_footprint")
        np.testing.assert_allclose(poses[link][:3], expected[:3, 3], atol=1e-9)
        np.testing.assert_allclose(frames.to_matrix(poses[link][3:]), expected[:3, :3], atol=1e-9)


def test_the_camera_points_ahead(vinebot: RobotDescription) -> None:
    pose = vinebot.link_poses(vinebot.home)["head_front_camera_rgb_optical_frame"]
    np.testing.assert_allclose(frames.rotate(pose[3:], np.array([0.0, 0.0, 1.0])), [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(frames.rotate(pose[3:], np.array([0.0, 1.0, 0.0])), [0, 0, -1], atol=1e-9)


# ---------------------------------------------------------------------- other robots


def tiago_pro() -> RobotDescription:
    try:
        return load_description("tiago_pro")
    except DescriptionError as error:
        if "not installed" in str(error):
            pytest.skip(str(error))
        raise


def test_tiago_pro_loads() -> None:
    tiago = tiago_pro()
    assert len(tiago.groups["arm_left"].joints) == 7
    assert not any("wheel" in joint for joint in tiago.moving_joints.names)
    assert any("wheel" in child for _, child in tiago.fixed_frames)
    for shape in (shape for link in parse(tiago.urdf).links for shape in (*link.visuals, *link.collisions)):
        if shape.geometry.mesh is not None:
            assert pathlib.Path(shape.geometry.mesh.filename).is_absolute()
    assert tiago.sensors_of("camera")[0].frame.endswith("optical_frame")
    ahead = frames.rotate(
        tiago.link_poses(tiago.home)[tiago.sensors_of("camera")[0].frame][3:], np.array([0.0, 0.0, 1.0])
    )
    assert ahead[0] > 0.9
    assert abs(ahead[1]) < 1e-3


def test_mimic_joints_follow_their_source() -> None:
    tiago = tiago_pro()
    moving = tiago.moving_joints
    assert "gripper_left_fingertip_left_joint" not in tiago.joints
    position = tiago.home.copy()
    position[tiago.joints.index("gripper_left_finger_joint")] += 0.3
    angle = dict(zip(moving.names, moving.multiplier * position[moving.drive_index] + moving.offset, strict=True))
    assert angle["gripper_left_fingertip_left_joint"] == -angle["gripper_left_finger_joint"]
    turned = 2.0 * np.arccos(
        np.clip(np.abs((moving.poses(position)[:, 3:] * moving.poses(tiago.home)[:, 3:]).sum(1)), 0, 1)
    )
    assert np.count_nonzero(np.isclose(turned, 0.3)) == 6


def robot(links: str = "", joints: str = "", arm_mass: str = "1", arm_joint: str = "") -> str:
    """A URDF of a base and one arm, into which faults can be inserted."""
    limits = '<limit lower="-1" upper="2" effort="10" velocity="1"/>'
    moments = 'ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"'
    return f"""<robot name="simple"><link name="base"><inertial><mass value="9"/><inertia {moments}/></inertial></link>
      <link name="arm"><inertial><mass value="{arm_mass}"/><inertia {moments}/></inertial></link>
      <joint name="shoulder_joint" type="revolute"><parent link="base"/><child link="arm"/>
      <axis xyz="0 0 1"/>{arm_joint or limits}</joint>{links}{joints}</robot>"""


def write(folder: pathlib.Path, text: str) -> pathlib.Path:
    file = folder / "simple.urdf"
    file.write_text(text)
    return file


def test_defaults_without_a_sidecar(tmp_path: pathlib.Path) -> None:
    joints = """<joint name="turret_joint" type="continuous"><parent link="base"/><child link="camera_link"/>
      <axis xyz="0 0 2"/><limit effort="4" velocity="3"/></joint>
      <joint name="caster_1_joint" type="continuous"><parent link="base"/><child link="caster"/></joint>"""
    moments = 'ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"'
    camera = f'<link name="camera_link"><inertial><mass value="0.2"/><inertia {moments}/></inertial></link>'
    camera += '<link name="caster"/>'
    simple = load_description(write(tmp_path, robot(links=camera, joints=joints)))
    assert simple.joints == ("shoulder_joint", "turret_joint")
    shoulder, turret = simple.drives
    assert shoulder.stiffness * 0.05 == pytest.approx(shoulder.effort)
    assert shoulder.armature == pytest.approx(0.02 * 10.0 / 1.0)
    assert shoulder.damping == pytest.approx(2.0 * np.sqrt(200.0 * (0.1 + 0.2)))
    assert (turret.lower, turret.upper) == (-np.inf, np.inf)
    assert simple.sensors_of("camera")[0].frame == "camera_optical_frame"
    assert any("caster" in note for note in simple.notes)


@pytest.mark.parametrize(("lower", "upper", "home"), [(0.5, 1.5, 1.0), (-1.0, 1.1, 0.0), (-2.4, 1.1, -0.65)])
def test_home_is_zero_or_the_middle_of_the_range(
    lower: float, upper: float, home: float, tmp_path: pathlib.Path
) -> None:
    limit = f'<limit lower="{lower}" upper="{upper}" effort="1" velocity="1"/>'
    assert load_description(write(tmp_path, robot(arm_joint=limit))).home == pytest.approx([home])


def test_meshes_are_found_and_those_of_other_formats_converted(tmp_path: pathlib.Path) -> None:
    package = tmp_path / "some_robot"
    (package / "meshes").mkdir(parents=True)
    (package / "urdf").mkdir()
    trimesh.creation.box((0.2, 0.4, 0.6)).export(package / "meshes" / "part.stl")
    part = trimesh.creation.box((0.2, 0.4, 0.6))
    part.apply_translation([0.1, 0.0, 0.0])
    part.export(package / "meshes" / "part.ply")
    shapes = """<link name="shell">
      <visual><geometry><mesh filename="package://some_robot/meshes/part.stl"/></geometry></visual>
      <visual><geometry><mesh filename="../meshes/part.ply"/></geometry></visual>
      <collision><geometry><mesh filename="../meshes/part.ply" scale="1 1 2"/></geometry></collision></link>"""
    joint = '<joint name="shell_joint" type="fixed"><parent link="arm"/><child link="shell"/></joint>'
    simple = load_description(write(package / "urdf", robot(links=shapes, joints=joint)))
    shell = next(link for link in parse(simple.urdf).links if link.name == "shell")
    assert shell.visuals[0].geometry.mesh.filename == str((package / "meshes" / "part.stl").resolve())
    for shape in (shell.visuals[1], shell.collisions[0]):
        converted = trimesh.load(shape.geometry.mesh.filename)
        np.testing.assert_allclose(converted.bounds, [[0.0, -0.2, -0.3], [0.2, 0.2, 0.3]], atol=1e-6)
    np.testing.assert_array_equal(shell.collisions[0].geometry.mesh.scale, [1.0, 1.0, 2.0])


# ---------------------------------------------------------------------- invalid descriptions

FAULTS = {
    "not XML": ("<robot name='x'>", "not well-formed XML"),
    "another format": ("<html/>", "root is <html>"),
    "nameless link": ("<robot name='x'><link/></robot>", "not a URDF"),
    "joint without parent": ("<robot name='x'><link name='a'/><joint name='j' type='fixed'/></robot>", "not a URDF"),
    "no links": ("<robot name='x'></robot>", "no links"),
    "same name twice": (robot(links="<link name='arm'/>"), "'arm' appears twice"),
    "unknown link": (
        robot(joints="<joint name='j' type='fixed'><parent link='arm'/><child link='hand'/></joint>"),
        "'hand' that does not exist",
    ),
    "two parents": (
        robot(joints="<joint name='j' type='fixed'><parent link='base'/><child link='arm'/></joint>"),
        "'arm' has two parents",
    ),
    "two roots": (robot(links="<link name='island'/>"), "both have no parent"),
    "loop": (
        robot(
            links="<link name='a'/><link name='b'/>",
            joints="<joint name='ab' type='fixed'><parent link='a'/><child link='b'/></joint>"
            "<joint name='ba' type='fixed'><parent link='b'/><child link='a'/></joint>",
        ),
        "kinematic loop",
    ),
    "unknown joint": (robot().replace("revolute", "screw"), "type 'screw'; use one of fixed, revolute"),
    "joint of no type": (robot().replace('type="revolute"', ""), "type None"),
    "half an axis": (robot().replace("0 0 1", "0 1"), "xyz=\"0 1\"> of joint 'shoulder_joint' has 2 of 3 numbers"),
    "not a number": (robot(arm_mass="nan"), "is not finite"),
    "a mass that nothing has": (robot(arm_mass="1e300"), "is beyond 1e+06"),
    "a word": (robot(arm_mass="heavy"), "<mass value=\"heavy\"> of link 'arm' is no number"),
    "endless effort": (robot(arm_joint="<limit lower='0' upper='1' effort='inf' velocity='1'/>"), "is not finite"),
    "flat box": (
        robot(links="<link name='s'><collision><geometry><box size='1 0 1'/></geometry></collision></link>"),
        "is not a size",
    ),
    "unknown shape": (
        robot(links="<link name='s'><collision><geometry><cone radius='1'/></geometry></collision></link>"),
        "cone",
    ),
    "name of the world": (robot().replace('"arm"', '"world"'), "'world' is not the root"),
    "no limits": (robot(arm_joint="<dynamics damping='1'/>").replace("revolute", "prismatic"), "moves without limits"),
    "half a limit": (robot(arm_joint="<limit lower='-1' effort='1' velocity='1'/>"), "upper"),
    "document type": ("<!DOCTYPE robot SYSTEM 'robot.dtd'>" + robot(), "document type"),
    "upside-down limits": (robot(arm_joint="<limit lower='1' upper='0' effort='1' velocity='1'/>"), "limits 1 to 0"),
    "negative effort": (robot(arm_joint="<limit lower='0' upper='1' effort='-1' velocity='1'/>"), "effort -1"),
    "negative mass": (robot(arm_mass="-2"), "mass of -2"),
    "impossible inertia": (robot().replace('izz="0.1"', 'izz="-0.1"'), "positive definite"),
    "missing mesh": (
        robot(links="<link name='s'><visual><geometry><mesh filename='gone.stl'/></geometry></visual></link>"),
        "'gone.stl' is missing",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_reported_in_one_line(fault: str, tmp_path: pathlib.Path) -> None:
    text, words = FAULTS[fault]
    with pytest.raises(DescriptionError) as caught:
        load_description(write(tmp_path, text))
    message = str(caught.value)
    assert words in message
    assert message.startswith(str(tmp_path / "simple.urdf"))
    assert ";" in message, "the remedy is missing"
    assert "\n" not in message


def test_a_missing_file_is_refused_with_the_known_ones() -> None:
    with pytest.raises(DescriptionError, match=r"no file 'vinbot'.*vinebot"):
        load_description("vinbot")


def test_springs_and_slip_come_from_the_sidecar(tmp_path: pathlib.Path) -> None:
    file = write(tmp_path, robot())
    assert load_description(file).drives[0].series_stiffness == 0.0
    file.with_suffix(".toml").write_text(
        "[base]\nslip = [0.1, 0.2]\n"
        "[groups.arm]\njoints = ['shoulder_joint']\nelastic = [800.0]\nelastic_damping = [4.0]\n"
    )
    found = load_description(file)
    assert (found.drives[0].series_stiffness, found.drives[0].series_damping) == (800.0, 4.0)
    assert found.base_limits.slip == (0.1, 0.2)


def test_quality_size_and_rate_of_a_camera_come_from_the_sidecar(tmp_path: pathlib.Path) -> None:
    file = write(tmp_path, robot())
    file.with_suffix(".toml").write_text(
        "[[cameras]]\nname = 'wrist'\nframe = 'arm'\ntype = 'd435'\nquality = 'full'\nsize = [320, 240]\nrate = 15.0\n"
        "[[cameras]]\nname = 'chest'\nframe = 'arm'\ntype = 'd435'\n"
    )
    wrist, chest = load_description(file).sensors_of("camera")
    assert (wrist.quality, wrist.size, wrist.rate) == ("full", (320, 240), 15.0)
    assert (chest.quality, chest.size, chest.rate) == ("fast", None, None)


@pytest.mark.parametrize(
    ("toml", "words"),
    [
        ("[groups.arm]\njoints = ['elbow']", "'elbow', which is no driven joint"),
        ("[groups.arm]\njoints = ['shoulder_joint']\nhome = [0.0, 1.0]", "2 of home for 1 joints"),
        ("[[cameras]]\nname = 'c'\nframe = 'nose'", "is mounted on 'nose'"),
        ("[[cameras]]\nname = 'c'\nframe = 'arm'\nquality = 'best'", "'best'"),
        ("[[cameras]]\nname = 'c'\nframe = 'arm'\nsize = [640, 0]", "has the size [640, 0]"),
        ("[[cameras]]\nname = 'c'\nframe = 'arm'\nrate = 0.0", "has the rate 0.0"),
        ("[base]\nspeed = 3", "speed"),
        ("[base]\nslip = [1.0, 0.0]", "slip of (1.0, 0.0)"),
        ("[groups.arm]\njoints = ['shoulder_joint']\nelastic = [1.0]", "only one of elastic and elastic_damping"),
        ("[groups.arm]\njoints = ['shoulder_joint']\nelastic = [-1.0]\nelastic_damping = [0.0]", "below zero"),
        ("[[cutters]]\ngroup = 'hand'\nframe = 'arm'\nhalf = [1, 1, 1]", "belongs to 'hand'"),
        (
            "[groups.arm]\njoints = ['shoulder_joint']\n[[cutters]]\ngroup = 'arm'\nframe = 'claw'\nhalf = [1, 1, 1]",
            "is mounted on 'claw'",
        ),
        (
            "[groups.arm]\njoints = ['shoulder_joint']\n[[cutters]]\ngroup = 'arm'\nframe = 'arm'\nhalf = [1, 0, 1]",
            "the half edges",
        ),
        *(
            (
                "[groups.arm]\njoints = ['shoulder_joint']\n[[cutters]]\ngroup = 'arm'\nframe = 'arm'\n"
                f"half = [1, 1, 1]\n{key}",
                words,
            )
            for key, words in (
                ("force = 0.0", "has 0.0 N; give more than 0"),
                ("speed = 0.0", "closes with 0.0 m/s; give more than 0"),
                ("blade = 'axe'", "axe"),
            )
        ),
        ("[base", "Expected"),
    ],
)
def test_faults_of_the_sidecar_name_the_toml_file(toml: str, words: str, tmp_path: pathlib.Path) -> None:
    file = write(tmp_path, robot())
    file.with_suffix(".toml").write_text(toml)
    with pytest.raises(DescriptionError, match=r"simple\.toml") as caught:
        load_description(file)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_optional_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vinesim.robot.description.source.find_installed", lambda path: None)
    with pytest.raises(DescriptionError, match=r"tiago_pro: .*pip install 'vinesim\[tiago\]'"):
        load_description("tiago_pro")


@pytest.mark.parametrize("name", sorted(p.stem for p in (data_files.data_dir() / "robots").glob("*.urdf")))
def test_a_urdf_is_read_as_yourdfpy_reads_it(name: str) -> None:
    """Oracle: yourdfpy, to the last bit."""
    urdf = load_description(name).urdf
    ours = parse_robot(etree.fromstring(urdf.encode()))
    oracle = parse(urdf)
    assert [link.name for link in ours.links] == [link.name for link in oracle.links]
    for link, other in zip(ours.links, oracle.links, strict=True):
        assert (link.inertial is None) == (other.inertial is None)
        if link.inertial is not None and other.inertial is not None:
            assert link.inertial.mass == other.inertial.mass
            np.testing.assert_array_equal(link.inertial.origin, other.inertial.origin)
            np.testing.assert_array_equal(link.inertial.inertia, other.inertial.inertia)
    for joint, other in zip(ours.joints, oracle.joints, strict=True):
        assert (joint.name, joint.type, joint.parent, joint.child) == (
            other.name,
            other.type,
            other.parent,
            other.child,
        )
        np.testing.assert_array_equal(joint.origin, other.origin)
        np.testing.assert_array_equal(joint.axis, other.axis)
        for mine, his in ((joint.limit, other.limit), (joint.mimic, other.mimic)):
            assert (mine and dataclasses.asdict(mine)) == (his and dataclasses.asdict(his))
