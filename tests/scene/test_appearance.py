"""Visual shapes of humans and crates: size against collision shapes, closed meshes, symmetry, labels, files."""

from __future__ import annotations

import dataclasses
import itertools

import cv2
import numpy as np
import pytest

from tests.support import sensor_scenes
from vinesim.core import frames
from vinesim.core.data_files import find_data_file
from vinesim.kernels.shading import materials
from vinesim.rigid.human_posture import BODY_PARTS, body_shapes, hand_shapes, standing_pose
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.rigid.static_world import CRATE_WALL
from vinesim.robot.description.loader import load_description
from vinesim.scene import appearance
from vinesim.scene.appearance import AppearanceError
from vinesim.scene.ids import Organ, label
from vinesim.scene.values import HumanSpec, Mesh, RigidVisual, Shape
from vinesim.sensors.camera.camera import Camera
from vinesim.sensors.export.images import look_at
from vinesim.sensors.primitives import rigid_primitives

TOLERANCE = 0.06
"""[m] Collision shapes may extend so far beyond visual ones: hips are wider than a waist in trousers."""
SIZES = [(0.6, 0.4, 0.15), (0.6, 0.4, 0.24), (0.6, 0.4, 0.3), (0.4, 0.3, 0.24)]


def posed_human(name: str, height: float = 1.75) -> RigidWorld:
    rigid = RigidWorld(sensor_scenes.empty())
    pose = appearance.apply_posture(standing_pose(frames.pose(np.zeros(3)), height), name, height)
    rigid.add_human(HumanSpec("eva", 4, pose, height))
    rigid.predict()
    rigid.integrate()
    return rigid


def silhouette(shapes: tuple[RigidVisual, ...], poses: np.ndarray, camera_position: np.ndarray) -> np.ndarray:
    """Pixels [height, width] that show a human at the origin."""
    primitives, _ = sensor_scenes.world(*shapes, at=poses)
    _, drawn = sensor_scenes.raster(primitives, look_at(camera_position, np.array([0.0, 0.0, 0.95])))
    names = np.where(drawn >= 0, primitives.label[np.maximum(drawn, 0)], 0)
    return names == label(Organ.HUMAN, 4)


@pytest.mark.parametrize("side", [0.0, 0.8, 1.6, 3.14, 4.4])
@pytest.mark.parametrize("height", [1.6, 1.9])
def test_visuals_of_a_human_match_the_collision_shapes(side: float, height: float) -> None:
    """From any side the visuals, dilated by a few centimetres, cover the collision shapes, and nearly the reverse."""
    rigid = posed_human("stand", height)
    camera_position = 4.0 * np.array([np.cos(side), np.sin(side), 0.0]) + [0.0, 0.0, 1.3]
    drawn = silhouette(rigid.visuals(), rigid.visual_q(), camera_position)
    touching = dict(zip(BODY_PARTS, ((shape,) for shape in body_shapes(height)), strict=True))
    touching |= {f"{hand}_hand": hand_shapes(hand) for hand in ("left", "right")}
    rows = [i for i, link in enumerate(rigid.visuals()) if link.name.partition("/")[2] in touching]
    named = [rigid.visuals()[i].name for i in rows]
    bodies = tuple(RigidVisual(name, Organ.HUMAN, 4, touching[name.partition("/")[2]]) for name in named)
    collision = silhouette(bodies, rigid.visual_q()[rows], camera_position)
    pixels = round(TOLERANCE * sensor_scenes.SMALL.fx / 4.0)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    assert collision.sum() > 500
    assert not (collision & (cv2.dilate(drawn.astype(np.uint8), disc) == 0)).any()
    # arms, neck and a hat's brim have no collision shape
    assert (drawn & (cv2.dilate(collision.astype(np.uint8), disc) == 0)).sum() < 0.25 * drawn.sum()


def test_all_primitives_of_a_human_have_its_label() -> None:
    rigid = posed_human("pick")
    primitives, _ = sensor_scenes.world(*rigid.visuals(), at=rigid.visual_q())
    labelled = primitives.label == label(Organ.HUMAN, 4)
    shapes = [shape for link in rigid.visuals() for shape in link.shapes]
    assert labelled.sum() == sum(len(shape.mesh.corners) if shape.mesh else 1 for shape in shapes)
    assert labelled.sum() == len(primitives.label) - 1  # the placeholder for plants
    assert labelled.sum() < 5000


def test_left_parts_mirror_right_parts() -> None:
    parts = appearance.load_human_model(1.75).parts
    for name in (name for name in parts if name.startswith("left_")):
        for left, right in zip(parts[name], parts[name.replace("left_", "right_")], strict=True):
            assert (left.kind, left.size, left.rgba, left.surface) == (
                right.kind,
                right.size,
                right.rgba,
                right.surface,
            )
            if left.mesh and right.mesh:
                flipped = np.sort((left.mesh.corners * [1, -1, 1]).reshape(-1, 3), 0)
                assert np.allclose(flipped, np.sort(right.mesh.corners.reshape(-1, 3), 0))
            elif not name[-1].isdigit():  # a finger's axis is not mirrored: compare its root
                assert left.pose[:3] * [1, -1, 1] == pytest.approx(right.pose[:3])


def volume(corners: np.ndarray) -> float:
    """Volume within triangles that are counter-clockwise from outside (divergence theorem)."""
    return float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0)


def meshes() -> list[Mesh]:
    return [s.mesh for shapes in appearance.load_human_model(1.75).parts.values() for s in shapes if s.mesh]


def test_meshes_face_outward() -> None:
    """Normals at corners agree with their faces, within half of a right angle at creases."""
    for mesh in meshes():
        face = np.cross(mesh.corners[:, 1] - mesh.corners[:, 0], mesh.corners[:, 2] - mesh.corners[:, 0])
        size = np.linalg.norm(face, axis=1)
        valid = size > 1e-9
        cosine = np.einsum("fi,fki->fk", face[valid] / size[valid, None], mesh.normals[valid])
        assert cosine.min() > 0.6
        assert np.linalg.norm(mesh.normals, axis=2) == pytest.approx(1.0)


def test_a_head_has_the_volume_of_a_head() -> None:
    """Volume of a head of 197 mm x 154 mm x 231 mm, between its ellipsoid and its box."""
    corners = np.concatenate(
        [s.mesh.corners for s in appearance.load_human_model(1.75).parts["head"][:8] if s.mesh and s.surface == "skin"]
    )
    ellipsoid = np.pi / 6.0 * 0.197 * 0.154 * 0.231
    assert 0.9 * ellipsoid < volume(corners) < 0.197 * 0.154 * 0.231


def test_packed_normals_are_unpacked() -> None:
    normals = frames.normalize(np.random.default_rng(3).normal(size=(4000, 3)))
    code = rigid_primitives.pack_normals(normals)
    assert (code == np.round(code)).all()
    assert code.min() >= 1.0
    assert code.max() < 2**24
    k = code.astype(np.int64) - 1
    xy = np.stack([k % 2047, k // 2047], -1) * (2.0 / 2046.0) - 1.0
    z = 1.0 - np.abs(xy).sum(-1)
    fold = np.maximum(-z, 0.0)
    unpacked = frames.normalize(np.concatenate([xy - np.where(xy >= 0.0, 1.0, -1.0) * fold[:, None], z[:, None]], -1))
    assert np.arccos(np.clip((unpacked * normals).sum(-1), -1.0, 1.0)).max() < 2e-3


@pytest.mark.parametrize("size", SIZES)
def test_a_crate_has_its_size_and_is_empty_inside(size: tuple[float, float, float]) -> None:
    boxes = appearance.crate_shapes(size, 0)
    low = np.array([b.pose[:3] - b.size for b in boxes])
    high = np.array([b.pose[:3] + b.size for b in boxes])
    half = np.array(size) / 2.0
    assert low.min(0) == pytest.approx([-half[0], -half[1], 0.0])
    assert high.max(0) == pytest.approx([half[0], half[1], size[2]])
    inside = np.array([half[0] - CRATE_WALL, half[1] - CRATE_WALL, size[2]])
    reaches = (low < inside - 1e-6) & (high > np.array([-inside[0], -inside[1], CRATE_WALL]) + 1e-6)
    assert not reaches.all(1).any()
    rim = (high[:, 2] > size[2] - 1e-6) & ((high - low)[:, :2].max(1) > 0.9 * min(size[:2]) - 0.03)
    assert rim.sum() == 4
    assert len(boxes) < 150


def test_neighbouring_crates_differ_in_colour() -> None:
    assert appearance.crate_shapes(SIZES[0], 0)[0].rgba != appearance.crate_shapes(SIZES[0], 1)[0].rgba


def test_every_surface_has_its_material() -> None:
    assert set(appearance.SURFACES) == set(rigid_primitives._MATERIALS)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ('neck = [{ kind = "cone", paint = "gold" }]', r"parts\.neck\[0\]\.paint is 'gold'; give one of: skin"),
        ('neck = [{ kind = "blob", paint = "skin" }]', r"parts\[\.\.\.\]\[0\]\.kind: Invalid enum value 'blob'"),
        ('neck = [{ kind = "loft", paint = "skin", rings = [[0, 0, 0, 0]] }]', "give two rings or more"),
        (
            'neck = [{ kind = "loft", paint = ["skin", "skin"], rings = [[0, 0, 0, 0], [1, 0, 0, 0]] }]',
            "names 2 paints; give one, or 1",
        ),
    ],
)
def test_an_invalid_human_model_is_refused_in_one_line(tmp_path, line: str, reason: str) -> None:
    text = find_data_file("figures", "worker", ".toml").read_text()
    file = tmp_path / "odd.toml"
    file.write_text(text[: text.index("[parts]")] + f"[parts]\n{line}\n")
    with pytest.raises(AppearanceError, match=reason) as caught:
        appearance.load_human_model(1.75, str(file))
    assert "\n" not in str(caught.value)


def worn(outfit: str) -> dict[str, np.ndarray]:
    """Colours [3] of what people wear, and of their skin."""
    parts = appearance.load_human_model(1.75, outfit=outfit).parts
    pieces = {
        "trousers": parts["left_thigh"][0],
        "shirt": parts["left_upper_arm"][0],
        "skin": parts["neck"][0],
        "hat": next(shape for shape in parts["head"] if shape.surface == "straw"),
        "vest": next(shape for shape in parts["chest"] if shape.kind == "box"),
    }
    return {name: np.array(shape.rgba[:3]) for name, shape in pieces.items()}


def test_outfits_differ_visibly() -> None:
    """Any two differ by a fifth of a channel or more in three of vest, shirt, trousers, hat and skin."""
    outfits = appearance.outfit_names()
    assert len(outfits) >= 6
    for one, other in itertools.combinations(outfits, 2):
        a = worn(one)
        b = worn(other)
        differ = [name for name in a if np.abs(a[name] - b[name]).max() >= 0.2]
        assert len(differ) >= 3, f"{one} and {other} differ in {differ} only"
    colours = [rgba for outfit in outfits for rgba in worn(outfit).values()]
    assert np.min(colours) >= 0.0
    assert np.max(colours) <= 1.0


def test_outfits_change_colours_and_nothing_else() -> None:
    usual, other = (appearance.load_human_model(1.75, outfit=outfit).parts for outfit in ("", "blue"))
    for part, shapes in usual.items():
        for one, two in zip(shapes, other[part], strict=True):
            assert one.mesh is two.mesh, "people in all outfits share their meshes"
            assert (one.kind, one.size, one.surface) == (two.kind, two.size, two.surface)
            np.testing.assert_array_equal(one.pose, two.pose)
    vests = {shape.rgba[:3] for shape in other["chest"]}
    assert (0.10, 0.22, 0.52) in vests
    assert (1.00, 0.42, 0.08) not in vests


def test_the_outfit_of_an_actor_follows_from_its_name() -> None:
    assert [appearance.outfit_of(name) for name in ("anna", "ida", "viewer")] == ["brown", "orange", "white"]
    assert {appearance.outfit_of(f"human-{k}") for k in range(100)} == set(appearance.outfit_names())


def test_an_unknown_outfit_is_refused_with_the_known_ones(tmp_path) -> None:
    with pytest.raises(AppearanceError, match="outfit 'pink' is unknown; give one of: orange, yellow, green"):
        appearance.load_human_model(1.75, outfit="pink")
    text = find_data_file("figures", "worker", ".toml").read_text()
    file = tmp_path / "odd.toml"
    file.write_text(text.replace("[outfits.yellow]", "[outfits.yellow]\ncape = [1.0, 0.0, 0.0]"))
    with pytest.raises(AppearanceError, match=r"outfits\.yellow\.cape is no paint; give some of: skin, lips"):
        appearance.load_human_model(1.75, str(file))


def test_the_mouth_of_shears_is_between_their_blades() -> None:
    """When they are open, blade and hook are on either side of the mouth's middle, and reach beyond it."""
    shears = appearance.load_shears()
    tips = []
    for part, pose in zip(appearance.SHEARS_PARTS, shears.open, strict=True):
        steel = [shape for shape in shears.parts[part] if shape.surface == "metal"]
        at = frames.compose(pose, np.stack([shape.pose for shape in steel]))
        tips.append(at[np.argmax(at[:, 0]), :3])
    mouth = shears.mouth[:3]
    half = shears.mouth_half
    assert tips[0][1] > mouth[1] > tips[1][1]
    assert min(tip[0] for tip in tips) > mouth[0]
    assert all(abs(tip[2] - mouth[2]) < half[2] for tip in tips)
    assert mouth[0] - half[0] > shears.open[0, 0], "beyond the bolt"


def test_an_unknown_posture_is_refused_with_the_known_ones() -> None:
    with pytest.raises(AppearanceError, match="posture 'dance' is unknown; give one of: stand, pick"):
        appearance.apply_posture(standing_pose(frames.pose(np.zeros(3))), "dance", 1.75)


def test_a_cone_tapers_from_bottom_to_top() -> None:
    """Thin at the top, thick at the bottom: silhouette widths of a round cone on its axis."""
    cone = Shape("cone", (0.2, 0.05, 0.4), frames.pose(np.array([2.0, 0.0, 1.0])))
    primitives, _ = sensor_scenes.world(sensor_scenes.thing(cone))
    depth, _ = sensor_scenes.raster(primitives, sensor_scenes.AHEAD)
    rows = (np.isfinite(depth) & (depth < 2.0)).sum(1)
    scale = sensor_scenes.SMALL.fx / 2.0
    low, high = (round(sensor_scenes.SMALL.cy + z * scale) for z in (0.4, -0.4))
    assert rows[low] == pytest.approx(2 * 0.2 * scale, rel=0.1)
    assert rows[high] == pytest.approx(2 * 0.05 * scale, abs=3)


def test_a_depth_camera_distinguishes_a_fist_from_an_open_hand() -> None:
    """F48: an open hand before a camera shows gaps between fingers and extends further than a fist."""
    views = {}
    for name, bent in (("open", 0.0), ("fist", 1.0)):
        pose = standing_pose(frames.pose(np.zeros(3)))
        up = frames.from_x_axis(np.array([0.0, 0.0, 1.0]), np.array([-1.0, 0.0, 0.0]))
        hand = {"right": frames.pose(np.array([0.5, -0.4, 1.4]), up), "right_fingers": (bent,) * 5}
        rigid = RigidWorld(sensor_scenes.empty())
        rigid.add_human(HumanSpec("eva", 4, dataclasses.replace(pose, **hand)))
        primitives, _ = sensor_scenes.world(*rigid.visuals(), at=rigid.visual_q())
        depth, _ = sensor_scenes.raster(primitives, look_at(np.array([1.1, -0.4, 1.4]), np.array([0.5, -0.4, 1.42])))
        views[name] = depth < 0.75
    rows = {name: np.flatnonzero(view.any(1)) for name, view in views.items()}
    scale = sensor_scenes.SMALL.fx / 0.6
    assert rows["fist"].min() - rows["open"].min() > 0.04 * scale
    across = [np.abs(np.diff(row.astype(int))).sum() for row in views["open"]]
    assert max(across) >= 8  # at least four fingers side by side
    assert max(np.abs(np.diff(row.astype(int))).sum() for row in views["fist"][: rows["fist"].min() + 10]) < 8


def test_a_lamp_has_its_colour_in_a_picture() -> None:
    """F41: the lit tier of a robot's signal tower is the greenest object in a picture of it, also in the shade."""
    rigid = RigidWorld(sensor_scenes.empty())
    rigid.add_robot(load_description("vinebot").to_spec("bot"))
    primitives, _ = sensor_scenes.world(*rigid.visuals(), at=rigid.visual_q())
    pose = look_at(np.array([-1.2, -0.5, 0.7]), np.array([-0.4, -0.15, 0.46]))
    frame = Camera(sensor_scenes.IDEAL, sensor_scenes.SMALL, sun=(0.6, 0.3, 0.5)).render(primitives, pose)
    _, drawn = sensor_scenes.raster(primitives, pose)
    material = primitives.materials.material.numpy()
    tint = primitives.materials.tint.numpy()
    lit = (drawn >= 0) & (material[drawn] == int(materials.LAMP)) & (tint[drawn][..., 1] > 2.0 * tint[drawn][..., 0])
    assert lit.sum() > 20
    green = frame.rgb[..., 1].astype(int) - frame.rgb[..., 0]
    assert np.median(green[lit]) > 60
    robot = (frame.labels >> 20 == int(Organ.ROBOT)) & ~lit
    assert np.median(green[robot]) < 20
