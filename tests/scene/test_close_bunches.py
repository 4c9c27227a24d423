"""Wine grapes hang close together, with no hull inside another hull or inside old wood, and shoots lean and bend."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from vinesim.contact.plant_capsules import spheroid_spheres
from vinesim.core import frames
from vinesim.core.toml_loader import DataError
from vinesim.scene import plant_parameters
from vinesim.scene.builder import GRAVITY
from vinesim.scene.generation.fruit import MAX_BUCKLING_LOAD
from vinesim.scene.generation.vineyard import generate_uncached
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.spec import Clutter, Fruit, Scene, load_scene
from vinesim.world import Physics

VINES = 3


def _scene(variety: str = "riesling", plants: str = "wine_vine", vines: int = VINES, old_wood: float = 1.0) -> Scene:
    scene = load_scene("cordon")
    return msgspec.structs.replace(
        scene,
        plants=plants,
        layout=msgspec.structs.replace(scene.layout, rows=1, vines=vines, vine_spacing=1.5),
        fruit=Fruit(bunches=(60, 60), varieties=(variety,)),
        clutter=Clutter(old_wood=old_wood),
    )


@pytest.fixture(scope="module", params=["italia", "riesling", "syrah"])
def full(request) -> Model:
    return generate_uncached(_scene(request.param))


def _spheres(model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres [n, 3] m, radii [n] m and bunches [n] of the spheres of all bunches that collide."""
    q = model.forward_kinematics(model.joint_settled)[model.bunch_body]
    parts = [
        (i, centre, radius)
        for i in range(len(q))
        for centre, radius in spheroid_spheres(0.5 * float(model.bunch_length[i]), float(model.bunch_radius[i]))
    ]
    bunch, along, radius = (np.array(one) for one in zip(*parts, strict=True))
    axis = frames.rotate(q[:, 3:], np.array([1.0, 0.0, 0.0]))
    return q[bunch, :3] + along[:, None] * axis[bunch], radius, bunch


def _gap(point: np.ndarray, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances [point, piece] m of points from the axes of pieces, and the shares of the pieces' length there."""
    way = end - start
    share = np.clip(((point[:, None] - start) * way).sum(-1) / np.maximum((way * way).sum(-1), 1e-12), 0.0, 1.0)
    return np.linalg.norm(point[:, None] - start - share[..., None] * way, axis=-1), share


def test_no_bunch_is_inside_another(full) -> None:
    """Spheres that collide, and points on the spheroids that hold them."""
    centre, radius, bunch = _spheres(full)
    apart = np.linalg.norm(centre[:, None] - centre, axis=-1) - radius[:, None] - radius
    assert apart[bunch[:, None] != bunch].min() > 0.0

    q = full.forward_kinematics(full.joint_settled)[full.bunch_body]
    axis = frames.rotate(q[:, 3:], np.array([1.0, 0.0, 0.0]))
    long, wide = full.bunch_length.astype(float), full.bunch_radius.astype(float)
    turn, share = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 16), np.linspace(0.02, 0.98, 25))
    out = wide[:, None] * np.sqrt(1.0 - (2.0 * share.ravel() - 1.0) ** 2)
    level = np.stack([np.cos(turn.ravel()), np.sin(turn.ravel()), 0.0 * turn.ravel()], -1)
    surface = q[:, None, :3] + (long[:, None] * share.ravel())[..., None] * axis[:, None] + out[..., None] * level
    for i in range(len(q)):
        way = np.delete(surface, i, 0) - q[i, :3]
        along = way @ axis[i]
        across = np.linalg.norm(way - along[..., None] * axis[i], axis=-1)
        assert ((2.0 * along / long[i] - 1.0) ** 2 + (across / wide[i]) ** 2).min() > 1.0


def test_no_bunch_is_inside_old_wood(full) -> None:
    """Spheres that collide keep clear of poles, trunks, arms and spur heads."""
    centre, radius, _bunch = _spheres(full)
    wood = full.fixed_organ != int(Organ.WIRE)
    away, share = _gap(centre, full.fixed_start[wood].astype(float), full.fixed_end[wood].astype(float))
    ends = full.fixed_radius[wood].astype(float)
    thick = ends[:, 0] + share * (ends[:, 1] - ends[:, 0])
    assert (away - thick - radius[:, None]).min() > 0.0


def test_shoots_wires_and_stalks_press_into_bunches_as_far_as_the_file_says(full) -> None:
    """The core of a hull, the share that does not give way, keeps clear of all thin wood of its vine."""
    bunch_parameters = plant_parameters.load_plant("wine_vine").bunch
    assert bunch_parameters.press is not None
    press = bunch_parameters.press.value
    q = full.forward_kinematics(full.joint_settled)
    centre, radius, bunch = _spheres(full)
    middle = q[full.bunch_body, :3] + 0.5 * full.bunch_length[:, None] * frames.rotate(
        q[full.bunch_body, 3:], np.array([1.0, 0.0, 0.0])
    )
    core = middle[bunch] + (1.0 - press) * (centre - middle[bunch])
    thin = np.flatnonzero(full.body_organ != int(Organ.BUNCH))
    end = q[thin, :3] + full.body_length[thin, None] * frames.rotate(q[thin, 3:], np.array([1.0, 0.0, 0.0]))
    away, _share = _gap(core, q[thin, :3], end)
    clear = away - full.body_radius[thin].min(-1) - (1.0 - press) * radius[:, None]
    vine = full.tree_vine[full.body_tree]
    own = vine[thin] == vine[full.bunch_body[bunch]][:, None]
    assert clear[own].min() > 0.0
    wire = full.fixed_organ == int(Organ.WIRE)
    away, _share = _gap(core, full.fixed_start[wire].astype(float), full.fixed_end[wire].astype(float))
    assert (away - full.fixed_radius[wire].max() - (1.0 - press) * radius[:, None]).min() > 0.0


def test_all_is_at_rest_as_generated(full) -> None:
    """Nothing presses on anything, and no stalk or shoot turns, while all trees are awake."""
    physics = Physics(full.copy())
    physics.plants.wake(np.arange(len(full.tree_first)))
    for _ in range(100):
        physics.step()
        assert not physics.contacts
        assert physics.plants.tree_rate.max() < physics.parameters.sleep_rate


def test_close_bunches_are_more_and_nearer_than_bunches_apart() -> None:
    """Nearest neighbours are less than the 20 mm apart that a plant file without ``bunch.gap`` keeps."""
    gaps, counts = [], []
    for plants in ("wine_vine", "vine"):
        model = generate_uncached(_scene("syrah", plants))
        centre, radius, bunch = _spheres(model)
        apart = np.linalg.norm(centre[:, None] - centre, axis=-1) - radius[:, None] - radius
        apart[bunch[:, None] == bunch] = np.inf
        gaps.append(np.median([apart[bunch == i].min() for i in range(len(model.bunch_body))]))
        counts.append(len(model.bunch_body))
    assert gaps[0] < 0.02 < gaps[1]
    assert counts[0] > 1.3 * counts[1]


def test_no_shoot_carries_more_than_the_buckling_rule_allows(full) -> None:
    """The sum of m g a^2 / EI over the bunches of a shoot, from the model's bodies."""
    modulus = plant_parameters.load_plant("wine_vine").cane.woody_modulus.value
    q = full.forward_kinematics(full.joint_settled)
    load = np.zeros(len(full.tree_first))
    for body in full.bunch_body:
        tree = full.body_tree[body]
        stalk = full.body_parent[full.body_parent[body]]
        rise = max(float(q[stalk, 2] - full.tree_pose[tree, 2]), 0.0)
        base = float(full.body_radius[full.tree_first[tree], 0])
        load[tree] += full.body_mass[body] * -GRAVITY[2] * rise**2 / (modulus * np.pi / 4.0 * base**4)
    assert 0.0 < load.max() < MAX_BUCKLING_LOAD + 1e-3


def test_a_longer_row_changes_no_vine() -> None:
    short, long = (generate_uncached(_scene(vines=vines)) for vines in (1, 2))
    q = [model.forward_kinematics(model.joint_settled)[model.bunch_body] for model in (short, long)]
    mine = long.tree_vine[long.body_tree[long.bunch_body]] == 0
    assert mine.sum() == len(short.bunch_body)
    np.testing.assert_array_equal(q[0], q[1][mine])


def test_shoots_of_wine_vines_lean_and_bend_more() -> None:
    lean, bend = [], []
    for plants in ("wine_vine", "vine"):
        model = generate_uncached(_scene(plants=plants))
        q = model.forward_kinematics(model.joint_settled)
        axis = frames.rotate(q[:, 3:], np.array([1.0, 0.0, 0.0]))
        root = model.tree_first
        lean.append(np.degrees(np.arccos(axis[root, 2])).std())
        bend.append(np.degrees(np.arccos(np.clip((axis[root + 1] * axis[root]).sum(-1), -1.0, 1.0))).mean())
    assert lean[0] > 1.5 * lean[1]
    assert bend[0] > 1.5 * bend[1]


# ---- plant files that are like another -------------------------------------------------------------------------------


def test_a_plant_file_has_the_numbers_of_the_file_that_it_is_like(tmp_path) -> None:
    file = tmp_path / "short.toml"
    file.write_text(
        'like = "vine"\n[cane]\nlength = { value = [0.5, 0.6], unit = "m", grade = "GUESSED", source = "cut off" }\n'
    )
    vine, short = plant_parameters.load_plant("vine"), plant_parameters.load_plant(str(file))
    assert short.cane.length.value == (0.5, 0.6)
    assert msgspec.structs.replace(short, cane=vine.cane) == vine
    assert msgspec.structs.replace(short.cane, length=vine.cane.length) == vine.cane


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("like = 3", r"like is 3; give the name of another plant file in quotes"),
        ('like = "wine_vine"', r"like is 'wine_vine', which is like a third file; name 'vine' or a whole file"),
        ('like = "vine"\n[cane]\nlenght = 3', r"cane\.lenght is not a field; did you mean 'length'"),
        ('like = "vine"\ncane = 3', r"cane is 3; give a table"),
    ],
)
def test_a_plant_file_that_is_like_nothing_usable_is_refused(tmp_path, text, message) -> None:
    file = tmp_path / "odd.toml"
    file.write_text(text)
    with pytest.raises(DataError, match=message):
        plant_parameters.load_plant(str(file))
