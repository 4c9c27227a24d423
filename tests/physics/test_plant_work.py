"""Work on plants by hand: ties opened and bound, shoots held, moved and let go."""

import msgspec
import numpy as np
import pytest

from vinesim.api.plant_work import GRIP_STIFFNESS
from vinesim.api.simulation import Simulation
from vinesim.core.errors import UsageError
from vinesim.scene import spec as scenes
from vinesim.scene.cane import CaneBuilder
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.state import State
from vinesim.world import Physics

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def vine() -> Model:
    scene = scenes.load_scene("winter_spur")
    layout = msgspec.structs.replace(scene.layout, rows=1, vines=2)
    return generate(msgspec.structs.replace(scene, layout=layout))


def _tied_cane(model: Model) -> tuple[int, np.ndarray]:
    """A cane with two ties or more, and its ties."""
    canes = model.canes
    of_tie = canes.of_bodies(len(model.body_mass))[model.tie_body]
    cane = int(np.argmax(np.bincount(of_tie, minlength=len(canes.body)) >= 3))
    return cane, np.flatnonzero(of_tie == cane)


def _tip_body(model: Model, cane: int) -> int:
    return int(model.canes.body[cane] + model.canes.size[cane] - 1)


def _without(model: Model, ties: np.ndarray) -> Model:
    free = model.copy()
    keep = np.setdiff1d(np.arange(len(model.tie_body)), ties)
    for name in model.array_fields():
        if name.startswith("tie_"):
            setattr(free, name, getattr(model, name)[keep])
    return free


def _pushed(simulation: Simulation, body: int) -> float:
    """How far 0.05 N across the row move a body [m]."""
    before = simulation.body_pose(body)[:3].astype(float)
    for _ in range(200):
        simulation.apply_wrench(body, (0.0, 0.05, 0.0))
        simulation.step()
    return float(np.linalg.norm(simulation.body_pose(body)[:3] - before))


def test_an_untied_cane_gives_as_one_that_was_never_tied(vine: Model) -> None:
    cane, ties = _tied_cane(vine)
    body = _tip_body(vine, cane)
    tied, untied, never = Simulation(vine), Simulation(vine), Simulation(_without(vine, ties))
    for tie in ties.tolist():
        untied.untie(tie)
    moved = [_pushed(one, body) for one in (tied, untied, never)]
    assert moved[1] == pytest.approx(moved[2], rel=1e-3)
    assert moved[1] > 3.0 * moved[0]
    assert untied.faults == {}


def test_opening_a_tie_without_load_moves_nothing(vine: Model) -> None:
    simulation = Simulation(vine)
    before = simulation.state.body_q[:, :3].astype(float)
    simulation.untie(int(_tied_cane(vine)[1][0]))
    simulation.step(100)
    simulation.physics.update_kinematics()
    assert np.abs(simulation.state.body_q[:, :3] - before).max() < 5e-4


def test_a_cut_cane_hangs_in_its_ties_until_they_are_opened(vine: Model) -> None:
    cane, ties = _tied_cane(vine)
    simulation = Simulation(vine)
    body = _tip_body(vine, cane)
    before = float(simulation.body_pose(body)[2])
    simulation.cut(int(vine.canes.body[cane]) + 1)
    simulation.step(150)
    assert before - simulation.body_pose(body)[2] < 0.01
    for tie in ties.tolist():
        simulation.untie(tie)
    simulation.step(250)  # it falls over, onto other canes and wires
    assert before - simulation.body_pose(body)[2] > 0.4


def test_a_held_place_follows_its_target_and_springs_back(vine: Model) -> None:
    cane, ties = _tied_cane(vine)
    simulation = Simulation(vine)
    for tie in ties.tolist():
        simulation.untie(tie)
    body = int(vine.canes.body[cane]) + 9
    hold = simulation.hold(body, 0.02)
    start = hold.position
    hold.follow(start + np.array([0.0, 0.08, 0.0]), speed=0.1)
    while not hold.is_done:
        simulation.step()
    simulation.step(100)
    gap = hold.target - hold.position
    np.testing.assert_allclose(hold.target, start + np.array([0.0, 0.08, 0.0]), atol=1e-5)
    np.testing.assert_allclose(hold.force, GRIP_STIFFNESS * gap, atol=1e-3)
    assert 0.05 < np.linalg.norm(hold.force) < 20.0
    hold.release()
    assert not hold.is_held
    simulation.step(400)
    simulation.physics.update_kinematics()
    back = simulation.body_pose(body)[:3]
    assert np.linalg.norm(back - simulation.model.forward_kinematics(vine.joint_settled)[body, :3]) < 2e-3


def test_a_shoot_is_tucked_and_tied(vine: Model) -> None:
    _, ties = _tied_cane(vine)
    simulation = Simulation(vine)
    for tie in ties.tolist():
        simulation.untie(tie)
    body = int(vine.tie_body[ties[1]])
    hold = simulation.hold(body, float(vine.tie_point[ties[1], 0]))
    hold.follow(hold.position + np.array([0.06, 0.0, 0.0]), speed=0.1)
    while not hold.is_done:
        simulation.step()
    tie = simulation.tie(body)
    hold.release()
    simulation.step(300)
    assert tie.is_done
    piece = int(vine.tie_wire[ties[1]])
    start, end = vine.fixed_start[piece].astype(float), vine.fixed_end[piece].astype(float)
    way = (end - start) / np.linalg.norm(end - start)
    off = tie.target - start
    gap = np.linalg.norm(off - way * (off * way).sum())
    assert gap == pytest.approx(vine.fixed_radius[piece].mean() + vine.body_radius[body].mean(), abs=1e-4)
    np.testing.assert_allclose(tie.position, tie.target, atol=5e-3)
    np.testing.assert_allclose(tie.force, GRIP_STIFFNESS * (tie.target - tie.position))
    assert 0.02 < (tie.position - State.at_rest(vine).body_q[body, :3])[0] < 0.15
    assert simulation.faults == {}


def test_work_that_is_impossible_is_refused_with_one_line(vine: Model) -> None:
    simulation = Simulation(vine)
    body = int(vine.canes.body[1])
    with pytest.raises(UsageError, match=r"tie is -1; give 0 to|tie -1"):
        simulation.untie(-1)
    with pytest.raises(UsageError, match=r"along is 1\.0: body \d+ is 0\.\d+ m long; give 0 to"):
        simulation.hold(body, 1.0)
    with pytest.raises(UsageError, match=r"no wire within 0\.12 m .* there is none; give to = "):
        Simulation(CaneBuilder()).tie(3)
    hold = simulation.hold(body)
    with pytest.raises(UsageError, match="path is"):
        hold.follow((0.0, np.nan, 0.0), 0.1)
    hold.release()
    hold.release()
    with pytest.raises(UsageError, match="was let go; hold it again"):
        hold.follow((0.0, 0.0, 0.0), 0.1)
    for other in range(simulation.parameters.max_held_bodies):
        simulation.hold(other)
    with pytest.raises(UsageError, match="are held already"):
        simulation.hold(simulation.parameters.max_held_bodies)


def test_a_cane_that_is_tied_back_on_itself_sleeps_where_it_stays():
    """Its tangent stiffness is not positive definite, so the distance from its rest pose is unknown."""
    model = CaneBuilder(length=1.0, radius=0.004, youngs_modulus=5e9, density=800.0, segments=10, shape="slack").build()
    physics = Physics(model)
    physics.handwork.bind(8, 0.05, model.forward_kinematics(model.joint_settled)[2, :3].astype(float), "ada")
    while physics.time < 1.0 or physics.plants.awake.size:
        physics.step()
        assert physics.time < 60.0
    slept = physics.state.body_q[:, :3].copy()
    physics.wake(np.array([0]))
    for _ in range(300):
        physics.step()
    physics.update_kinematics()
    np.testing.assert_allclose(physics.state.body_q[:, :3], slept, atol=1e-4)
