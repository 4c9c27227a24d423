"""Plants of other programs: read alike from all formats, as heavy and as stiff as ones made by hand, or refused."""

import pathlib

import msgspec
import numpy as np
import pytest
from typer.testing import CliRunner

import vinesim
from vinesim.cli import app
from vinesim.core import frames
from vinesim.scene.cane import CaneBuilder
from vinesim.scene.ids import Organ
from vinesim.scene.plant_import.imported_plant import load_imported_plant
from vinesim.scene.plant_import.skeleton import PlantFileError
from vinesim.scene.plant_import.wood import build_model
from vinesim.scene.plant_parameters import load_plant
from vinesim.scene.spec import SceneError, load_scene

PLANTS = pathlib.Path(__file__).parents[2] / "examples" / "plants"
HEAD = "CODE:\tFORM-A\nCLASSES:\nFEATURES:\nNAME\tTYPE\nXX\tREAL\nYY\tREAL\nZZ\tREAL\ndiam\tREAL\nMTG:\n"
TABLE = HEAD + "ENTITY-CODE\t\t\tXX\tYY\tZZ\tdiam\n"
PLY = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
CYLINDERS = (PLANTS / "vine_cylinders.txt").read_text()


def grown(plant, pose=frames.pose(np.zeros(3))):
    return build_model(plant, pose, 0, load_plant("vine"), 0)


def imported(tmp_path, text, name="plant.mtg", **options):
    file = tmp_path / name
    file.write_text(text)
    return vinesim.import_plant(file, **options)


@pytest.mark.parametrize("name", ["vine.mtg", "vine.ply", "vine_cylinders.txt", "vine.xml"])
def test_all_formats_give_the_same_wood(name):
    plant = vinesim.import_plant(PLANTS / name)
    wanted = load_imported_plant(str(PLANTS / "vine.toml"))
    has_fruit = name in ("vine.mtg", "vine.ply")
    assert sorted(mass for _, mass in plant.bunches) == ([0.3, 0.45, 0.6] if has_fruit else [])
    assert not plant.filled
    points = plant.skeleton()
    others = wanted.skeleton()
    order, other = (np.lexsort(one.position.round(3).T) for one in (points, others))
    np.testing.assert_allclose(points.position[order], others.position[other], atol=5e-4)
    wood = [model.body_mass[model.body_organ == int(Organ.CANE)] for model in (grown(plant), grown(wanted))]
    assert wood[0].sum() == pytest.approx(wood[1].sum(), rel=0.01)  # cylinders have one radius, not two
    sizes = sorted(grown(msgspec.structs.replace(plant, bunches=())).tree_size)
    np.testing.assert_allclose(sizes, [15, 15, 20], atol=1)  # rounded, a length of 14.5 pieces has either


def test_an_imported_cane_sags_and_weighs_as_one_made_by_hand(tmp_path):
    rows = "".join(f"{'/P1/E1' if i == 0 else '^<E' + str(i + 1)}\t\t\t{10 * i}\t0\t0\t8\n" for i in range(11))
    plant = imported(tmp_path, TABLE + rows, unit="cm", diameter_unit="mm", shape="slack", piece=0.05)
    wood = plant.wood
    even = msgspec.structs.replace(wood.woody_modulus, value=3e9)
    vacuum = msgspec.structs.replace(wood.drag, value=1e-9)
    wood = msgspec.structs.replace(wood, woody_modulus=even, green_modulus=even, drag=vacuum)
    plant = msgspec.structs.replace(plant, wood=wood)
    model = grown(plant, frames.pose(np.array([0.0, 0.0, 1.0])))
    by_hand = CaneBuilder(
        length=1.0, radius=0.004, youngs_modulus=3e9, density=wood.density.value, beta=wood.damping.value, segments=20
    ).build()
    for name in ("body_mass", "body_inertia", "joint_stiffness", "joint_damping"):
        np.testing.assert_allclose(getattr(model, name), getattr(by_hand, name), rtol=1e-5, err_msg=name)
    tips = []
    for one in (model, by_hand):
        simulation = vinesim.Simulation(one)
        simulation.wake()
        simulation.step(125)
        tips.append(simulation.tip() - one.tree_pose[0, :3])
    assert tips[0][2] < -0.1  # at the lowest point of its third swing
    np.testing.assert_allclose(*tips, atol=1e-4)


def test_a_scene_with_an_imported_plant_is_in_equilibrium_as_drawn():
    scene = load_scene(PLANTS / "scene.toml")
    simulation = vinesim.Simulation(scene)
    model = simulation.model
    before = simulation.state.body_q.copy()
    trees = np.flatnonzero(model.tree_vine == 1)
    ours = np.isin(model.body_tree, trees)
    assert len(trees) == 3
    assert np.isin(model.body_tree[model.bunch_body], trees).sum() == 3
    assert np.isin(model.leaf_body, np.flatnonzero(ours)).sum() > 50
    assert np.isin(model.tie_body, np.flatnonzero(ours)).sum() == 2
    bare = msgspec.structs.replace(scene, imported=(msgspec.structs.replace(scene.imported[0], leaves=False),))
    assert vinesim.generate(bare).body_mass[ours].sum() == pytest.approx(
        grown(load_imported_plant(scene.imported[0].file)).body_mass.sum()
    )
    simulation.wake()
    simulation.step(50)
    assert np.linalg.norm((simulation.state.body_q - before)[:, :3], axis=1).max() < 1e-4
    alone = vinesim.generate(msgspec.structs.replace(scene, imported=()))
    for name in ("body_mass", "joint_stiffness", "tie_body", "fixed_start"):
        assert np.array_equal(getattr(model, name)[: len(getattr(alone, name))], getattr(alone, name)), name
    side = simulation.tip(int(trees[0])).copy()
    simulation.apply_wrench(simulation.tip_body(int(trees[0])), (0.0, 0.5, 0.0))
    simulation.step()
    simulation.step(20)
    assert np.linalg.norm(simulation.tip(int(trees[0])) - side) > 1e-4  # it gives


def test_old_wood_stands_still_and_all_else_moves():
    plant = vinesim.import_plant(PLANTS / "vine.mtg")
    wholly = grown(msgspec.structs.replace(plant, wood=_with_old_wood(plant, 0.2)))
    assert wholly.counts()["fixed"] == 0
    assert wholly.counts()["tree"] == 1
    none = grown(msgspec.structs.replace(plant, wood=_with_old_wood(plant, 0.001)))
    assert none.counts()["tree"] == 0
    assert none.counts()["fixed"] > 25 + 45


def _with_old_wood(plant, diameter):
    return msgspec.structs.replace(plant.wood, old_wood=msgspec.structs.replace(plant.wood.old_wood, value=diameter))


def test_what_is_missing_is_filled_and_marked(tmp_path):
    rows = "/P1/A1/E1\t\t\t0\t0\t0\n^<E2\t\t\t0\t0\t0.2\t0.008\n^+A2\n\t/E1\t\t0.1\t0\t0.2\n"
    rows += "^<E3<E4\t\t\t0\t0\t0.6\t0.004\n^<E5\t\t\t0\t0\t0.8\n"
    plant = imported(tmp_path, TABLE + rows)
    parent, _x, _y, height, diameter = np.array(plant.nodes).T
    assert plant.filled == (0, 2, 4)  # nodes in the order of their distance from the base
    assert parent.tolist() == [-1, 0, 1, 1, 3]  # the branch ends with its column
    assert height.tolist() == [0.0, 0.2, 0.2, 0.6, 0.8]
    assert (diameter[0], diameter[1], diameter[3], diameter[4]) == (0.008, 0.008, 0.004, 0.004)
    assert diameter[2] <= 0.008
    for name in plant.wood.__struct_fields__:
        assert getattr(plant.wood, name).source.startswith("filled"), name
    plant.write(tmp_path / "plant.toml")
    assert load_imported_plant(str(tmp_path / "plant.toml")) == plant


MEASURED = """\
/P1/E1\t\t\t0\t0\t0\t20\t01/03/24
*\t\t\t\t\t\t22\t01/05/24
^<E2\t\t\t0\t0\t0,3\t12\t01/03/24
*\t\t\t\t\t\t0\t01/05/24
^<E3\t\t\t0\t0\t0,6\t0\t01/05/24
^<E4\t\t\t0\t0\t0,8\tNA\t01/05/24
^<E5\t\t\t0\t0\t0,9\t6,5\t01/05/24
"""


def test_dates_and_diameters_that_were_not_measured(tmp_path):
    """The last measurement of each entity counts; 0 and NA are none; decimals may have commas."""
    table = TABLE.replace("diam\tREAL\n", "diam\tREAL\nDate\tDD/MM/YY\n").replace("ZZ\tdiam\n", "ZZ\tdiam\tDate\n")
    plant = imported(tmp_path, table + MEASURED, diameter_unit="mm")
    diameter = np.array(plant.nodes)[:, 4]
    assert plant.filled == (2, 3)
    np.testing.assert_allclose(diameter[[0, 1, 4]], [0.022, 0.012, 0.0065])
    assert 0.0065 < diameter[3] < diameter[2] < 0.012
    assert np.array(plant.nodes)[:, 3].tolist() == [0.0, 0.3, 0.6, 0.8, 0.9]
    assert plant.notes[1:] == ("1 diameters are 0, which is taken as not measured",)


def test_a_ply_file_with_other_line_ends_lists_and_faces_first(tmp_path):
    """The same five vertices, as a mesh program and as an editor of Windows write them."""
    rows = ["0 0 0 0.02", "0 0 0.3 0.015", "0.02 0 0.6 0.01", "0.05 0.02 0.9 0.006", "0.2 0 0.5 0.005"]
    head = "ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int vertex_indices\nelement vertex 5\n"
    head += "".join(f"property float {name}\n" for name in ("x", "y", "z", "scalar_Radius"))
    head += "property list uchar float near\nelement edge 4\nproperty int vertex1\nproperty int vertex2\nend_header\n"
    body = "3 0 1 2\n" + "".join(f"{row} {i} {'7 ' * i}\n" for i, row in enumerate(rows)) + "0 1\n1 2\n2 3\n4 1\n"
    wanted = None
    for end in ("\n", "\r\n", "\r"):
        (tmp_path / "plant.ply").write_bytes((head + body).replace("\n", end).encode())
        plant = vinesim.import_plant(tmp_path / "plant.ply")
        wanted = wanted or plant.nodes
        assert plant.nodes == wanted
    parent, _, _, height, diameter = np.array(wanted).T
    assert parent.tolist() == [-1, 0, 1, 1, 2]
    np.testing.assert_allclose(height, [0.0, 0.3, 0.6, 0.5, 0.9])
    np.testing.assert_allclose(diameter, [0.04, 0.03, 0.02, 0.01, 0.012])


BAD = {
    "blanks for tabs": ("plant.mtg", HEAD + "ENTITY-CODE XX YY ZZ\n/P1 0 0 0\n", "line 10: has no tabs; separate"),
    "two of three axes": ("plant.mtg", TABLE + "/P1\t\t\t0\t0\n", "line 11: has XX and YY alone; give XX, YY and ZZ"),
    "both decimals": ("plant.mtg", TABLE + "/P1\t\t\t0.5\t0,5\t0\n", "yy is '0,5', and other numbers have"),
    "negative diameter": (
        "plant.mtg",
        TABLE + "/E1\t\t\t0\t0\t0\t-1\n^<E2\t\t\t0\t0\t9\n",
        "1e-05 m or more, or 0",
    ),
    "thick": ("plant.mtg", TABLE + "/E1\t\t\t0\t0\t0\t9\n^<E2\t\t\t0\t0\t9\n", "give the unit of diameters, up to"),
    "picture": ("plant.ply", "ply\n" + "\0" * 90, "has no line 'end_header'"),
    "long row": (
        "plant.ply",
        PLY + "property int parent\nend_header\n0 0 0 -1\n0 0 1 0 5\n0 0 2 1\n",
        "line 10: a row",
    ),
    "too many rows": (
        "plant.ply",
        PLY + "property int parent\nend_header\n" + "0 0 0 -1\n" * 4,
        "line 12: follows the last",
    ),
    "parent between": (
        "plant.ply",
        PLY + "property float parent\nend_header\n0 0 0 -1\n0 0 1 0\n0 0 2 0.5\n",
        "parent is 0.5",
    ),
    "no MTG": ("plant.mtg", "hello\n", "has no section 'MTG:'"),
    "another code": ("plant.mtg", HEAD.replace("FORM-A", "FORM-B"), "only FORM-A can be read"),
    "no geometry": ("plant.mtg", TABLE + "/P1\n^<E2\n", "no entity has coordinates"),
    "word for a number": ("plant.mtg", TABLE + "/P1\t\t\t0\t0\tup\n", "line 11: zz is 'up'; give a number"),
    "bad code": ("plant.mtg", TABLE + "/P1\n^<E2[E3\n", "cannot be read from '[E3' on"),
    "nothing above": ("plant.mtg", TABLE + "\t\t+E1\n", "has nothing above it to continue"),
    "millimetres": ("plant.mtg", TABLE + "/E1\t\t\t0\t0\t0\n^<E2\t\t\t0\t0\t900\n", "give the unit of its lengths"),
    "two plants": ("plant.mtg", TABLE + "/E1\t\t\t0\t0\t0\n/E2\t\t\t1\t0\t0\n", "has 2 plants or a loop"),
    "point cloud": ("plant.ply", PLY + "end_header\n0 0 0\n0 0 1\n0 1 1\n", "tells no topology"),
    "loop": (
        "plant.ply",
        PLY + "element edge 2\nproperty int vertex1\nproperty int vertex2\nend_header\n0 0 0\n0 0 1\n0 1 1\n1 2\n2 1\n",
        "not joined to the base",
    ),
    "short": ("plant.ply", PLY + "property int parent\nend_header\n0 0 0 -1\n", "fewer than 3 rows"),
    "no PLY": ("plant.ply", "solid\n", "is no PLY file"),
    "loose cylinder": ("plant.txt", CYLINDERS + "0.004\t0.1\t5\t0\t0\t0\t0\t1\t1\n", "starts 4"),
    "grown, not drawn": (
        "plant.xml",
        "<helios><plant_instance ID='0'><base_position> 0 0 0 </base_position><shoot ID='0'/>"
        "</plant_instance></helios>",
        "write the cylinders instead: writeQSMCylinderFile",
    ),
    "no XML": ("plant.xml", "<helios>", "not valid XML"),
    "mesh": ("plant.obj", "v 0 0 0\n", "give one of: .mtg, .ply, .txt, .xml"),
}


@pytest.mark.parametrize(("name", "text", "said"), BAD.values(), ids=BAD)
def test_what_cannot_be_read_is_refused_in_one_line(tmp_path, name, text, said):
    with pytest.raises(PlantFileError) as refused:
        imported(tmp_path, text, name)
    line = str(refused.value)
    assert line.startswith(str(tmp_path / name))
    assert said in line
    assert "\n" not in line


def test_the_command_writes_what_a_scene_loads(tmp_path):
    (tmp_path / "scene.toml").write_text((PLANTS / "scene.toml").read_text())
    with pytest.raises(SceneError, match=r"imported\[0\].file: .*vine.toml: no such file; write it with"):
        load_scene(tmp_path / "scene.toml")
    words = ["scene", "import-plant", str(PLANTS / "vine.mtg"), "--out", str(tmp_path / "vine.toml")]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert "3 trees of 75 bodies" in done.output
    assert "25 pieces of wood" in done.output
    assert (tmp_path / "vine.toml").read_text() == (PLANTS / "vine.toml").read_text()
    here, there = (vinesim.generate(load_scene(folder / "scene.toml")) for folder in (tmp_path, PLANTS))
    assert here.digest() == there.digest()
