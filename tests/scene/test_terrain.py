"""Uneven ground: the law of its heights, what a scene file says about it, and how trellis and plants stand on it."""

from __future__ import annotations

import dataclasses
import pathlib

import msgspec
import numpy as np
import pytest
from PIL import Image

from tests.support.terrain_scenes import hills, incline
from vinesim.core import frames
from vinesim.core.data_files import find_data_file
from vinesim.scene.generation.uneven_ground import TrellisRise, build_terrain
from vinesim.scene.generation.vineyard import generate, generate_uncached
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.spec import Roughness, Ruts, Scene, SceneError, TerrainTable, load_scene
from vinesim.scene.terrain import Terrain, tilt

SLOPE = find_data_file("scenes", "slope", ".toml").read_text()


def with_terrain(table: TerrainTable | None, name: str = "vsp", **layout: int) -> Scene:
    scene = load_scene(name)
    small = msgspec.structs.replace(scene.layout, **({"rows": 2, "vines": 2} | layout))
    return msgspec.structs.replace(scene, terrain=table, layout=small)


# the law


def test_between_the_nodes_the_ground_is_two_triangles_for_each_cell() -> None:
    terrain = hills()
    rng = np.random.default_rng(0)
    heights = terrain.nodes()
    i, j = rng.integers(0, 120, 200), rng.integers(0, 100, 200)
    a, b = np.sort(rng.uniform(size=(2, 200)), axis=0)[::-1]
    x = terrain.origin[0] + terrain.cell * (i + a)
    y = terrain.origin[1] + terrain.cell * (j + b)
    corner = heights[j, i], heights[j, i + 1], heights[j + 1, i + 1]
    barycentric = (1.0 - a) * corner[0] + (a - b) * corner[1] + b * corner[2]
    assert np.abs(terrain.height(x, y) - barycentric).max() < 1e-7
    step = 1e-7
    slopes = [(terrain.height(x + dx, y + dy) - terrain.height(x, y)) / step for dx, dy in ((step, 0.0), (0.0, step))]
    assert np.abs(terrain.gradient(x, y) - np.stack(slopes, -1)).max() < 1e-5
    normal = terrain.normal(x, y)
    assert np.abs(np.linalg.norm(normal, axis=1) - 1.0).max() < 1e-12
    assert np.abs(normal[:, :2] / normal[:, 2:] + terrain.gradient(x, y)).max() < 1e-9


def test_beyond_the_grid_the_heights_of_the_edge_continue_along_the_inclined_plane() -> None:
    terrain = hills()
    y = np.linspace(-3.9, 5.9, 40)
    edge = terrain.height(terrain.end[0], y)
    assert np.abs(terrain.height(terrain.end[0] + 7.0, y) - edge - 7.0 * terrain.slope[0]).max() < 1e-9
    assert np.abs(terrain.gradient(terrain.end[0] + 7.0, y)[:, 0] - terrain.slope[0]).max() == 0.0


def test_a_plane_is_fitted_exactly_and_a_body_on_it_points_ahead() -> None:
    terrain = incline(0.2, -0.1)
    for yaw in (0.0, 1.1, -2.0):
        height, along, across = terrain.fit_plane(1.0, 0.5, yaw, (0.4, 0.3))
        ahead, left = (0.2 * np.cos(yaw) - 0.1 * np.sin(yaw), -0.2 * np.sin(yaw) - 0.1 * np.cos(yaw))
        assert (height, along, across) == pytest.approx((0.15, ahead, left), abs=1e-12)
        turn = tilt(yaw, along, across)
        assert frames.rotate(turn, np.array([0.0, 0.0, 1.0])) == pytest.approx(terrain.normal(1.0, 0.5), abs=1e-12)
        assert frames.to_yaw(turn) == pytest.approx(yaw, abs=1e-12)


def test_what_lies_on_the_ground_penetrates_no_sample() -> None:
    terrain = hills()
    pose = terrain.resting_pose(0.4, 0.2, 0.7, (0.3, 0.2))
    grid = np.stack(np.meshgrid(np.linspace(-0.3, 0.3, 15), np.linspace(-0.2, 0.2, 15), [0.0]), -1).reshape(-1, 3)
    points = pose[:3] + frames.rotate(pose[3:], grid)
    gap = points[:, 2] - terrain.height(points[:, 0], points[:, 1])
    assert gap.min() > -5e-3  # samples are taken on the level, the body lies inclined
    assert gap.min() < 5e-3


# scene files


def test_ruts_lie_in_every_alley_and_end_in_the_headland() -> None:
    scene = with_terrain(TerrainTable(ruts=Ruts(depth=0.08, width=0.4, gauge=1.2), cell=0.05))
    terrain = build_terrain(scene)
    assert terrain is not None
    spacing = scene.layout.row_spacing
    for alley in (-0.5, 0.5, 1.5):
        for side in (-0.6, 0.6):
            assert terrain.height(1.0, alley * spacing + side) == pytest.approx(-0.08, abs=2e-3)
        assert terrain.height(1.0, alley * spacing) == 0.0
    assert terrain.height(1.0, spacing) == 0.0
    assert terrain.height(terrain.end[0], 0.5 * spacing + 0.6) == 0.0


def test_roughness_has_the_deviation_and_the_wavelength_of_the_scene() -> None:
    table = TerrainTable(roughness=Roughness(deviation=0.03, wavelength=1.0), margin=30.0)
    terrain = build_terrain(with_terrain(table))
    assert terrain is not None
    assert terrain.residual.std() == pytest.approx(0.03, rel=0.05)
    spectrum = np.abs(np.fft.rfft(terrain.residual - terrain.residual.mean(), axis=1)).mean(0) ** 2
    per_metre = np.fft.rfftfreq(terrain.residual.shape[1], terrain.cell)
    assert spectrum[per_metre > 1.0 / 0.8].sum() < 0.02 * spectrum.sum()
    again, other = build_terrain(with_terrain(table)), msgspec.structs.replace(with_terrain(table), seed=9)
    assert again is not None
    assert (again.residual == terrain.residual).all()
    assert (build_terrain(other).residual != terrain.residual).any()  # type: ignore[union-attr]


@pytest.mark.parametrize(("bits", "kind"), [(8, np.uint8), (16, np.uint16)])
def test_heights_come_from_an_image(tmp_path: pathlib.Path, bits: int, kind: type) -> None:
    white = 2**bits - 1
    pixels = np.random.default_rng(bits).integers(0, white + 1, (60, 80)).astype(kind)
    Image.fromarray(pixels).save(tmp_path / "heights.png")
    text = SLOPE[: SLOPE.index("[terrain]")] + SLOPE[SLOPE.index("[season]") :]
    table = '[terrain]\nimage = "heights.png"\nrange = [-0.2, 0.6]\ncorner = [-1.0, 0.5]\ncell = 0.25\nslope = 0.1\n'
    (tmp_path / "field.toml").write_text(text + table)
    terrain = build_terrain(load_scene(tmp_path / "field.toml"))
    assert terrain is not None
    row, column = 20, 30  # from the lower left corner
    x, y = -1.0 + 0.25 * column, 0.5 + 0.25 * row
    assert terrain.height(x, y) == pytest.approx(0.1 * x - 0.2 + 0.8 * pixels[59 - row, column] / white, abs=1e-6)
    assert np.abs(terrain.residual).max() <= 0.6 + 1e-6


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("slope = 10", "terrain.slope is 10; give a number <= 0.6"),
        ("image = 'none.png'", "terrain.image is 'none.png', which cannot be read; give a grey PNG of 8 or 16 bits"),
        ("cell = 1.0", "terrain.cell is 1.0 m; give 0.117 m or less, a third of a rut's width"),
        ("range = [0.0, 2.0]", "terrain.range is given without terrain.image; add image = ..., or remove range"),
        ("margin = 50.0\ncell = 0.02", "million heights; give 0.11 m or more"),
        ("ruts = { depth = 0.3, width = 0.4 }", "terrain.ruts.width is 0.4 m; give 0.92 m or more"),
        (
            "ruts = { gauge = 2.4 }",
            "terrain.ruts.gauge is 2.4 m; give 0.35 m (their width) or more, and at most 2.25 m",
        ),
        ("roughness = { wavelength = 0.3 }", "a quarter of the roughness' wavelength"),
        ("bumps = 3", "terrain.bumps is not a field"),
    ],
)
def test_a_wrong_terrain_is_refused_in_one_line(tmp_path: pathlib.Path, line: str, message: str) -> None:
    ruts = "" if "ruts" in line else "ruts = {}"
    head = SLOPE[: SLOPE.index("[terrain]")] + SLOPE[SLOPE.index("[season]") :]
    (tmp_path / "bad.toml").write_text(f"{head}\n[terrain]\n{ruts}\n{line}\n")
    with pytest.raises(SceneError) as error:
        load_scene(tmp_path / "bad.toml")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_an_image_in_colours_is_refused(tmp_path: pathlib.Path) -> None:
    Image.new("RGB", (8, 8)).save(tmp_path / "colours.png")
    head = SLOPE[: SLOPE.index("[terrain]")] + SLOPE[SLOPE.index("[season]") :]
    (tmp_path / "bad.toml").write_text(head + '[terrain]\nimage = "colours.png"\n')
    with pytest.raises(SceneError, match="mode RGB and size"):
        load_scene(tmp_path / "bad.toml")


# trellis and plants


@pytest.mark.parametrize("name", ["vsp", "tendone"])
def test_level_ground_as_terrain_changes_no_bit_of_the_plants(name: str) -> None:
    level, table = (generate_uncached(with_terrain(table, name)) for table in (None, TerrainTable()))
    assert table.terrain is not None
    assert np.ptp(table.terrain.residual) == 0.0
    for field in Model.array_fields():
        assert (getattr(level, field) == getattr(table, field)).all(), field
    assert level.digest() != table.digest()


@pytest.fixture(scope="module", params=["vsp", "tendone"])
def pair(request: pytest.FixtureRequest) -> tuple[Model, Model, TrellisRise]:
    """The same vineyard on level ground and on a rough slope with ruts, and by how much its trellis rises."""
    table = TerrainTable(slope=0.15, direction=0.6, ruts=Ruts(), roughness=Roughness(deviation=0.02))
    scene = with_terrain(table, request.param)
    terrain = build_terrain(scene)
    assert terrain is not None
    return (
        generate_uncached(msgspec.structs.replace(scene, terrain=None)),
        generate_uncached(scene),
        TrellisRise(terrain, scene.layout),
    )


def test_poles_trunks_and_boxes_stand_on_the_ground(pair: tuple[Model, Model, TrellisRise]) -> None:
    level, raised, _ = pair
    terrain = raised.terrain
    assert terrain is not None
    pole = raised.fixed_organ == int(Organ.POLE)
    foot = raised.fixed_start[pole].astype(float)
    assert foot[:, 2] + 0.3 == pytest.approx(terrain.height(foot[:, 0], foot[:, 1]), abs=1e-6)
    trunk = np.flatnonzero(raised.fixed_organ == int(Organ.TRUNK))
    first = trunk[np.unique(raised.fixed_index[trunk], return_index=True)[1]]
    foot = raised.fixed_start[first].astype(float)
    assert foot[:, 2] == pytest.approx(terrain.height(foot[:, 0], foot[:, 1]), abs=1e-6)
    follows = np.diff(raised.fixed_index[trunk]) == 0
    assert (raised.fixed_start[trunk[1:]][follows] == raised.fixed_end[trunk[:-1]][follows]).all()
    for pose, size in zip(raised.box_pose.astype(float), raised.box_size, strict=True):
        plane = terrain.fit_plane(pose[0], pose[1], frames.to_yaw(pose[3:]), (0.5 * size[0], 0.5 * size[1]))
        assert 0.0 <= pose[2] - plane[0] < 0.05
    assert (raised.fixed_start[:, :2] == level.fixed_start[:, :2]).all()


def test_wires_are_straight_from_pole_to_pole(pair: tuple[Model, Model, TrellisRise]) -> None:
    level, raised, rise = pair
    wire = raised.fixed_organ == int(Organ.WIRE)
    for end in ("fixed_start", "fixed_end"):
        flat = getattr(level, end)[wire].astype(float)
        assert getattr(raised, end)[wire, 2] == pytest.approx(flat[:, 2] + rise.at(flat), abs=1e-5)
    halves = 0.5 * (level.fixed_start + level.fixed_end)[wire].astype(float)
    middle = 0.5 * (raised.fixed_start + raised.fixed_end)[wire]
    assert middle[:, 2] == pytest.approx(halves[:, 2] + rise.at(halves), abs=1e-5)


def test_ties_are_slack_and_bunches_hang_plumb(pair: tuple[Model, Model, TrellisRise]) -> None:
    level, raised, _ = pair
    drawn = raised.forward_kinematics(raised.joint_settled)
    tied = frames.compose(drawn[raised.tie_body], frames.pose(raised.tie_point))[:, :3]
    assert np.abs(tied - raised.tie_anchor).max() < 2e-5
    for model in (level, raised):
        assert (model.tie_wire == level.tie_wire).all()
    axes = [
        frames.rotate(model.forward_kinematics(model.joint_settled)[model.bunch_body, 3:], np.array([1.0, 0.0, 0.0]))
        for model in (level, raised)
    ]
    assert np.abs(axes[1] - axes[0]).max() < 1e-4


def test_the_example_scene_is_cached_with_its_ground() -> None:
    first, second = (generate(load_scene("slope")) for _ in range(2))
    assert first.digest() == second.digest()
    assert isinstance(first.terrain, Terrain)
    assert first.copy().digest() == first.digest()
    assert dataclasses.replace(first, terrain=None).digest() != first.digest()
