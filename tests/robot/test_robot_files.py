"""Robot files as people have them: formats, encodings, names, packages, meshes, sensors and groups (docs/robots.md)."""

from __future__ import annotations

import logging
import math
import os
import pathlib
import re
import sys
import threading
import urllib.parse
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import mujoco
import numpy as np
import pytest
import trimesh
from lxml import etree

from tests.support.robot_yard import Yard
from vinesim.core import frames
from vinesim.rigid.urdf import shapes_of
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.shown import shown_urdf
from vinesim.robot.description.urdf import DescriptionError
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.scene.values import CameraMount, GnssMount, LidarMount

MOMENTS = 'ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"'


@pytest.fixture(autouse=True)
def own_cache(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Meshes are converted anew, and no workspace is sourced."""
    monkeypatch.setenv("VINESIM_CACHE", str(tmp_path / "cache"))
    for variable in ("AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH", "GZ_SIM_RESOURCE_PATH"):
        monkeypatch.delenv(variable, raising=False)


def link(name: str, shapes: str = "", mass: float = 1.0) -> str:
    inertial = f'<inertial><mass value="{mass}"/><inertia {MOMENTS}/></inertial>'
    return f'<link name="{name}">{inertial}{shapes}</link>'


def joint(name: str, parent: str, child: str, kind: str = "revolute", inside: str = "") -> str:
    limit = "" if kind in ("fixed", "floating", "planar") else '<limit lower="-1" upper="2" effort="30" velocity="1"/>'
    ends = f'<parent link="{parent}"/><child link="{child}"/><axis xyz="0 1 0"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{limit}{inside}</joint>'


def robot(*parts: str, name: str = "simple", attributes: str = "") -> str:
    return f'<robot name="{name}" {attributes}>{"".join(parts)}</robot>'


def write(file: pathlib.Path, text: str) -> pathlib.Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return file


def mesh_robot(address: str, tags: tuple[str, ...] = ("visual", "collision"), material: str = "") -> str:
    geometry = f'<geometry><mesh filename="{address}"/></geometry>'
    shapes = "".join(f"<{tag}>{geometry}{material if tag == 'visual' else ''}</{tag}>" for tag in tags)
    return robot(link("base"), link("arm", shapes), joint("j", "base", "arm"))


def warnings_of(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


def extents(description: RobotDescription, name: str = "arm") -> np.ndarray:
    """Edges of the box around the visible meshes of a link [3] m."""
    meshes = [
        trimesh.load(shape.file, force="mesh") for shape in shapes_of(description.urdf)[name] if shape.kind == "mesh"
    ]
    return trimesh.util.concatenate(meshes).extents


BOX = (0.4, 0.2, 0.1)


def collada(file: pathlib.Path, metre: float, color: str = "0.9 0.1 0.1 1", up: str = "Z_UP") -> pathlib.Path:
    """Writes the box BOX in a unit of ``metre`` [m]."""
    box = trimesh.creation.box(np.array(BOX) / metre)
    points = " ".join(f"{value:.9g}" for value in box.vertices.ravel())
    corners = " ".join(str(index) for index in box.faces.ravel())
    text = f"""<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><created>2024-01-01T00:00:00</created><modified>2024-01-01T00:00:00</modified><unit name="u" meter="{metre}"/>
<up_axis>{up}</up_axis></asset>
<library_effects><effect id="e"><profile_COMMON><technique sid="c"><lambert><diffuse><color>{color}</color></diffuse>
</lambert></technique></profile_COMMON></effect></library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>
<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="a" count="24">{points}</float_array>
<technique_common><accessor source="#a" count="8" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices><triangles count="12" material="m">
<input semantic="VERTEX" source="#v" offset="0"/>
<p>{corners}</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node id="n"><instance_geometry url="#g"><bind_material><technique_common>
<instance_material symbol="m" target="#m"/></technique_common></bind_material></instance_geometry></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""
    return write(file, text)


# ---------------------------------------------------------------------- /robot_description


def retrieve(address: str) -> pathlib.Path:
    """The file at an address by the rules of resource_retriever, with ament_index for packages."""
    scheme, rest = address.split("://", 1)
    if scheme == "file":
        return pathlib.Path(urllib.parse.unquote(rest))
    assert scheme == "package", address
    package, inside = rest.split("/", 1)
    prefixes = [pathlib.Path(one) for one in os.environ["AMENT_PREFIX_PATH"].split(":")]
    index = "share/ament_index/resource_index/packages"
    return next(one for one in prefixes if (one / index / package).is_file()) / "share" / package / inside


def test_other_programs_find_every_mesh_of_robot_description(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sourced package and file:// stay as the user wrote them; a relative path, an absolute path and a package that
    is not sourced become file://."""
    prefix = tmp_path / "install" / "sourced"
    write(prefix / "share/ament_index/resource_index/packages/sourced", "")
    places = {
        "package://sourced/part.stl": prefix / "share/sourced/part.stl",
        "package://beside/meshes/part.stl": tmp_path / "beside/meshes/part.stl",
        "my meshes/part.stl": tmp_path / "robots/my meshes/part.stl",
        str(tmp_path / "absolute.stl"): tmp_path / "absolute.stl",
        (tmp_path / "given.stl").as_uri(): tmp_path / "given.stl",
    }
    for place in places.values():
        place.parent.mkdir(parents=True, exist_ok=True)
        trimesh.creation.box((0.1, 0.2, 0.3)).export(place)
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path / 'nothing'}:{prefix}")
    shapes = "".join(f'<visual><geometry><mesh filename="{uri}"/></geometry></visual>' for uri in places)
    text = robot(link("base"), link("arm", shapes), "<!-- mine -->", joint("j", "base", "arm"))
    described = load_description(write(tmp_path / "robots/a.urdf", text))
    found = [mesh.get("filename") for mesh in etree.fromstring(described.ros_urdf).iter("mesh")]
    for (uri, place), address in zip(places.items(), found, strict=True):
        assert retrieve(address).samefile(place)
        if uri.startswith(("file://", "package://sourced")):
            assert address == uri
    assert "<!-- mine -->" in described.ros_urdf  # it is the user's own text


def test_robot_description_is_the_file_itself_where_nothing_has_to_change(tmp_path: pathlib.Path) -> None:
    text = robot("\n<!-- a wheel -->\n", link("base"), link("w"), joint("wheel_joint", "base", "w", "continuous"))
    assert load_description(write(tmp_path / "a.urdf", text)).ros_urdf == text


def test_a_mesh_of_a_server_is_downloaded_once(tmp_path: pathlib.Path) -> None:
    trimesh.creation.box(BOX).export(tmp_path / "part.stl")
    asked: list[str] = []

    class Handler(SimpleHTTPRequestHandler):
        def __init__(self, *arguments: object) -> None:
            super().__init__(*arguments, directory=str(tmp_path))

        def log_message(self, *arguments: object) -> None:
            asked.append(self.path)

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        address = f"http://127.0.0.1:{server.server_port}/part.stl"
        file = write(tmp_path / "a.urdf", mesh_robot(address))
        described = [load_description(file) for _ in range(2)]
    finally:
        server.shutdown()
        server.server_close()
    assert asked == ["/part.stl"]
    assert address in described[0].ros_urdf
    np.testing.assert_allclose(extents(described[1]), BOX, rtol=1e-6)


def test_a_received_robot_is_shown_by_files_of_this_machine(tmp_path: pathlib.Path) -> None:
    trimesh.creation.box(BOX).export(tmp_path / "part.stl")
    own = load_description(write(tmp_path / "a.urdf", mesh_robot("part.stl")))
    digest = etree.fromstring(own.urdf).find(".//mesh").get("digest")
    corners = np.asarray(trimesh.creation.box(BOX).triangles, np.float32)
    copy = write(tmp_path / "other" / "copy.urdf", own.urdf)
    other = load_description(copy, is_remote=True, received={digest: corners})
    for mesh in etree.fromstring(shown_urdf(other)).iter("mesh"):
        np.testing.assert_allclose(trimesh.load(retrieve(mesh.get("filename"))).extents, BOX, rtol=1e-6)


# ---------------------------------------------------------------------- meshes


@pytest.mark.parametrize("metre", [1.0, 0.01, 0.001, 0.0254])
def test_the_unit_of_collada_is_applied(metre: float, tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture) -> None:
    collada(tmp_path / "box.dae", metre)
    described = load_description(write(tmp_path / "a.urdf", mesh_robot("box.dae")))
    np.testing.assert_allclose(extents(described), BOX, rtol=1e-5)
    assert warnings_of(caplog) == []
    collision = etree.fromstring(described.urdf).find("link[@name='arm']/collision/geometry/mesh")
    np.testing.assert_allclose(trimesh.load(collision.get("filename")).extents, BOX, rtol=1e-5)


@pytest.mark.parametrize(("scale", "size"), [(1000.0, "400 m"), (0.01, "4 mm")])
def test_a_robot_in_a_wrong_unit_is_told(
    scale: float, size: str, tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture
) -> None:
    trimesh.creation.box(np.array(BOX) * scale).export(tmp_path / "part.stl")
    text = mesh_robot("part.stl").replace('lower="-1" upper="2"', 'lower="-1" upper="1"')
    load_description(write(tmp_path / "a.urdf", text))
    (warning,) = warnings_of(caplog)
    assert f"it is {size} large" in warning


@pytest.mark.parametrize("ending", ["dae", "ply", "glb", "off"])
def test_a_mesh_without_a_collision_shape_is_visible(ending: str, tmp_path: pathlib.Path) -> None:
    if ending == "dae":
        collada(tmp_path / "part.dae", 1.0)
    else:
        trimesh.creation.box(BOX).export(tmp_path / f"part.{ending}")
    described = load_description(write(tmp_path / "a.urdf", mesh_robot(f"part.{ending}", ("visual",))))
    np.testing.assert_allclose(extents(described), BOX, rtol=1e-5)
    yard = Yard(described)
    assert any(shape.kind == "mesh" for visual in yard.rigid.visuals() for shape in visual.shapes)
    assert np.isfinite(yard.run(0.1)).all()


def test_a_visible_mesh_has_its_own_colours_as_in_rviz(tmp_path: pathlib.Path) -> None:
    """Of a file with two colours each part keeps its own; a file without colours has that of the URDF."""
    red = trimesh.creation.box(BOX)
    red.visual.face_colors = [230, 20, 20, 255]
    blue = trimesh.creation.box(BOX).apply_translation([0.5, 0.0, 0.0])
    blue.visual.face_colors = [20, 20, 230, 255]
    trimesh.util.concatenate([red, blue]).export(tmp_path / "part.ply")
    trimesh.creation.box(BOX).export(tmp_path / "plain.stl")
    material = '<material name="green"><color rgba="0 1 0 1"/></material>'
    described = load_description(write(tmp_path / "a.urdf", mesh_robot("part.ply", ("visual",), material)))
    colors = sorted(shape.rgba[:3] for shape in shapes_of(described.urdf)["arm"])
    np.testing.assert_allclose(colors, np.array([[20, 20, 230], [230, 20, 20]]) / 255.0, atol=0.01)
    described = load_description(write(tmp_path / "b.urdf", mesh_robot("plain.stl", ("visual",), material)))
    assert [shape.rgba[:3] for shape in shapes_of(described.urdf)["arm"]] == [(0.0, 1.0, 0.0)]


def test_a_collada_file_that_lacks_its_texture_has_its_shape(tmp_path: pathlib.Path) -> None:
    text = collada(tmp_path / "box.dae", 1.0).read_text()
    (tmp_path / "box.dae").write_text(
        text.replace("<color>0.9 0.1 0.1 1</color>", '<texture texture="gone" texcoord="c"/>')
    )
    described = load_description(write(tmp_path / "a.urdf", mesh_robot("box.dae")))
    np.testing.assert_allclose(extents(described), BOX, rtol=1e-5)


def test_meshes_that_mujoco_does_not_read_are_converted_and_offered_to_other_clients(tmp_path: pathlib.Path) -> None:
    """A text STL: physics reads it, and other clients get its digest."""
    trimesh.creation.box(BOX).export(tmp_path / "part.stl", file_type="stl_ascii")
    described = load_description(write(tmp_path / "a.urdf", mesh_robot("part.stl")))
    mesh = etree.fromstring(described.urdf).find("link/collision/geometry/mesh")
    assert len(mesh.get("digest")) == 40
    assert np.isfinite(Yard(described).run(0.1)).all()


# ---------------------------------------------------------------------- packages


@pytest.mark.parametrize("where", ["ament", "ros1", "above", "beside", "model"])
def test_packages_are_found_in_sourced_workspaces_and_above_the_file(
    where: str, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "work/src/bringup/urdf/a.urdf"
    places = {
        "ament": tmp_path / "opt/share/parts/meshes/part.stl",
        "ros1": tmp_path / "catkin/src/group/folder/meshes/part.stl",
        "above": tmp_path / "work/src/parts/meshes/part.stl",
        "beside": tmp_path / "work/src/stack/parts/meshes/part.stl",
        "model": tmp_path / "models/parts/meshes/part.stl",
    }
    place = places[where]
    place.parent.mkdir(parents=True)
    trimesh.creation.box(BOX).export(place)
    if where == "ros1":
        write(place.parents[1] / "package.xml", "<package><name>parts</name></package>")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "opt"))
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "catkin/src"))
    monkeypatch.setenv("GZ_SIM_RESOURCE_PATH", str(tmp_path / "models"))
    scheme = "model" if where == "model" else "package"
    described = load_description(write(file, mesh_robot(f"{scheme}://parts/meshes/part.stl")))
    np.testing.assert_allclose(extents(described), BOX, rtol=1e-6)


def test_a_missing_package_is_named_with_its_remedy(tmp_path: pathlib.Path) -> None:
    with pytest.raises(DescriptionError, match=r"source the workspace with 'parts'") as caught:
        load_description(write(tmp_path / "a.urdf", mesh_robot("package://parts/meshes/part.stl")))
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------------- names


def test_names_that_ros_does_not_accept_are_replaced_everywhere(
    tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Blanks, hyphens, a leading digit and other alphabets: valid and different names in physics, frames, controllers,
    TOML, SRDF and /robot_description, and one warning."""
    names = ["Joint-1", "Joint 1", "3rd", "Плечо", "关节"]
    links = [f"Link {name}" for name in names]
    parents = ["base-link", *links]
    chain = [joint(name, parent, child) for name, parent, child in zip(names, parents, links, strict=False)]
    text = robot(*map(link, parents), *chain, name="My Arm-v2")
    file = write(tmp_path / "a.urdf", text)
    write(
        tmp_path / "a.toml", '[groups.arm]\njoints = ["Joint-1", "3rd"]\n[[imus]]\nname = "imu"\nframe = "base-link"\n'
    )
    described = load_description(file)
    (warning,) = warnings_of(caplog)
    assert "11 names are not valid" in warning
    joints, frames_of_robot = set(described.joints), set(described.link_anchors)
    assert len(joints) == len(names)
    pattern = r"[A-Za-z_][A-Za-z0-9_]*"
    for name in (*joints, *frames_of_robot, described.name, *(one.name for one in described.controllers)):
        assert re.fullmatch(pattern, name), name
    assert {described.original_names[name] for name in joints} == set(names)
    assert any("'3rd' by 'joint_3rd'" in note for note in described.notes)  # one note has all of them
    assert {old for one in described.controllers for old in one.renamed} == set(names)
    anna = Yard(described).robot
    anna.command_position([0.1, 0.2], ["3rd", "Joint-1"])  # as in the robot file
    anna.command_position([0.3], ["joint_3rd"])
    with pytest.raises(CommandError, match=r"no drive for '4th'; it drives: Joint_1, "):
        anna.command_position([0.1], ["4th"])
    assert described.imus[0].frame == "base_link"
    shown = etree.fromstring(described.ros_urdf)
    assert {one.get("name") for one in shown.iterfind("joint")} == joints
    assert {one.get("name") for one in shown.iterfind("link")} == frames_of_robot
    assert np.isfinite(Yard(described).run(0.1)).all()


# ---------------------------------------------------------------------- encodings


@pytest.mark.parametrize(
    ("declared", "encoding"),
    [("", "utf-8-sig"), ("utf-8", "latin-1"), ("utf-16", "utf-16"), ("iso-8859-1", "latin-1"), ("nonsense", "utf-8")],
)
def test_texts_of_any_encoding_are_read(declared: str, encoding: str, tmp_path: pathlib.Path) -> None:
    head = f'<?xml version="1.0" encoding="{declared}"?>' if declared else ""
    file = tmp_path / "a.urdf"
    file.write_bytes((head + robot("<author>Müller</author>", link("base"))).encode(encoding))
    assert load_description(file).base == "base"


def test_a_default_namespace_and_blank_lines_before_the_declaration_are_read(tmp_path: pathlib.Path) -> None:
    text = robot(link("base"), link("arm"), joint("j", "base", "arm"), attributes='xmlns="http://www.ros.org"')
    for version in ("1.0", "0.0"):
        described = load_description(write(tmp_path / "a.urdf", f'\n\n<?xml version="{version}"?>\n{text}'))
        assert described.joints == ("j",)
    assert etree.fromstring(described.ros_urdf).tag == "robot"


def test_a_prefix_of_a_namespace_need_not_be_declared(tmp_path: pathlib.Path) -> None:
    """As Drake's limits of acceleration, which have no declaration in many files."""
    text = robot(link("base"), link("arm"), joint("j", "base", "arm", inside='<drake:acceleration value="2"/>'))
    described = load_description(write(tmp_path / "a.urdf", text.replace("<limit ", '<limit drake:jerk="3" ')))
    assert described.drives[0].upper == 2.0
    assert etree.fromstring(described.ros_urdf).find("joint/limit").get("upper") == "2"
    assert np.isfinite(Yard(described).run(0.1)).all()


def test_a_mass_without_an_inertia_has_one(tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture) -> None:
    bare = '<link name="camera"><inertial><mass value="0.07"/></inertial></link><link name="empty"><inertial/></link>'
    fixed = joint("c", "base", "camera", "fixed") + joint("e", "base", "empty", "fixed")
    described = load_description(write(tmp_path / "a.urdf", robot(link("base"), bare, fixed)))
    assert "'camera' has no inertia" in warnings_of(caplog)[0]
    assert np.isfinite(Yard(described).run(0.1)).all()


def test_a_massless_root_before_a_mass_without_inertia_is_simulated(tmp_path: pathlib.Path) -> None:
    none = MOMENTS.replace("0.1", "0")
    body = f'<link name="body"><inertial><mass value="4"/><inertia {none}/></inertial></link>'
    text = robot(
        '<link name="base"/>', body, joint("f", "base", "body", "fixed"), link("arm"), joint("j", "body", "arm")
    )
    described = load_description(write(tmp_path / "a.urdf", text))
    assert described.mass == pytest.approx(5.0)
    assert np.isfinite(Yard(described).run(0.1)).all()


def test_a_robot_is_read_from_a_pipe_and_from_the_standard_input(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = robot(link("base"), link("arm"), joint("j", "base", "arm")).encode()
    reader, writer = os.pipe()
    os.write(writer, text)
    os.close(writer)
    assert load_description(f"/dev/fd/{reader}").joints == ("j",)
    os.close(reader)
    file = tmp_path / "a.urdf"
    file.write_bytes(text)
    with file.open() as opened:
        monkeypatch.setattr("sys.stdin", opened)
        assert load_description("-").joints == ("j",)


# ---------------------------------------------------------------------- xacro

XACRO = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="$(arg name)">
<xacro:arg name="name" default="picker"/><xacro:property name="half" value="${2 * 0.5}"/>
<xacro:include filename="$(find parts)/urdf/part.xacro"/>
<xacro:part prefix="left_"/></robot>"""
PART = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:macro name="part" params="prefix">
<link name="${prefix}base"><inertial><mass value="${half}"/></inertial></link></xacro:macro></robot>"""


def test_xacro_is_expanded_with_its_packages_and_arguments(tmp_path: pathlib.Path) -> None:
    pytest.importorskip("xacro")
    write(tmp_path / "parts/urdf/part.xacro", PART)
    file = write(tmp_path / "parts/urdf/arm.urdf.xacro", XACRO)
    described = load_description(file, xacro_args=["name:=other"])
    assert (described.name, described.base, described.mass) == ("other", "left_base", 1.0)
    assert "xacro:" not in described.ros_urdf
    with pytest.raises(DescriptionError, match="nowhere"):
        load_description(write(tmp_path / "b.xacro", XACRO.replace("parts", "nowhere")))


def test_without_xacro_one_line_says_how_to_install_it(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xacro", None)
    monkeypatch.setenv("PATH", str(tmp_path))
    for text in (XACRO, robot('<link name="${prefix}base"/>')):
        with pytest.raises(DescriptionError, match=r"pip install 'vinesim\[xacro\]'") as caught:
            load_description(write(tmp_path / "a.urdf", text))
        assert "\n" not in str(caught.value)


def test_malformed_xacro_arguments_are_refused(tmp_path: pathlib.Path) -> None:
    with pytest.raises(DescriptionError, match="NAME:=VALUE"):
        load_description(write(tmp_path / "a.urdf", robot(link("base"))), xacro_args=["name"])


# ---------------------------------------------------------------------- groups

ARM = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")


def arm(names: tuple[str, ...] = ARM) -> str:
    links = ["base", *(f"link_{i}" for i in range(1, len(names) + 1))]
    joints = [joint(name, links[i], links[i + 1]) for i, name in enumerate(names)]
    return robot(*map(link, links), *joints, '<link name="tool0"/>', joint("flange", links[-1], "tool0", "fixed"))


def test_groups_are_those_of_the_srdf(tmp_path: pathlib.Path) -> None:
    """A chain, a gripper, and a group of both: one controller for each joint, an impedance controller, and the home
    pose of the SRDF."""
    hand = link("finger") + joint("finger_joint", "tool0", "finger", "prismatic")
    file = write(tmp_path / "six.urdf", arm().replace("</robot>", f"{hand}</robot>"))
    states = "".join(f'<joint name="{name}" value="0.{number}"/>' for number, name in enumerate(ARM))
    srdf = f"""<robot name="simple"><group name="manipulator"><chain base_link="base" tip_link="tool0"/></group>
<group name="tool"><joint name="finger_joint"/></group>
<group name="both"><group name="manipulator"/><group name="tool"/></group>
<group_state name="ready" group="manipulator">{states}</group_state>
<end_effector name="ee" group="tool" parent_link="tool0"/>
<disable_collisions link1="link_1" link2="link_3" reason="Never"/></robot>"""
    write(tmp_path / "six.srdf", srdf)
    for described in (
        load_description(file),
        load_description(file, srdf=write(tmp_path / "elsewhere/other.srdf", srdf)),
    ):
        assert {name: group.joints for name, group in described.groups.items()} == {
            "manipulator": ARM,
            "tool": ("finger_joint",),
        }
        names = {one.name for one in described.controllers}
        assert {"manipulator_controller", "manipulator_impedance_controller", "tool_controller"} <= names
        assert [gripper.group for gripper in described.grippers] == ["tool"]
        np.testing.assert_allclose(described.home[:6], [0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
        assert '<disable_collisions link1="link_1" link2="link_3"/>' in described.urdf


@pytest.mark.parametrize(
    ("names", "group"),
    [
        (ARM, "manipulator"),
        (tuple(f"joint_{i}" for i in range(1, 7)), "manipulator"),
        (tuple(f"joint_a{i}" for i in range(1, 8)), "manipulator"),
        (tuple(f"panda_joint{i}" for i in range(1, 8)), "panda_arm"),
        (tuple(f"arm_left_{i}_joint" for i in range(1, 8)), "arm_left"),
        (("FL_hip_joint", "FL_thigh_joint", "FL_calf_joint"), "FL"),
    ],
)
def test_without_an_srdf_a_chain_is_one_group(names: tuple[str, ...], group: str, tmp_path: pathlib.Path) -> None:
    described = load_description(write(tmp_path / "a.urdf", arm(names)))
    assert {name: one.joints for name, one in described.groups.items()} == {group: names}
    assert f"{group}_controller" in {one.name for one in described.controllers}


# ---------------------------------------------------------------------- sensors


def test_sensors_are_those_of_gazebos_tags(tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture) -> None:
    tags = """<gazebo reference="head"><sensor name="front" type="camera"><update_rate>12</update_rate>
<pose>0.1 0 0.2 0 0.5 0</pose><camera><horizontal_fov>1.2</horizontal_fov><image><width>320</width><height>200</height>
</image><clip><near>0.05</near><far>20</far></clip><noise><type>gaussian</type><stddev>0.01</stddev></noise></camera>
</sensor></gazebo>
<gazebo reference="base_scan"><sensor name="scan" type="gpu_lidar"><update_rate>5</update_rate><lidar><scan><horizontal>
<samples>181</samples><min_angle>-1.5707963</min_angle><max_angle>1.5707963</max_angle></horizontal><vertical>
<samples>3</samples><min_angle>-0.1</min_angle><max_angle>0.1</max_angle></vertical></scan><range><min>0.1</min>
<max>12</max></range><noise><stddev>0.02</stddev></noise></lidar></sensor></gazebo>
<gazebo reference="imu_link"><sensor name="imu" type="imu"><imu><angular_velocity><x><noise>
<stddev>0.003</stddev></noise></x></angular_velocity></imu></sensor></gazebo>
<gazebo reference="head_joint"><sensor name="neck" type="force_torque"/></gazebo>
<gazebo reference="head"><sensor name="antenna" type="navsat"><update_rate>5</update_rate><navsat><position_sensing>
<horizontal><noise type="gaussian"><stddev>0.4</stddev></noise></horizontal></position_sensing></navsat></sensor>
</gazebo>
<gazebo reference="head"><sensor name="ears" type="sonar"/></gazebo>"""
    fixed = "".join(
        f'<link name="{name}"/>{joint(name + "_joint", "base", name, "fixed")}'
        for name in ("head", "base_scan", "imu_link")
    )
    described = load_description(write(tmp_path / "a.urdf", robot(link("base"), fixed, tags)))
    camera, lidar, receiver = described.sensors
    assert isinstance(camera, CameraMount)
    assert isinstance(lidar, LidarMount)
    assert isinstance(receiver, GnssMount)
    assert (receiver.name, receiver.frame, receiver.rate, receiver.fix) == ("antenna", "head", 5.0, "float")
    assert (camera.name, camera.rate, camera.size, camera.field_of_view) == ("front", 12.0, (320, 200), 1.2)
    assert (camera.range, camera.noise) == ((0.05, 20.0), 0.01)
    assert (lidar.name, lidar.frame, lidar.rate, lidar.range, lidar.noise) == (
        "scan",
        "base_scan",
        5.0,
        (0.1, 12.0),
        0.02,
    )
    assert lidar.elevations == pytest.approx((-0.1, 0.0, 0.1))
    assert (lidar.columns, lidar.sector) == (360, pytest.approx((-math.pi / 2, math.pi / 2)))
    assert (described.imus[0].name, described.imus[0].frame) == ("imu", "imu_link")
    assert described.imus[0].angular_velocity_noise == 0.003
    assert [(one.name, one.frame) for one in described.wrenches] == [("neck", "head")]
    pose = described.link_poses(described.home)[camera.frame]  # it looks along x of its pose, 0.5 rad downwards
    np.testing.assert_allclose(pose[:3], [0.1, 0.0, 0.2], atol=1e-9)
    ahead = frames.rotate(pose[3:], np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(ahead, [math.cos(0.5), 0.0, -math.sin(0.5)], atol=1e-8)
    (warning,) = warnings_of(caplog)
    assert "sonar" in warning


def test_sensors_of_links_without_tags_are_guessed(tmp_path: pathlib.Path) -> None:
    fixed = "".join(
        f'<link name="{name}"/>{joint(name + "_joint", "base", name, "fixed")}' for name in ("base_scan", "imu_link")
    )
    described = load_description(write(tmp_path / "a.urdf", robot(link("base"), fixed)))
    assert [(one.kind, one.frame) for one in described.sensors] == [("lidar", "base_scan")]
    assert [one.frame for one in described.imus] == ["imu_link"]


# ---------------------------------------------------------------------- bases


@pytest.mark.parametrize("kind", ["floating", "planar"])
def test_a_floating_or_planar_base_is_driven(kind: str, tmp_path: pathlib.Path) -> None:
    text = robot(
        '<link name="world"/>',
        link("trunk"),
        link("leg"),
        joint("root", "world", "trunk", kind),
        joint("hip", "trunk", "leg"),
    )
    described = load_description(write(tmp_path / "a.urdf", text))
    assert (described.base, described.joints) == ("trunk", ("hip",))
    yard = Yard(described)
    for _ in range(100):
        yard.robot.command_base(0.3, 0.0, yard.time)
        yard.run(yard.rigid.dt)
    assert yard.rigid.base_state("anna")[1][0] == pytest.approx(0.3, rel=0.02)


def test_a_floating_joint_elsewhere_is_fixed_with_a_warning(
    tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture
) -> None:
    text = robot(
        link("base"), link("arm"), link("box"), joint("j", "base", "arm"), joint("f", "arm", "box", "floating")
    )
    described = load_description(write(tmp_path / "a.urdf", text))
    assert described.joints == ("j",)
    assert ("arm", "box") in described.fixed_frames
    assert "'f' is floating or planar" in warnings_of(caplog)[0]


def test_a_robot_whose_root_is_above_its_feet_stands_on_the_ground(tmp_path: pathlib.Path) -> None:
    """The lowest point of a leg of 0.8 m below the pelvis is at z = 0, and loading the text again changes nothing."""
    leg = '<collision><origin xyz="0 0 -0.4"/><geometry><box size="0.1 0.1 0.8"/></geometry></collision>'
    text = robot(link("pelvis"), link("leg", leg), joint("hip", "pelvis", "leg").replace('lower="-1"', 'lower="-2"'))
    described = load_description(write(tmp_path / "a.urdf", text))
    assert described.base == "base_footprint"
    assert described.link_poses(described.home)["pelvis"][2] == pytest.approx(0.8, abs=1e-5)
    again = load_description(write(tmp_path / "b.urdf", described.urdf))
    assert again.urdf == described.urdf


# ---------------------------------------------------------------------- MJCF

MJCF = """<mujoco model="walker"><compiler angle="radian"/><asset><material name="red" rgba="0.8 0.1 0.1 1"/>
<mesh name="tetra" vertex="0 0 0 0.2 0 0 0 0.2 0 0 0 0.2"/></asset>
<worldbody><geom type="plane" size="5 5 0.1"/><body name="torso" pos="0 0 0.6"><freejoint/>
<geom type="box" size="0.2 0.1 0.05" material="red" mass="4"/><camera name="eye" pos="0.2 0 0" xyaxes="0 -1 0 0 0 1"/>
<site name="imu" pos="0.01 0 0"/>
<body name="thigh" pos="0.1 0.05 0" euler="0.3 0 0">
<joint name="hip" axis="0 1 0" pos="0 0 0.02" range="-1 1" ref="0.2"/>
<joint name="hip_roll" axis="1 0 0" range="-0.5 0.5"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.03" mass="1"/>
<body name="shank" pos="0 0 -0.25"><joint name="knee" type="slide" axis="0 0 1" range="-0.1 0.1"/>
<geom type="ellipsoid" size="0.03 0.03 0.1" mass="0.5"/>
<geom type="mesh" mesh="tetra" contype="0" conaffinity="0" mass="0"/>
</body></body></body></worldbody>
<actuator><motor joint="hip" gear="20" ctrlrange="-2 2"/></actuator>
<sensor><gyro site="imu"/></sensor>
<keyframe><key name="home" qpos="0 0 0.6 1 0 0 0 0.4 -0.1 0.05"/></keyframe></mujoco>"""


def test_a_robot_of_mujoco_has_the_kinematics_of_mujoco(tmp_path: pathlib.Path) -> None:
    """Oracle: MuJoCo's own model of the file, at random positions within the limits."""
    file = write(tmp_path / "walker.xml", MJCF)
    described = load_description(file)
    assert (described.name, described.base) == ("walker", "base_footprint")
    m = mujoco.MjModel.from_xml_path(str(file))
    d = mujoco.MjData(m)
    assert described.mass == pytest.approx(float(m.body_mass.sum()), abs=2e-3)  # a link of 1 g between two joints
    assert dict(zip(described.joints, described.home, strict=True)) == pytest.approx(
        {"hip": 0.2, "hip_roll": -0.1, "knee": 0.05}  # of the keyframe, 0 in the pose in which the file draws it
    )
    rng = np.random.default_rng(3)
    for _ in range(5):
        position = np.array([rng.uniform(one.lower, one.upper) for one in described.drives])
        for name, value in zip(described.joints, position, strict=True):
            adr = m.jnt_qposadr[m.joint(name).id]
            d.qpos[adr] = m.qpos0[adr] + value
        mujoco.mj_kinematics(m, d)
        poses = described.link_poses(position)
        root = frames.compose(
            frames.pose(d.body("torso").xpos, frames.from_wxyz(d.body("torso").xquat)), frames.inverse(poses["torso"])
        )
        for body in ("thigh", "shank"):
            found = frames.compose(root, poses[body])
            np.testing.assert_allclose(found[:3], d.body(body).xpos, atol=1e-6)
            turn = frames.to_matrix(found[3:])
            np.testing.assert_allclose(turn, d.body(body).xmat.reshape(3, 3), atol=1e-6)
    assert described.drives[0].effort == pytest.approx(40.0)


def test_a_robot_of_mujoco_shows_its_shapes_and_holds_its_pose(tmp_path: pathlib.Path) -> None:
    described = load_description(write(tmp_path / "walker.xml", MJCF))
    shapes = shapes_of(described.urdf)
    assert [shape.kind for shape in shapes["thigh"]] == ["cylinder", "sphere", "sphere"]
    assert shapes["torso"][0].rgba[:3] == pytest.approx((0.8, 0.1, 0.1))
    assert [shape.kind for shape in shapes["shank"]] == ["mesh", "mesh"]
    collisions = etree.fromstring(described.urdf).findall("link[@name='shank']/collision")
    assert len(collisions) == 1  # the mesh without contacts is visible only
    assert [one.name for one in (*described.sensors, *described.imus)] == ["eye", "imu"]
    ahead = frames.rotate(
        described.link_poses(0.0 * described.home)[described.sensors[0].frame][3:], np.array([0.0, 0.0, 1.0])
    )
    np.testing.assert_allclose(ahead, [1.0, 0.0, 0.0], atol=1e-6)
    for mesh in etree.fromstring(described.ros_urdf).iter("mesh"):
        assert retrieve(mesh.get("filename")).is_file()
    np.testing.assert_allclose(Yard(described).run(1.0)[-1, 0], described.home, atol=1e-3)


def test_a_ball_joint_becomes_three_axes_and_an_equality_a_mimic(tmp_path: pathlib.Path) -> None:
    text = """<mujoco model="hand"><worldbody><body name="palm"><geom size="0.05"/>
<body name="ball" pos="0 0 0.1"><joint name="b" type="ball"/><geom size="0.02"/></body>
<body name="left"><joint name="l" type="slide" axis="0 1 0" range="0 0.04"/><geom size="0.01"/></body>
<body name="right"><joint name="r" type="slide" axis="0 -1 0" range="0 0.04"/><geom size="0.01"/></body></body>
</worldbody><equality><joint joint1="r" joint2="l" polycoef="0 1 0 0 0"/></equality></mujoco>"""
    described = load_description(write(tmp_path / "hand.xml", text))
    assert described.joints == ("b_x", "b_y", "b_z", "l")
    assert set(described.moving_joints.names) == {"b_x", "b_y", "b_z", "l", "r"}
    assert described.base_limits.linear == 0.0  # bolted down: no free joint


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<mujoco><worldbody/></mujoco>", "no bodies"),
        ("<mujoco><worldbody><body><joint/>", "XML"),
        ("<mujoco><oops/></mujoco>", "MuJoCo"),
    ],
)
def test_faults_of_mjcf_are_reported_in_one_line(text: str, words: str, tmp_path: pathlib.Path) -> None:
    with pytest.raises(DescriptionError, match=words) as caught:
        load_description(write(tmp_path / "a.xml", text))
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------------- SDF

SDF = """<sdf version="1.8"><model name="cart"><pose>1 2 3 0 0 0</pose>
<link name="chassis"><pose>0 0 0.2 0 0 0.5</pose><inertial><mass>5</mass><inertia><ixx>0.1</ixx><iyy>0.1</iyy>
<izz>0.1</izz></inertia></inertial><visual name="v"><geometry><box><size>0.4 0.2 0.1</size></box></geometry><material>
<diffuse>0.1 0.7 0.1 1</diffuse></material></visual><collision name="c"><geometry><box><size>0.4 0.2 0.1</size></box>
</geometry></collision><sensor name="eye" type="camera"><pose>0.2 0 0 0 0 0</pose><camera><image><width>64</width>
<height>48</height></image></camera></sensor></link>
<frame name="mast" attached_to="chassis"><pose>0 0 0.3 0 0 0</pose></frame>
<link name="arm"><pose relative_to="mast">0.1 0 0 0 0 0</pose><inertial><mass>1</mass></inertial>
<visual name="v"><geometry><mesh><uri>model://cart/meshes/part.stl</uri></mesh></geometry></visual></link>
<joint name="lift" type="revolute"><pose>-0.1 0 0 0 0 0</pose><parent>chassis</parent><child>arm</child>
<axis><xyz expressed_in="__model__">0 0 1</xyz><limit><lower>-1</lower><upper>1</upper><effort>9</effort></limit></axis>
</joint></model></sdf>"""


def test_a_robot_of_gazebo_is_read(tmp_path: pathlib.Path) -> None:
    """Its poses are those that SDF defines: frames, relative poses, a joint beside its link, an axis in the model."""
    (tmp_path / "cart/meshes").mkdir(parents=True)
    trimesh.creation.box(BOX).export(tmp_path / "cart/meshes/part.stl")
    described = load_description(write(tmp_path / "cart/model.sdf", SDF))
    assert (described.name, described.joints, described.mass) == ("cart", ("lift",), pytest.approx(6.0))
    assert (described.drives[0].lower, described.drives[0].effort) == (-1.0, 9.0)
    for angle in (0.0, 0.7):
        poses = described.link_poses(np.array([angle]))
        arm_pose = frames.compose(frames.inverse(poses["chassis"]), poses["arm"])
        np.testing.assert_allclose(arm_pose[:3], [0.0, 0.0, 0.3], atol=1e-6)  # the anchor of the joint
        np.testing.assert_allclose(arm_pose[3:], frames.exp(np.array([0.0, 0.0, angle])), atol=1e-6)
    (shape,) = shapes_of(described.urdf)["arm"]
    np.testing.assert_allclose(shape.pose[:3], [0.1, 0.0, 0.0], atol=1e-6)
    assert shapes_of(described.urdf)["chassis"][0].rgba[:3] == pytest.approx((0.1, 0.7, 0.1))
    assert [(one.name, one.kind) for one in described.sensors] == [("eye", "camera")]
    assert np.isfinite(Yard(described).run(0.2)).all()


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.sdf", "<sdf version='1.8'><world name='w'/></sdf>", "no model with links"),
        ("a.usd", "#usda 1.0", "nvidia-srl-usd-to-urdf"),
        ("a.proto", "PROTO Robot []", "Webots"),
        ("a.xml", "<html/>", "root is <html>"),
    ],
)
def test_what_is_not_read_is_told_in_one_line(name: str, text: str, words: str, tmp_path: pathlib.Path) -> None:
    with pytest.raises(DescriptionError, match=words) as caught:
        load_description(write(tmp_path / name, text))
    assert "\n" not in str(caught.value)


def test_a_folder_is_answered_with_the_robot_files_in_it(tmp_path: pathlib.Path) -> None:
    write(tmp_path / "urdf/a.urdf", robot(link("base")))
    with pytest.raises(DescriptionError, match=r"urdf/a\.urdf"):
        load_description(tmp_path)
