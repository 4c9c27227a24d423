"""Batches of worlds with robots: as the physics of a client, world by world."""

from collections.abc import Callable

import numpy as np
import pytest

from vinesim.bench import scenes
from vinesim.kernels.worlds.reset import MOTION, ROOM
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.world import Physics

pytest.importorskip("mujoco_warp")
from vinesim.worlds.plants import plants_of_worlds
from vinesim.worlds.rigid_batch import RigidBatch
from vinesim.worlds.worlds import Worlds

pytestmark = pytest.mark.usefixtures("layout")

PARAMETERS = PhysicsParameters(sleep=False)
HAND = scenes.gripper("hand", scenes.bunch_center(0))


def bunches(count: int) -> Model:
    """Canes with a bunch, one a world, all at the same place."""
    model = scenes.cane_row(count)
    model.tree_pose[:] = model.tree_pose[0]
    return model


def targets(tick: int, lift: float) -> np.ndarray:
    """Returns the targets [lift, left finger, right finger] m of a hand that closes, and then lifts what it holds."""
    close = 0.04 * min(tick / 25, 1.0)
    return np.array([lift * min(max(tick - 35, 0) / 30, 1.0), close, close])


@pytest.mark.slow
def test_a_hand_grasps_and_lifts_a_bunch_as_in_a_client():
    """Two seconds; the hand of the second world lifts half as high, and must not change the first one."""
    physics = Physics(bunches(1), parameters=PARAMETERS)
    physics.contact_solver.plant_plant_contacts = False
    physics.add_robot(HAND)
    physics.wake(np.arange(1))
    worlds = Worlds(bunches(2), 2, robots=[HAND], parameters=PARAMETERS)
    most = 0.0
    for tick in range(200):
        physics.rigid.command("hand", targets(tick, 0.1))
        worlds.bodies.targets.assign(np.array([targets(tick, 0.1), targets(tick, 0.05)], np.float32))
        physics.step()
        worlds.step()
        most = max(
            most, max(np.linalg.norm(contact.force) for contact in physics.contacts) if physics.contacts else 0.0
        )
    worlds.download()
    physics.update_kinematics()
    bodies = len(physics.state.body_q)
    found, other = worlds.plants.state.body_q.reshape(2, bodies, 7)
    assert most > 30.0, "the fingers press with the force of their servos"
    assert worlds.contacts.count.tolist() == [physics.contact_solver.count] * 2
    np.testing.assert_allclose(found, physics.state.body_q, atol=1e-4)
    np.testing.assert_allclose(worlds.bodies.data.qpos.numpy()[0], physics.rigid.mj_data.qpos[:6], atol=1e-4)
    assert found[-1, 2] - other[-1, 2] == pytest.approx(0.05, abs=0.01)
    assert not worlds.dropped.any()


@pytest.mark.slow
def test_a_world_that_is_reset_repeats_its_steps_to_the_bit_and_the_other_goes_on():
    worlds = Worlds(bunches(2), 2, robots=[HAND], parameters=PARAMETERS)

    def run(first: int, count: int) -> np.ndarray:
        for tick in range(first, first + count):
            worlds.bodies.targets.assign(np.array([targets(tick, 0.1)] * 2, np.float32))
            worlds.step()
        worlds.download()
        return worlds.plants.state.joint_q.reshape(2, -1, 4).copy()

    begin = run(0, 60)
    later = run(60, 30)
    assert np.abs(later - begin).max() > 1e-3
    worlds.reset(np.array([True, False]))
    again = run(0, 60)
    np.testing.assert_array_equal(again[0], begin[0])
    assert np.abs(again[1] - begin[1]).max() > 1e-3


def put(array: str, world: int, value: float) -> Callable[[Worlds], None]:
    """Returns a function that overwrites numbers of the robot's or the plants' state of one world of four."""

    def overwrite(worlds: Worlds) -> None:
        if array in ("qpos", "qvel"):
            rows = getattr(worlds.bodies.data, array)
            numbers = rows.numpy()
            numbers[world, 1] = value
        else:
            rows = worlds.plants.launches.resident_arrays[array]
            numbers = rows.numpy()
            numbers[worlds.plants.buffers.slots[worlds.model.body_tree == world]] = value
        rows.assign(numbers)

    return overwrite


@pytest.fixture(scope="module")
def four(layout: str) -> Worlds:
    return Worlds(bunches(4), 4, robots=[HAND], parameters=PARAMETERS)


@pytest.mark.slow
@pytest.mark.parametrize(
    "explode",
    [
        pytest.param(put("qvel", 1, np.nan), id="robot's rate"),
        pytest.param(put("qpos", 1, np.nan), id="robot's position"),
        pytest.param(put("qvel", 1, 1e7), id="robot too fast"),
        pytest.param(put("joint_qd", 1, np.nan), id="plants' rates"),
        pytest.param(put("joint_q", 1, np.nan), id="plants' positions"),
        pytest.param(put("joint_qd", 1, 1e6), id="plants too fast"),
    ],
)
def test_a_world_that_explodes_is_found_and_reset_and_the_others_do_not_notice(
    four: Worlds, explode: Callable[[Worlds], None]
) -> None:
    """The hands hold their bunches when one of four worlds explodes."""
    worlds = four

    def run(first: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        for tick in range(first, first + count, 2):
            worlds.bodies.targets.assign(np.array([targets(tick, 0.1)] * 4, np.float32))
            worlds.step(2)
        worlds.download()
        return worlds.plants.state.joint_q.reshape(4, -1, 4).copy(), worlds.bodies.data.qpos.numpy().copy()

    worlds.reset()
    run(0, 40)
    assert (worlds.contacts.count > 0).all()
    sound = run(40, 8)
    worlds.reset()
    assert not worlds.faults.numpy().any()
    counted = worlds.fault_count.numpy().copy()
    run(0, 40)
    explode(worlds)
    broken = run(40, 8)
    assert (worlds.faults.numpy() & MOTION).tolist() == [0, MOTION, 0, 0]
    assert not worlds.faults.numpy()[[0, 2, 3]].any()
    assert (worlds.fault_count.numpy() - counted).tolist() == [0, 1, 0, 0]
    for one, other in zip(sound, broken, strict=True):
        np.testing.assert_array_equal(other[[0, 2, 3]], one[[0, 2, 3]])
    worlds.reset(worlds.faults.numpy() != 0)
    assert not worlds.faults.numpy().any()
    run(0, 40)
    again = run(40, 8)
    for one, other in zip(sound, again, strict=True):
        np.testing.assert_array_equal(other[1], one[1])
    assert not worlds.faults.numpy().any()


@pytest.mark.slow
def test_contacts_beyond_the_room_of_one_world_are_its_fault_alone() -> None:
    """The second hand closes both fingers where there is room for one contact; the other hands close one. Its
    first touch is at one point."""

    def run(both: bool) -> Worlds:
        worlds = Worlds(bunches(4), 4, robots=[HAND], parameters=PARAMETERS, slots=1)
        for tick in range(23):
            close = np.array([targets(tick, 0.0)] * 4, np.float32)
            close[[0, 2, 3] if both else slice(None), 2] = 0.0
            worlds.bodies.targets.assign(close)
            worlds.step()
        worlds.download()
        return worlds

    sound, crowded = run(False), run(True)
    assert (sound.contacts.count == 1).all()
    assert not sound.faults.numpy().any()
    assert crowded.faults.numpy().tolist() == [0, ROOM, 0, 0]
    assert crowded.fault_count.numpy().tolist() == [0, 1, 0, 0]
    one, other = (worlds.plants.state.joint_q.reshape(4, -1, 4) for worlds in (sound, crowded))
    np.testing.assert_array_equal(other[[0, 2, 3]], one[[0, 2, 3]])
    crowded.reset(np.array([False, True, False, False]))
    crowded.step()
    assert crowded.faults.numpy()[1] == 0, "only a further contact without room is a new fault"


@pytest.mark.slow
def test_no_world_is_listed_twice_for_a_longer_search_if_all_lack_room_for_contacts() -> None:
    """The list has an entry for each world. All hands close both fingers where there is room for one contact."""
    worlds = Worlds(bunches(4), 4, robots=[HAND], parameters=PARAMETERS, slots=1)
    busy = worlds.contacts.lists()[1].busy_count
    longest = 0
    for tick in range(40):
        worlds.bodies.targets.assign(np.array([targets(tick, 0.0)] * 4, np.float32))
        worlds.step()
        longest = max(longest, int(busy.numpy()[0]))
    assert (worlds.dropped > 0).all()
    assert longest <= 4


@pytest.mark.slow
def test_contacts_of_robots_beyond_their_room_are_a_fault_and_print_nothing(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The fingers of a hand press on each other; there is room for one contact of each world."""
    monkeypatch.setitem(RigidBatch.__init__.__kwdefaults__, "contacts", 1)
    hand = scenes.gripper("hand", np.array([5.0, 5.0, 1.0]))
    worlds = Worlds(bunches(2), 2, robots=[hand], parameters=PARAMETERS)
    worlds.bodies.targets.assign(np.array([[0.0, 0.12, 0.12]] * 2, np.float32))
    worlds.step(60)
    assert worlds.faults.numpy().tolist() == [ROOM, ROOM]
    assert worlds.fault_count.numpy().tolist() == [1, 1]
    assert "overflow" not in "".join(capfd.readouterr())


@pytest.mark.slow
def test_plants_of_worlds_are_those_of_their_models():
    """Two worlds of one scene, and one of another, whose canes are longer."""
    one, other = scenes.cane_row(2), scenes.cane_row(2)
    other.body_length *= 1.1
    model = plants_of_worlds([one, other], 3).check()
    assert model.tree_pose[:, 1].tolist() == pytest.approx([0.0, 0.0, 0.0, 0.15, 0.15, 0.15])
    size = len(one.body_mass) // 2
    long = model.body_length[model.tree_first] / one.body_length[0]
    assert long.tolist() == pytest.approx([1.0, 1.1, 1.0, 1.0, 1.1, 1.0])
    assert (model.bunch_body == model.tree_first + size - 1).all()
    assert plants_of_worlds([one], 1).digest() == one.digest()


def test_models_with_different_numbers_of_trees_are_refused():
    with pytest.raises(ValueError, match="model 1 has 3 trees, model 0 has 2"):
        plants_of_worlds([scenes.cane_row(2), scenes.cane_row(3)], 2)
