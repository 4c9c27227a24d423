"""Leaves and ties of imported plants."""

from __future__ import annotations

import pathlib

import msgspec
import numpy as np
import pytest

import vinesim
from vinesim.core import frames
from vinesim.scene import leaves
from vinesim.scene.generation.vineyard import generate_uncached
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.plant_import.imported_plant import ImportedPlant
from vinesim.scene.spec import Imported, Scene, Season, load_scene

SCENE = pathlib.Path(__file__).parents[2] / "examples" / "plants" / "scene.toml"
WIRE = 0.0014 + 0.0425
"""[m] How far a catch wire is beside its row."""


def cane(
    tmp_path: pathlib.Path, ends: list[tuple[float, float, float]], diameter: float = 0.008, **options: float
) -> ImportedPlant:
    """A straight cane from the origin over ``ends``, cut into pieces of 5 cm."""
    rows = ["0 0 0 -1", *(f"{x} {y} {z} {i}" for i, (x, y, z) in enumerate(ends))]
    head = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *(f"property float {name}" for name in "xyz")]
    text = "\n".join([*head, "property int parent", "property float diameter", "end_header"])
    (tmp_path / "cane.ply").write_text("\n".join([text, *(f"{row} {diameter}" for row in rows)]) + "\n")
    return vinesim.import_plant(tmp_path / "cane.ply", piece=0.05, **options)


def planted(tmp_path: pathlib.Path, plant: ImportedPlant, **options: float) -> Scene:
    """The example's scene with this plant instead of its own."""
    plant.write(tmp_path / "plant.toml")
    scene = load_scene(SCENE)
    return msgspec.structs.replace(
        scene, imported=(Imported(file=str(tmp_path / "plant.toml"), **({"x": 1.5, "y": 0.0} | options)),)
    )


def part(model: Model, first: int) -> np.ndarray:
    """Bodies of the vine with this number."""
    return np.flatnonzero(model.tree_vine[model.body_tree] == first)


def blade_area(model: Model, chosen: np.ndarray) -> np.ndarray:
    """Area of leaves, as it was drawn [m^2]: sizes are those of the mean outline."""
    return model.leaf_size[chosen] ** 2 * leaves.BLADE_AREA


def test_leaves_stand_at_the_nodes_of_a_cane_left_and_right_in_turn(tmp_path):
    """1 m has 18 nodes of 1.22 m / 22.5; each leaf has the area that the parameters say, less at the tip."""
    model = generate_uncached(planted(tmp_path, cane(tmp_path, [(0.0, 0.0, 1.0)])))
    bodies = part(model, 1)
    ours = np.flatnonzero(np.isin(model.leaf_body, bodies))
    assert len(ours) == 18
    pose = model.forward_kinematics(model.joint_settled)[model.leaf_body[ours]]
    base = frames.compose(pose, frames.pose(model.leaf_base[ours]))[:, :3] - [1.5, 0.0, 0.0]
    height = (np.arange(18) + 0.7) / 18.0
    np.testing.assert_allclose(base[:, 2], height, atol=0.004)  # at the bark
    blade = frames.compose(pose, model.leaf_pose[ours])[:, :3] - [1.5, 0.0, 0.0]
    side = np.sign(blade[:, 1])  # out of the hedge
    assert (side[1:] == -side[:-1]).all()
    area = blade_area(model, ours)
    shrink = 1.0 - 0.65 * np.clip((height - 0.75) / 0.25, 0.0, 1.0)
    assert ((area > 0.0099 * shrink) & (area < 0.0201 * shrink)).all()


def test_leaves_weigh_and_drag_on_what_carries_them(tmp_path):
    scene = planted(tmp_path, cane(tmp_path, [(0.0, 0.0, 0.5), (0.0, 0.2, 1.0)]))
    model = generate_uncached(scene)
    bare = generate_uncached(
        msgspec.structs.replace(scene, imported=(msgspec.structs.replace(scene.imported[0], leaves=False),))
    )
    bodies = part(model, 1)
    ours = np.isin(model.leaf_body, bodies)
    assert not np.isin(bare.leaf_body, bodies).any()
    area = blade_area(model, ours)
    extra = (model.body_mass - bare.body_mass)[bodies]
    assert extra.sum() == pytest.approx(
        0.22 * area.sum() + 0.001 * ours.sum(), rel=0.05
    )  # petioles at the tip are short
    assert (model.body_drag - bare.body_drag)[bodies].sum() == pytest.approx(0.2 * area.sum(), rel=1e-4)
    # one leaf on a piece: it is a point mass where its blade begins
    carrier, count = np.unique(model.leaf_body[ours], return_counts=True)
    for body in carrier[count == 1]:
        blade = model.leaf_pose[ours][model.leaf_body[ours] == body][0, :3]
        mass = bare.body_mass[body]
        added = model.body_mass[body] - bare.body_mass[body]
        com = (mass * bare.body_com[body] + added * blade) / (mass + added)
        np.testing.assert_allclose(model.body_com[body], com, atol=1e-5)
        reduced = mass * added / (mass + added)
        arm = (blade - bare.body_com[body]) ** 2
        wanted = bare.body_inertia[body] + reduced * (arm.sum() - arm)
        np.testing.assert_allclose(model.body_inertia[body], wanted, rtol=1e-3)


def test_old_wood_is_bare_side_shoots_have_small_leaves_and_the_season_takes_them(tmp_path):
    """A cane of 14 mm, older than a year, with two shoots of 8 mm, and on one of them a side shoot."""
    ends = [(0.0, 0.0, 0.3), (0.0, 0.0, 0.6), (0.3, 0.0, 1.0), (-0.3, 0.0, 1.0), (0.5, 0.0, 0.9), (0.6, 0.0, 1.3)]
    parent = [-1, 0, 1, 2, 2, 3, 3]
    thick = [0.014, 0.014, 0.014, 0.008, 0.008, 0.004, 0.005]
    plant = cane(tmp_path, ends)
    nodes = tuple((p, *node[1:4], d) for p, node, d in zip(parent, plant.nodes, thick, strict=True))
    plant = msgspec.structs.replace(plant, nodes=nodes)
    scene = planted(tmp_path, plant)
    model = generate_uncached(scene)
    ours = np.isin(model.leaf_body, part(model, 1))
    carrier = model.leaf_body[ours]
    assert model.body_radius[carrier, 1].max() <= 0.00525
    shoots = 0.5 + 0.5 + np.hypot(0.3, 0.3)
    lateral = np.hypot(0.2, 0.1)
    assert ours.sum() == pytest.approx((shoots + lateral) / 0.0542, abs=2)
    pose = model.forward_kinematics(model.joint_settled)[carrier]
    on_side = (pose[:, 0] > 1.79) & (frames.compose(pose, frames.pose(model.leaf_base[ours]))[:, 2] < 0.995)
    assert on_side.sum() == 4
    area = blade_area(model, ours)
    assert 0.0054 < area[on_side].max() < 0.0111  # 0.55 of the 0.01 to 0.02 m^2 on main axes
    assert area[~on_side].max() > 0.0111
    for leafiness in (0.0, 0.5):
        some = generate_uncached(msgspec.structs.replace(scene, season=Season(leafiness=leafiness)))
        left = np.isin(some.leaf_body, part(some, 1)).sum()
        assert left == (0 if leafiness == 0.0 else pytest.approx(0.5 * ours.sum(), abs=10))


@pytest.mark.parametrize(
    ("gap", "tie_gap", "ties"), [(0.015, 0.02, 4), (0.025, 0.02, 0), (0.025, 0.03, 4), (0.015, 0.0, 0)]
)
def test_a_cane_is_tied_to_the_wires_that_it_passes_closely(tmp_path, gap, tie_gap, ties):
    """Up along four catch wires of one side, 28 cm apart."""
    away = WIRE + 0.0014 + gap + 0.004
    scene = planted(tmp_path, cane(tmp_path, [(0.0, 0.0, 2.0)]), y=away, tie_gap=tie_gap)
    model = generate_uncached(scene)
    ours = np.flatnonzero(np.isin(model.tie_body, part(model, 1)))
    assert len(ours) == ties
    if not ties:
        return
    np.testing.assert_allclose(model.tie_anchor[ours], [[1.5, away, 0.8 + 0.28 * k] for k in range(1, 5)], atol=2e-3)
    pose = model.forward_kinematics(model.joint_settled)[model.tie_body[ours]]
    point = frames.compose(pose, frames.pose(model.tie_point[ours]))[:, :3]
    np.testing.assert_allclose(point, model.tie_anchor[ours], atol=1e-5)  # slack as drawn
    wire = model.tie_wire[ours]
    assert (model.fixed_organ[wire] == int(Organ.WIRE)).all()
    np.testing.assert_allclose(model.fixed_start[wire, 1], WIRE, atol=1e-6)
    np.testing.assert_allclose(model.fixed_start[wire, 2], model.tie_anchor[ours, 2], atol=2e-3)
    assert (np.diff(model.tie_body) >= 0).all()


def test_a_cane_along_a_wire_is_tied_every_20_cm(tmp_path):
    ends = [(0.0, 0.0, 0.2), (0.0, WIRE + 0.015, 0.28), (0.25, WIRE + 0.015, 0.28)]
    scene = planted(tmp_path, cane(tmp_path, ends), x=1.5, z=0.8)
    model = generate_uncached(scene)
    anchor = model.tie_anchor[np.isin(model.tie_body, part(model, 1))]
    assert len(anchor) == 2
    assert np.linalg.norm(anchor[1] - anchor[0]) >= 0.2


def test_a_tied_cane_gives_as_its_tie_and_its_wire_do(tmp_path):
    """4 N where it is tied by 2000 N/m to a wire under 900 N, in the middle of a span of 0.6 m: at most 1 / 2000 +
    0.3 * 0.3 / 0.6 / 900 m/N, since the cane and its other ties hold some of it. Untied it gives over 20 times more."""
    moved = []
    for tie_gap in (0.02, 0.0):
        scene = planted(tmp_path, cane(tmp_path, [(0.0, 0.0, 1.9)], 0.01), y=WIRE + 0.02, tie_gap=tie_gap)
        simulation = vinesim.Simulation(generate_uncached(scene))
        bodies = part(simulation.model, 1)
        body = int(bodies[np.searchsorted(simulation.state.body_q[bodies, 2], 1.64) - 1])
        point = frames.pose([1.64 - simulation.state.body_q[body, 2], 0.0, 0.0])
        before = frames.compose(simulation.state.body_q[body], point)[:3]
        for _ in range(300):
            simulation.apply_wrench(body, (0.0, 4.0, 0.0), at=frames.compose(simulation.state.body_q[body], point)[:3])
            simulation.step()
        moved.append(float(np.linalg.norm(frames.compose(simulation.state.body_q[body], point)[:3] - before)))
    tied, free = moved
    most = 4.0 * (1.0 / 2000.0 + 0.15 / 900.0)
    assert 0.5 * most < tied < most
    assert free > 20.0 * tied
