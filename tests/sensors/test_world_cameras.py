"""Pictures of all worlds of a batch: as a client's camera sees the same world, and independent of the other worlds."""

import dataclasses

import msgspec
import numpy as np
import pytest

from tests.support.layouts import order_bodies_as_a_gpu
from tests.support.terrain_scenes import hills
from vinesim.core import frames
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import LABEL_STRIDE, Organ
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.scene.values import CameraInfo, CameraOutput, Snapshot
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export.images import look_at
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot

pytest.importorskip("mujoco_warp")
from tests.physics.test_worlds import HAND, PARAMETERS, bunches, targets
from tests.physics.test_worlds_canes import BLADE, SHEARS, hanging
from tests.physics.test_worlds_cutting import blade, client
from tests.physics.test_worlds_overload import ROBOT, weak
from vinesim.learn.arm import arm
from vinesim.learn.shoots import shoots
from vinesim.sensors.camera.world_cameras import WorldCamera, WorldCameras, bunches_of_worlds
from vinesim.worlds.plants import gathered, plants_of_worlds
from vinesim.worlds.worlds import Worlds

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("layout")]

SIZE = (97, 90)
FIXED = WorldCamera(pose=look_at(np.array([-0.5, -0.8, 1.1]), np.array([0.9, 0.0, 0.7])), field_of_view=0.9)
ON_HAND = WorldCamera(
    pose=frames.pose(np.array([0.05, 0.0, 0.08]), frames.OPTICAL), field_of_view=1.2, actor="arm", link="link_6"
)
HOME = np.array([0.2, -1.6, 0.0, 1.7, 0.0, 0.1, 0.0, 0.0, 0.0])
NEAR = 10.0
"""[m] Depth up to which depths must agree; rays to ground that is farther away are nearly level."""


def shoot_worlds(seeds: list[int]) -> Worlds:
    models = [shoots(2, np.random.default_rng(seed), 1.0) for seed in seeds]
    return Worlds(plants_of_worlds(models, len(seeds)), len(seeds), robots=[arm((-0.1, 0.0, 0.6), HOME)])


def worlds_on_hills() -> Worlds:
    model = shoots(2, np.random.default_rng(1), 1.0)
    model.terrain = hills(2, roughness=0.03)
    return Worlds(model, 1, robots=[arm((-0.1, 0.0, 0.6), HOME)])


def vine_worlds(count: int) -> Worlds:
    """Some trees of a vineyard with leaves, bunches, posts and wires, in front of the arm."""
    model = generate(load_scene("demo"))
    order = np.argsort(np.linalg.norm(model.tree_pose[:, :2] - model.tree_pose[0, :2], axis=1))
    models = [gathered(model, order[4 * k : 4 * k + 8]) for k in range(count)]
    at = models[0].tree_pose[:, :3].mean(0)
    return Worlds(plants_of_worlds(models, count), count, robots=[arm((at[0] - 0.5, at[1] - 0.7, 1.0), HOME)])


def fixed_in(worlds: Worlds) -> WorldCamera:
    """The camera FIXED, where it sees the arm of these worlds."""
    away = worlds.bodies.rigid.robot("arm").spec.pose[:3] - np.array([-0.1, 0.0, 0.6])
    return dataclasses.replace(FIXED, pose=np.append(FIXED.pose[:3] + away, FIXED.pose[3:]))


def snapshot_of(worlds: Worlds) -> Snapshot:
    """The state of a batch with one world as a client would publish it."""
    worlds.download()
    rigid, data = worlds.bodies.rigid, worlds.bodies.data
    worlds.bodies.update_kinematics()
    body = rigid.visual_bodies()
    poses = np.concatenate([data.xpos.numpy()[0, body], frames.from_wxyz(data.xquat.numpy()[0, body])], 1)
    rest = rest_snapshot(worlds.model, rigid.visuals(), poses)
    trees = np.arange(len(worlds.model.tree_first))
    return dataclasses.replace(rest, body_q=worlds.plants.state.body_q, moved_trees=trees)


def seen_by_client(model: Model, snapshot: Snapshot, camera: WorldCamera, pose: np.ndarray) -> tuple[np.ndarray, ...]:
    """Labels and depth of :class:`Camera` from ``pose``, and its colours."""
    scene = Primitives(model, grass=0.0)
    scene.update(snapshot, np.arange(len(model.tree_first)))
    width, height = SIZE
    focal = 0.5 * width / np.tan(0.5 * camera.field_of_view)
    info = CameraInfo(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), "camera", ())
    one = Camera(CameraSpec.load("d435").ideal(), info, exposure=0.75)
    frame = one.render(scene, pose, outputs=CameraOutput.RGB | CameraOutput.LABELS | CameraOutput.EXACT_DEPTH)
    return frame.labels, frame.exact_depth, frame.rgb


def assert_equal_pictures(labels: np.ndarray, depth: np.ndarray, other: np.ndarray, truth: np.ndarray) -> None:
    same = labels == other
    assert same.mean() >= 0.995
    near = same & (truth < NEAR)
    assert near.sum() > 500
    np.testing.assert_allclose(depth[near], truth[near], atol=1e-3)
    np.testing.assert_array_equal(np.isinf(depth[same]), np.isinf(truth[same]))


@pytest.mark.parametrize(
    "make", [lambda: shoot_worlds([1]), lambda: vine_worlds(1), worlds_on_hills], ids=["shoots", "vine", "hills"]
)
@pytest.mark.parametrize("camera", [FIXED, ON_HAND], ids=["fixed", "on_hand"])
def test_a_world_looks_as_a_client_sees_it(make, camera: WorldCamera) -> None:
    """After half a second in which the arm moves and the plants swing."""
    worlds = make()
    home = worlds.bodies.targets.numpy()
    worlds.bodies.targets.assign(home + np.array([0.3, 0.2, -0.3, 0.2, 0.2, 0.1, 0.0, 0.02, -0.02], np.float32))
    worlds.step(50)
    if camera is FIXED:
        camera = fixed_in(worlds)
    cameras = WorldCameras(worlds, [camera], SIZE)
    cameras.render()
    snapshot = snapshot_of(worlds)
    pose = camera.pose
    if camera.actor:
        body = worlds.bodies.rigid.robot("arm").bodies[camera.link]
        names = [one.name for one in worlds.bodies.rigid.visuals()]
        assert worlds.bodies.rigid.visual_bodies()[names.index("arm/link_6")] == body
        pose = frames.compose(snapshot.visual_q[names.index("arm/link_6")], pose)
    labels, depth = cameras.labels.numpy()[0, 0], cameras.depth.numpy()[0, 0]
    other, truth, rgb = seen_by_client(worlds.model, snapshot, camera, pose)
    assert_equal_pictures(labels, depth, other, truth)
    seen = {Organ(organ) for organ in np.unique(labels) // LABEL_STRIDE}
    assert {Organ.ROBOT, Organ.GROUND} <= seen
    if camera is not ON_HAND:
        assert {Organ.BUNCH, Organ.NOTHING} <= seen
    mine = cameras.rgb
    assert mine is not None
    sky = labels == 0
    colours = mine.numpy()[0, 0].astype(int)
    assert np.abs(colours - rgb)[sky].max(initial=0) <= 1
    assert np.abs(colours - rgb).mean() < 25.0, "without shadows"


@pytest.mark.parametrize("make", [shoot_worlds, lambda seeds: vine_worlds(len(seeds))], ids=["shoots", "vine"])
def test_pictures_of_all_worlds_are_those_of_each_world_alone_to_the_bit(make) -> None:
    together = make([1, 2, 3])
    cameras = WorldCameras(together, [fixed_in(together), ON_HAND], SIZE)
    together.step(3)
    cameras.render()
    trees = np.arange(len(together.model.tree_first) // 3) * 3
    for world in range(3):
        alone = Worlds(gathered(together.model, trees + world), 1, robots=[together.bodies.rigid.robot("arm").spec])
        single = WorldCameras(alone, [fixed_in(alone), ON_HAND], SIZE)
        alone.step(3)
        single.render()
        for one, other in ((cameras.depth, single.depth), (cameras.labels, single.labels), (cameras.rgb, single.rgb)):
            assert one is not None
            assert other is not None
            np.testing.assert_array_equal(one.numpy()[world], other.numpy()[0])


def test_pictures_follow_the_arm_and_a_reset_and_do_not_change_the_states() -> None:
    worlds = shoot_worlds([1, 2])
    blind = shoot_worlds([1, 2])
    cameras = WorldCameras(worlds, [FIXED, ON_HAND], SIZE)

    def pictures() -> list[np.ndarray]:
        cameras.render()
        assert cameras.rgb is not None
        return [array.numpy().copy() for array in (cameras.rgb, cameras.depth, cameras.labels)]

    first = pictures()
    for batch in (worlds, blind):
        batch.bodies.targets.assign(batch.bodies.targets.numpy() + np.float32(0.5) * (np.arange(9) < 4))
    for _ in range(5):
        worlds.step(4)
        blind.step(4)
        moved = pictures()
    assert all((a != b).any(axis=tuple(range(1, a.ndim))).all() for a, b in zip(first, moved, strict=True))
    worlds.download()
    blind.download()
    np.testing.assert_array_equal(worlds.plants.state.body_q, blind.plants.state.body_q)
    np.testing.assert_array_equal(worlds.bodies.data.qpos.numpy(), blind.bodies.data.qpos.numpy())
    worlds.reset(np.array([False, True]))
    for before, at_first, now in zip(moved, first, pictures(), strict=True):
        np.testing.assert_array_equal(now[0], before[0])
        np.testing.assert_array_equal(now[1], at_first[1])


def test_pictures_are_the_same_in_the_order_of_bodies_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four trees lie side by side in the kernels' arrays."""

    def drawn() -> np.ndarray:
        worlds = vine_worlds(3)
        cameras = WorldCameras(worlds, [fixed_in(worlds), ON_HAND], SIZE)
        worlds.step(5)
        cameras.render()
        assert (cameras.labels.numpy() // LABEL_STRIDE == int(Organ.LEAF)).sum() > 300
        return cameras.depth.numpy()

    expected = drawn()

    order_bodies_as_a_gpu(monkeypatch, 4)
    np.testing.assert_array_equal(drawn(), expected)


def test_only_the_wanted_pictures_are_drawn() -> None:
    worlds = shoot_worlds([1, 2])
    cameras = WorldCameras(worlds, [FIXED], SIZE, colours=False)
    cameras.render(np.array([False, True]))
    assert cameras.rgb is None
    labels = cameras.labels.numpy()
    assert not labels[0].any()
    assert labels[1].any()


def test_a_world_that_explodes_keeps_its_pictures_and_the_others_do_not_notice() -> None:
    drawn = []
    for explode in (False, True):
        worlds = shoot_worlds([1, 2, 3])
        cameras = WorldCameras(worlds, [FIXED, ON_HAND], SIZE)
        cameras.render()
        assert cameras.rgb is not None
        before = cameras.rgb.numpy()[1].copy()
        if explode:
            rates = worlds.bodies.data.qvel.numpy()
            rates[1, 4] = np.nan
            worlds.bodies.data.qvel.assign(rates)
        worlds.step(4)
        cameras.render()
        drawn.append(cameras.rgb.numpy().copy())
        assert (before == drawn[-1][1]).all() == explode
    np.testing.assert_array_equal(drawn[0][[0, 2]], drawn[1][[0, 2]])


def test_a_bunch_that_is_cut_off_looks_as_in_a_client() -> None:
    """The hand lifts the bunch while the blade cuts. The second world's hand does not cut. After a reset the bunch
    hangs again."""
    physics = client(bunches(1), HAND)
    cutter = physics.add_blade("hand", "palm", *_mouth(), force=200.0)
    worlds = Worlds(bunches(2), 2, robots=[HAND], parameters=PARAMETERS, blade=blade())
    assert worlds.pool is not None
    bunch = bunches(1)
    top = rest_snapshot(bunch).body_q[bunch.bunch_body[0], :3]
    eye = top + np.array([0.35, -0.25, 0.2])
    camera = WorldCamera(pose=look_at(eye, top + np.array([0.0, 0.0, 0.05])), field_of_view=0.6)
    cameras = WorldCameras(worlds, [camera], SIZE)
    cameras.render()
    first = cameras.labels.numpy().copy()
    for tick in range(100):
        target = targets(tick, 0.1)
        physics.rigid.command("hand", target)
        worlds.bodies.targets.assign(np.tile(target, (2, 1)).astype(np.float32))
        if tick == 60:
            cutter.close()
            worlds.pool.closing.assign(np.array([True, False]))
        physics.step()
        worlds.step()
    assert worlds.pool.bunch.numpy()[:, 0].tolist() == [0, -1]
    cameras.render()
    labels, depth = cameras.labels.numpy(), cameras.depth.numpy()
    other, truth, _ = seen_by_client(physics.model, physics.snapshot(), camera, camera.pose)
    assert_equal_pictures(labels[0, 0], depth[0, 0], other, truth)
    stump = physics.state.body_q[bunch.body_parent[bunch.bunch_body[0]] - 1, :3]
    above = WorldCamera(pose=look_at(stump + np.array([0.2, -0.2, 0.1]), stump), field_of_view=0.4)
    late = WorldCameras(worlds, [above], SIZE)
    late.render()
    labels_above = late.labels.numpy()[0, 0]
    other, truth, _ = seen_by_client(physics.model, physics.snapshot(), above, above.pose)
    assert_equal_pictures(labels_above, late.depth.numpy()[0, 0], other, truth)
    assert (labels_above // LABEL_STRIDE == int(Organ.PEDUNCLE)).any()
    stalks = labels[:, 0] // LABEL_STRIDE == int(Organ.PEDUNCLE)
    assert stalks.any(axis=(1, 2)).all()
    is_bunch = labels[:, 0] // LABEL_STRIDE == int(Organ.BUNCH)
    assert is_bunch[0].sum() > 50
    assert (labels[0] != labels[1]).any()
    worlds.reset()
    cameras.render()
    np.testing.assert_array_equal(cameras.labels.numpy(), first)


def test_canes_that_are_cut_look_as_in_a_client() -> None:
    """Nearly weightless, so that pieces come off slowly. The first cut parts the upper segment of a cane, the
    second one the piece, the third one the stump. The second world is not cut. After a reset the cane is whole."""
    parameters = msgspec.structs.replace(PARAMETERS, gravity=0.3)
    physics = client(hanging(1), SHEARS, parameters)
    cutter = physics.add_blade("shears", "head", BLADE.pose, BLADE.half)
    worlds = Worlds(hanging(2), 2, robots=[SHEARS], parameters=parameters, blade=BLADE)
    assert worlds.pool is not None
    middle = np.array([0.0, 0.0, 1.03])
    camera = WorldCamera(pose=look_at(middle + np.array([0.3, -0.4, 0.0]), middle), field_of_view=0.8)
    cameras = WorldCameras(worlds, [camera], SIZE)
    paint = np.random.default_rng(0).uniform(0.1, 0.9, (cameras.primitives, 3)).astype(np.float32)
    cameras._tables.looks.tint.assign(np.tile(paint, (2, 1)))  # so that stumps without the colour of the cane are seen
    cameras.render()
    assert cameras.rgb is not None
    first = [array.numpy().copy() for array in (cameras.labels, cameras.depth, cameras.rgb)]
    for tick, height in enumerate([0.1] * 60 + [0.0] * 60 + [0.15] * 60):
        physics.rigid.command("shears", np.array([height]))
        worlds.bodies.targets.assign(np.full((2, 1), height, np.float32))
        if tick % 60 == 20:
            cutter.close()
            worlds.pool.closing.assign(np.array([True, False]))
        physics.step()
        worlds.step()
        if tick % 60 == 59:
            cameras.render()
            labels, depth = cameras.labels.numpy(), cameras.depth.numpy()
            other, truth, _ = seen_by_client(physics.model, physics.snapshot(), camera, camera.pose)
            canes = [seen // LABEL_STRIDE == int(Organ.CANE) for seen in (labels[0, 0], labels[1, 0], other)]
            assert (canes[0] == canes[2]).sum() >= canes[0].size - 2
            assert (canes[0] != canes[1]).sum() > 4
            assert_equal_pictures(labels[0, 0], depth[0, 0], other, truth)
            assert (labels[1] == first[0][1]).mean() >= 0.995
            is_stump = canes[0] & canes[1]
            is_stump[12:] = False  # lower rows show what has fallen
            assert is_stump.sum() > 10
            colours = cameras.rgb.numpy().astype(int)[:, 0, is_stump]
            assert np.abs(colours[0] - colours[1]).mean() < 2.0
    assert (worlds.pool.canes.parts[0].segment.numpy()[worlds.plants.buffers.slots] >= 0).sum() == 2 * 4 + 3
    assert not worlds.faults.numpy().any()
    worlds.reset()
    cameras.render()
    for array, expected in zip((cameras.labels, cameras.depth, cameras.rgb), first, strict=True):
        np.testing.assert_array_equal(array.numpy(), expected)


@pytest.mark.parametrize(
    ("seed", "pull", "bend", "strength", "rate"),
    [
        pytest.param(1, 4.0, 5.0, 0.0, 1.0, id="a peduncle at the shoot"),
        pytest.param(3, 3.5, 50.0, 0.0, 2.0, id="a peduncle at the bunch"),
        pytest.param(1, 500.0, 500.0, 4e7, 6.0, id="a cane"),
    ],
)
def test_wood_that_breaks_looks_as_in_a_client(
    seed: int, pull: float, bend: float, strength: float, rate: float
) -> None:
    """A tenth of a second after the wood has parted, when poses differ by some micrometres. After a reset all is
    whole."""
    model = weak(seed, pull, bend)
    model.body_strength[model.body_organ == int(Organ.CANE)] = strength
    model.body_toughness[:] = 1e3
    physics = client(model, ROBOT)
    at_rest = physics.snapshot()
    at_rest = dataclasses.replace(at_rest, body_q=at_rest.body_q.copy())
    start = np.random.default_rng(seed).normal(0.0, rate, physics.state.joint_qd.shape)
    worlds = Worlds(model, 1, robots=[ROBOT], parameters=PARAMETERS, breaks=True)
    physics.state.joint_qd[:] = start
    worlds.plants.state.joint_qd[:] = start
    worlds.plants.upload()
    broke = -1
    for tick in range(150):
        physics.step()
        worlds.step()
        if physics.detachments and broke < 0:
            broke = tick
        if 0 <= broke == tick - 10:
            break
    assert broke >= 0
    snapshot = physics.snapshot()
    falls = snapshot.visual_q[-1] if strength == 0.0 else snapshot.body_q[model.bunch_body[0]]
    middle = falls[:3].astype(float)
    camera = WorldCamera(pose=look_at(middle + np.array([0.6, -0.6, 0.3]), middle), field_of_view=0.9)
    cameras = WorldCameras(worlds, [camera], SIZE)
    cameras.render()
    labels, depth = cameras.labels.numpy()[0, 0], cameras.depth.numpy()[0, 0]
    other, truth, _ = seen_by_client(physics.model, snapshot, camera, camera.pose)
    same = labels == other
    assert same.mean() >= 0.995
    near = same & (truth < NEAR)
    assert (np.abs(depth[near] - truth[near]) < 1e-3).mean() >= 0.995
    assert (labels // LABEL_STRIDE == int(Organ.BUNCH)).sum() > 40
    assert (labels // LABEL_STRIDE == int(Organ.CANE)).sum() > 10
    assert not worlds.faults.numpy().any()
    worlds.reset()
    cameras.render()
    labels, depth = cameras.labels.numpy()[0, 0], cameras.depth.numpy()[0, 0]
    assert_equal_pictures(labels, depth, *seen_by_client(physics.model, at_rest, camera, camera.pose)[:2])


def _mouth() -> tuple[np.ndarray, np.ndarray]:
    given = blade()
    return given.pose, given.half


def test_bunches_are_numbered_within_their_world() -> None:
    worlds = shoot_worlds([1, 2, 3])
    assert bunches_of_worlds(worlds.model, 3).tolist() == [[0, 3], [1, 4], [2, 5]]
    cameras = WorldCameras(worlds, [FIXED], SIZE)
    cameras.render()
    for labels in cameras.labels.numpy():
        of_bunch = labels[labels // LABEL_STRIDE == int(Organ.BUNCH)]
        assert set(np.unique(of_bunch % LABEL_STRIDE)) == {0, 1}


def test_bad_arguments_are_named() -> None:
    worlds = shoot_worlds([1])
    with pytest.raises(ValueError, match="no cameras: give at least one"):
        WorldCameras(worlds, [])
    with pytest.raises(ValueError, match=r"pictures of 0 x 64 px: give 1 to 1024 px"):
        WorldCameras(worlds, [FIXED], (0, 64))
    with pytest.raises(ValueError, match=r"camera 1 has the field_of_view 4.0: give 0.01 to 3.1 rad"):
        WorldCameras(worlds, [FIXED, dataclasses.replace(FIXED, field_of_view=4.0)])
    with pytest.raises(ValueError, match="link_9"):
        WorldCameras(worlds, [dataclasses.replace(ON_HAND, link="link_9")])
    with pytest.raises(ValueError, match="pose of camera 0"):
        WorldCameras(worlds, [dataclasses.replace(FIXED, pose=np.full(7, np.nan))])
