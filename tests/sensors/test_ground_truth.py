"""What is true of a picture, against the ray caster, closed forms, a lidar and Open3D."""

import dataclasses

import numpy as np
import pytest

from tests.support import sensor_scenes
from vinesim.core import frames
from vinesim.scene.berries import VARIETIES, lay_out_berries, segment_of
from vinesim.scene.camera_geometry import project_points
from vinesim.scene.ids import Organ, label
from vinesim.scene.values import CameraFrame, CameraInfo, RigidVisual
from vinesim.sensors import ground_truth
from vinesim.sensors.camera.camera import Camera
from vinesim.sensors.export.images import look_at
from vinesim.sensors.lidar.lidar import Lidar, LidarSpec
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot
from vinesim.sensors.raster.primitive_arrays import SPHEROID


def _frame(labels: np.ndarray, depth: np.ndarray) -> CameraFrame:
    return CameraFrame(
        0.0, "c", sensor_scenes.SMALL, sensor_scenes.AHEAD, np.zeros((*labels.shape, 3), np.uint8), depth, labels
    )


def test_pixels_boxes_and_distances() -> None:
    labels = np.zeros((6, 8), np.int32)
    labels[1:3, 2:5] = label(Organ.BUNCH, 7)
    labels[5, 7] = label(Organ.BUNCH, 3)
    labels[0, 0] = label(Organ.LEAF, 7)
    depth = np.full((6, 8), np.inf, np.float32)
    depth[1:3, 2:5] = 1.5
    depth[1, 2] = -np.inf
    three, seven = ground_truth.detect_bunches(_frame(labels, depth))
    assert (three.bunch, three.pixels, three.box) == (3, 1, (7, 5, 7, 5))
    assert np.isnan(three.distance)
    assert (seven.bunch, seven.pixels, seven.box, seven.distance) == (7, 6, (2, 1, 4, 2), pytest.approx(1.5))


def test_no_bunch_no_sighting() -> None:
    assert ground_truth.detect_bunches(_frame(np.zeros((4, 4), np.int32), np.zeros((4, 4), np.float32))) == ()


# ---- a picture and all that is true of it ----------------------------------------------------------------------------

NEAR = CameraInfo(320, 240, 250.0, 250.0, 159.5, 119.5, "optical")
TELESCOPE = CameraInfo(3, 3, 40000.0, 40000.0, 1.0, 1.0, "optical")
SELDOM = 1e-3
"""Share of the pixels in which rasteriser and ray caster may differ, as in test_visibility."""


@pytest.fixture(scope="module")
def grove():
    """The demo vineyard, its primitives and view."""
    model = sensor_scenes.demo()
    view = rest_snapshot(model)
    primitives = Primitives(model, grass=2.0)
    primitives.update(view)
    return model, primitives, view


def _middle(model, view, bunch: int) -> np.ndarray:
    pose = view.body_q[model.bunch_body[bunch]].astype(float)
    return pose[:3] + frames.rotate(pose[3:], np.array([0.5 * model.bunch_length[bunch], 0.0, 0.0]))


def _before(model, view, bunch: int, away=(-0.48, 0.3, -0.12)) -> np.ndarray:
    middle = _middle(model, view, bunch)
    return look_at(middle + np.array(away), middle)


def _of(truths, bunch: int) -> ground_truth.BunchTruth:
    return next(one for one in truths if one.bunch == bunch)


def _points(seen: ground_truth.PixelBuffers, mask: np.ndarray) -> np.ndarray:
    """World points [k, 3] of some pixels, from depth and intrinsics alone."""
    local = sensor_scenes.pixel_rays(seen.info)[mask] * seen.depth[mask].astype(float)[:, None]
    return seen.pose[:3] + frames.rotate(seen.pose[3:], local)


@pytest.fixture(scope="module")
def along(grove):
    """A look along the rows, and the truth of it."""
    _, primitives, view = grove
    seen = ground_truth.render_buffers(primitives, NEAR, look_at(np.array([0.4, 1.2, 1.3]), np.array([3.0, 1.0, 1.7])))
    return seen, ground_truth.bunch_truths(primitives, view, seen)


def test_ids_pixels_and_berries_are_those_of_the_ray_caster(grove, along) -> None:
    model, primitives, _ = grove
    seen, truths = along
    _, oracle = sensor_scenes.oracle(primitives, seen.pose, NEAR)
    assert (oracle == seen.primitive).mean() >= 1.0 - SELDOM
    organ = np.append(primitives.label, [0, 0])[oracle]
    kind = np.append(np.repeat(primitives.cluster_kind, primitives.cluster_size), [-1, -1])
    assert len(truths) > 30
    for one in truths:
        mine = organ == label(Organ.BUNCH, one.bunch)
        assert abs(mine.sum() - one.pixels) <= 0.01 * mine.sum() + 2
        berry, count = np.unique(oracle[mine & (kind[oracle] == SPHEROID)], return_counts=True)
        seen_by_oracle = (count >= ground_truth.MIN_BERRY_PIXELS).sum()
        assert abs(seen_by_oracle - one.berries_seen) <= 1  # one pixel more or less
        assert one.berries == model.bunch_berries[one.bunch] >= one.berries_seen
        assert len(berry) <= one.berries


def test_berry_numbers_are_those_of_the_packed_bunch(grove) -> None:
    model, primitives, view = grove
    bunch = 22
    seen = ground_truth.render_buffers(primitives, NEAR, _before(model, view, bunch))
    mine = (seen.labels == label(Organ.BUNCH, bunch)) & (seen.berries >= 0)
    assert mine.sum() > 500
    own = lay_out_berries(
        float(model.bunch_length[bunch]),
        float(model.bunch_radius[bunch]),
        int(model.bunch_berries[bunch]),
        int(model.bunch_variety[bunch]),
        int(model.bunch_seed[bunch]),
    )
    number = seen.berries[mine]
    assert number.max() < len(own.radius)
    # every point lies on the surface of the spheroid that its number names, in the frame of the piece that carries it
    carrier = seen.carrier_poses[seen.primitive[mine]]
    local = frames.rotate(frames.conjugate(carrier[:, 3:]), _points(seen, mine) - carrier[:, :3])
    pieces = 1 + int(model.bunch_clusters[bunch])
    length = float(model.bunch_length[bunch])
    along = segment_of(own.position, length, pieces)[number] * (length / pieces)
    away = local + along[:, None] * np.array([1.0, 0.0, 0.0]) - own.position[number]
    stretch = VARIETIES[int(model.bunch_variety[bunch])].elongation
    lengthwise = (away * own.axis[number]).sum(1)
    across = np.sqrt(np.maximum((away**2).sum(1) - lengthwise**2, 0.0))
    assert np.hypot(lengthwise / stretch, across) == pytest.approx(own.radius[number], abs=2e-5)


def test_amodal_masks_are_what_rays_meet_of_the_bunch_alone(grove) -> None:
    model, _, view = grove
    bunch = 18
    whole = Primitives(model, grass=0.0)
    seen = ground_truth.render_buffers(whole, NEAR, look_at(np.array([0.4, 1.2, 1.3]), np.array([3.0, 1.0, 1.7])))
    one = _of(ground_truth.bunch_truths(whole, view, seen), bunch)
    assert not (one.visible & ~one.amodal).any()
    assert one.pixels < one.amodal_pixels
    mine = whole.label[whole.cluster_first] == label(Organ.BUNCH, bunch)
    whole.clusters.shown.assign(mine.astype(np.int32))
    whole._pose(np.arange(len(mine)))  # all others are gone
    _, oracle = sensor_scenes.oracle(whole, seen.pose, NEAR)
    mask = one.mask(one.amodal, NEAR)
    assert ((oracle >= 0) != mask).sum() <= 2
    assert one.amodal_box == ground_truth._box_of(oracle >= 0, (0, 0, 0, 0))


def test_a_wall_hides_and_truth_knows_how_much(grove) -> None:
    model, _, _ = grove
    bunch = 20
    rest = rest_snapshot(model)
    pose = _before(model, rest, bunch)
    forward, right = (frames.rotate(pose[3:], np.eye(3)[k]) for k in (2, 0))

    def behind(aside: float) -> ground_truth.BunchTruth:
        """The bunch behind a board whose left edge is so far [m] right of the line of sight, or all over it."""
        board = pose[:3] + 0.2 * forward + (0.5 + aside) * right
        primitives, view = sensor_scenes.world(
            sensor_scenes.thing(sensor_scenes.shape("box", 0.5, 0.5, 0.001)), model=model, at=[[*board, *pose[3:]]]
        )
        return _of(
            ground_truth.bunch_truths(primitives, view, ground_truth.render_buffers(primitives, NEAR, pose)), bunch
        )

    free = behind(5.0)
    half = behind(0.0)
    hidden = behind(-0.5)
    assert free.occlusion < 0.1
    assert free.cut_seen
    assert np.array_equal(free.amodal, half.amodal)
    middle = NEAR.cx - half.amodal_box[0]
    columns = np.arange(half.amodal.shape[1])
    assert np.array_equal(half.visible[:, columns < middle], free.visible[:, columns < middle])
    assert not half.visible[:, columns > middle].any()
    assert 0.3 < half.occlusion < 0.7
    assert half.berries_seen < free.berries_seen
    assert (hidden.pixels, hidden.occlusion, hidden.visible_box, hidden.berries_seen) == (0, 1.0, None, 0)
    assert not hidden.cut_seen
    assert hidden.amodal_box == free.amodal_box
    assert np.array_equal(hidden.cut, free.cut)


def test_cut_points_lie_in_the_middle_of_the_peduncle(grove, along) -> None:
    model, primitives, view = grove
    seen, truths = along
    assert 10 < sum(one.cut_seen for one in truths) < len(truths)
    for one in truths:
        body = int(model.body_parent[model.bunch_body[one.bunch]])
        last = view.body_q[model.bunch_body[one.bunch], :3]
        reach = down = 0.0
        held = False
        while model.body_organ[body] == int(Organ.PEDUNCLE):
            first = view.body_q[body, :3].astype(float)
            axis = last - first
            share = np.clip((one.cut - first) @ axis / (axis @ axis), 0.0, 1.0)
            if np.linalg.norm(first + share * axis - one.cut) < 1e-5 and not held:
                held = True
                down = reach + (1.0 - share) * np.linalg.norm(axis)
            reach += np.linalg.norm(axis)
            last = first
            body = int(model.body_parent[body])
        assert held
        assert down == pytest.approx(0.5 * reach, abs=1e-5)
        pixel = np.full(2, -1.0) if one.cut_pixel is None else one.cut_pixel
        if ((pixel >= 0.0) & (pixel <= [NEAR.width - 1, NEAR.height - 1])).all():
            # a telescope on it, by the rasteriser: a stalk is thinner than a pixel from afar
            close = look_at(seen.pose[:3], one.cut)
            _, primitive = sensor_scenes.raster(primitives, close, TELESCOPE)
            shown = primitive[1, 1] >= 0 and primitives.label[primitive[1, 1]] == label(Organ.PEDUNCLE, one.bunch)
            assert shown == one.cut_seen


def test_the_3d_box_holds_the_bunch_and_no_more(grove) -> None:
    model, primitives, view = grove
    bunch = 22
    seen = ground_truth.render_buffers(primitives, NEAR, _before(model, view, bunch))
    one = _of(ground_truth.bunch_truths(primitives, view, seen), bunch)
    own = np.flatnonzero(primitives.label == label(Organ.BUNCH, bunch))
    a, b = (getattr(primitives.shapes, k).numpy()[own].astype(float) for k in "ab")
    berry = primitives.shapes.kind.numpy()[own] == SPHEROID
    rng = np.random.default_rng(1)
    way = frames.normalize(rng.normal(size=(4000, 1, 3)))
    along = (way * b[berry, :3]).sum(-1, keepdims=True) * b[berry, :3]
    surface = a[berry, :3] + a[berry, 3:] * (way + (b[berry, 3:] - 1.0) * along)
    ends = np.concatenate([a[~berry], b[~berry]])
    balls = ends[:, :3] + ends[:, 3:] * way[:400]
    points = np.concatenate([surface.reshape(-1, 3), balls.reshape(-1, 3)])
    local = frames.rotate(frames.conjugate(one.frame[3:]), points - one.frame[:3])
    assert (np.abs(local) <= 0.5 * one.size + 5e-6).all()
    assert np.ptp(local, axis=0) == pytest.approx(one.size, abs=5e-4)  # as near as samples come


def test_depth_labels_and_intrinsics_give_the_middle_of_a_bunch(grove) -> None:
    """An unhidden bunch, pictured from all around: the middle of its points is the middle of its box within 1 cm."""
    model, primitives, view = grove
    camera = Camera(sensor_scenes.IDEAL, NEAR)
    checked = 0
    for bunch in (22, 17, 69):
        points = []
        box = None
        for turn in np.arange(4) * np.pi / 2:
            pose = _before(model, view, bunch, (0.45 * np.cos(turn), 0.45 * np.sin(turn), -0.12))
            truths = ground_truth.bunch_truths(primitives, view, ground_truth.render_buffers(primitives, NEAR, pose))
            box = _of(truths, bunch)
            if box.occlusion > 0.02:
                continue
            frame = camera.render(primitives, pose)
            mask = frame.labels == label(Organ.BUNCH, bunch)
            z = frame.depth[mask].astype(float)[:, None]
            points.append(pose[:3] + frames.rotate(pose[3:], sensor_scenes.pixel_rays(NEAR)[mask] * z))
        if len(points) >= 2:
            local = frames.rotate(frames.conjugate(box.frame[3:]), np.concatenate(points) - box.frame[:3])
            middle = 0.5 * (local.min(0) + local.max(0))
            assert np.linalg.norm(middle) < 0.01
            checked += 1
    assert checked >= 1


def test_a_picked_bunch_keeps_its_number(grove) -> None:
    model, primitives, rest = grove
    bunch = 22
    pose = _before(model, rest, bunch)
    before = _of(
        ground_truth.bunch_truths(primitives, rest, ground_truth.render_buffers(primitives, NEAR, pose)), bunch
    )
    link = RigidVisual(f"bunch/{bunch}", Organ.BUNCH, bunch, ())
    lying = rest_snapshot(model, (link,), rest.body_q[model.bunch_body[[bunch]]])
    lying.bunch_attached[bunch] = False
    loose = Primitives(model, grass=2.0)
    loose.update(lying)
    after = _of(ground_truth.bunch_truths(loose, lying, ground_truth.render_buffers(loose, NEAR, pose)), bunch)
    assert (after.attached, after.cut, after.cut_pixel, after.cut_seen) == (False, None, None, False)
    assert (after.label, after.berries) == (before.label, before.berries)
    assert after.amodal_box == before.amodal_box
    assert (before.amodal != after.amodal).sum() <= 2
    assert after.size == pytest.approx(before.size, abs=1e-5)


def test_flow_of_a_moved_camera_lands_on_the_same_points(grove) -> None:
    _, primitives, _ = grove
    one, two = (
        ground_truth.render_buffers(primitives, NEAR, look_at(np.array([x, 1.2, 1.3]), np.array([3.0, y, 1.7])))
        for x, y in ((0.4, 1.0), (0.46, 1.03))
    )
    shift, shown = ground_truth.optical_flow(one, two)
    assert np.array_equal(np.isnan(shift[..., 0]), one.primitive == -1)
    assert shown.mean() > 0.5
    v, u = np.nonzero(shown)
    there = np.round(np.stack([u, v], 1) + shift[v, u]).astype(int)
    points = _points(one, shown)
    row, column = there[:, ::-1].T
    ray = sensor_scenes.pixel_rays(NEAR)[row, column] * two.depth[row, column].astype(float)[:, None]
    apart = np.linalg.norm(points - two.pose[:3] - frames.rotate(two.pose[3:], ray), axis=1)
    pixel = one.depth[v, u] / NEAR.fx
    assert np.median(apart / pixel) < 1.0  # half a pixel each way, more on slanted surfaces
    # closed form for the ground: a homography, in double precision
    ground = one.primitive == -2
    ray = frames.rotate(one.pose[3:], sensor_scenes.pixel_rays(NEAR)[ground])
    at = one.pose[:3] - ray * (one.pose[2] / ray[:, 2:])
    image = project_points(frames.rotate(frames.conjugate(two.pose[3:]), at - two.pose[:3]), NEAR)
    row, column = np.nonzero(ground)
    near = one.depth[ground] < 20.0
    assert np.abs(image - np.stack([column, row], 1) - shift[ground])[near].max() < 1e-3


def test_flow_of_a_moved_plant_is_its_motion_alone(grove) -> None:
    model, _, view = grove
    primitives = Primitives(model, grass=0.0)
    bunch = 22
    pose = _before(model, view, bunch)
    one = ground_truth.render_buffers(primitives, NEAR, pose)
    tree = int(model.body_tree[model.bunch_body[bunch]])
    body_q = view.body_q.copy()
    turn = frames.exp(np.array([0.02, 0.0, 0.1]))
    bodies = model.bodies_of(tree)
    hub = body_q[model.tree_first[tree], :3].astype(float)
    body_q[bodies, :3] = hub + frames.rotate(turn, body_q[bodies, :3] - hub)
    body_q[bodies, 3:] = frames.multiply(turn, body_q[bodies, 3:])
    primitives.update(dataclasses.replace(view, body_q=body_q, moved_trees=np.array([tree])))
    shift, _ = ground_truth.optical_flow(one, ground_truth.render_buffers(primitives, NEAR, pose))
    carried = np.append(np.isin(one.carrier_poses[:, :3], view.body_q[bodies, :3]).all(1), [False, False])[
        one.primitive
    ]
    mine = (one.labels == label(Organ.BUNCH, bunch)) & carried
    assert mine.sum() > 1000
    point = _points(one, mine)
    moved = hub + frames.rotate(turn, point - hub)
    local = frames.rotate(frames.conjugate(pose[3:]), moved - pose[:3])
    row, column = np.nonzero(mine)
    assert np.abs(project_points(local, NEAR) - np.stack([column, row], 1) - shift[mine]).max() < 5e-3
    still = ~carried & np.isfinite(one.depth)
    assert still.sum() > 1000
    assert np.abs(shift[still]).max() < 1e-6
    primitives.update(
        rest_snapshot(
            model, (sensor_scenes.thing(sensor_scenes.shape("sphere", 0.1)),), np.array([[0, 0, 9.0, 0, 0, 0, 1]])
        )
    )
    with pytest.raises(ValueError, match="added or removed"):
        ground_truth.optical_flow(one, ground_truth.render_buffers(primitives, NEAR, pose))


def test_depth_and_lidar_measure_the_same_scene(grove) -> None:
    """Lidar points, seen by the camera, lie as deep as its depth says: within 2 mm in the median."""
    _, primitives, _ = grove
    pose = look_at(np.array([0.4, 1.2, 1.3]), np.array([3.0, 1.0, 1.7]))
    scan = Lidar(LidarSpec.load("vlp16").ideal()).scan(primitives, np.array([*pose[:3], 0.0, 0.0, 0.0, 1.0]))
    fine = CameraInfo(1280, 960, 1000.0, 1000.0, 639.5, 479.5, "optical")
    seen = ground_truth.render_buffers(primitives, fine, pose)
    local = frames.rotate(frames.conjugate(pose[3:]), scan.xyz.astype(float))
    pixel = np.round(np.nan_to_num(project_points(local, fine), nan=-1.0)).astype(int)
    inside = ((pixel >= 0) & (pixel < [fine.width, fine.height])).all(1) & (local[:, 2] < 4.0)
    row = pixel[inside, 1]
    column = pixel[inside, 0]
    same = seen.labels[row, column] == scan.labels[inside]
    assert same.mean() > 0.9
    error = np.abs(seen.depth[row, column] - local[inside, 2])[same]
    assert len(error) > 1000
    assert np.median(error) < 2e-3


@pytest.mark.long
def test_registration_recovers_the_motion_between_two_views(grove) -> None:
    """Open3D's ICP on the clouds of two looks finds how the camera moved, within 2 mm and 0.1 degree."""
    o3d = pytest.importorskip("open3d", reason="Open3D is an extra (perception)")
    _, primitives, _ = grove
    start = look_at(np.array([0.4, 1.2, 1.3]), np.array([3.0, 1.0, 1.6]))
    step = np.array([0.01, -0.006, 0.012, *frames.exp(np.radians([0.4, -0.5, 0.3]))])
    clouds = []
    for pose in (start, frames.compose(start, step)):
        seen = ground_truth.render_buffers(primitives, sensor_scenes.IDEAL.info("optical"), pose)
        near = (seen.depth < 4.0) & (seen.primitive >= 0)
        local = sensor_scenes.pixel_rays(seen.info)[near] * seen.depth[near].astype(float)[:, None]
        points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(local))
        points.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(12))
        clouds.append(points)
    found = np.eye(4)
    for reach in (0.04, 0.012, 0.006):
        found = o3d.pipelines.registration.registration_icp(
            clouds[1], clouds[0], reach, found, o3d.pipelines.registration.TransformationEstimationPointToPlane()
        ).transformation
    assert np.linalg.norm(found[:3, 3] - step[:3]) < 2e-3
    turned = frames.multiply(frames.conjugate(step[3:]), frames.from_matrix(found[:3, :3]))
    assert np.degrees(np.linalg.norm(frames.log(turned))) < 0.1
