"""Misuse of the physics ends in one line at the call, or is counted where it can only happen within a step."""

from __future__ import annotations

import logging
import pathlib
from collections.abc import Callable

import numpy as np
import pytest

from tests.physics.test_hand_grasp import human_at_bunch, move
from tests.physics.test_human_body import eva
from tests.physics.test_rigid_world import HOME, arm
from tests.support.contact_scenes import cane
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.rollout import Rollout
from vinesim.plants.ties import TieLimitError
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene.builder import assemble
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import ParameterError, PhysicsParameters
from vinesim.scene.state import State
from vinesim.world import Physics

NAN = float("nan")
INF = float("inf")


def one_cane() -> Model:
    return assemble([cane((0.0, 0.0, 2.0))])


@pytest.mark.parametrize("build", [State.at_rest, Physics])
@pytest.mark.parametrize(("body", "parent"), [(2, 5), (2, 2)])
def test_a_parent_cycle_is_refused(build: Callable[[Model], object], body: int, parent: int) -> None:
    model = one_cane()
    model.body_parent[body] = parent
    with pytest.raises(ValueError, match=f"body {body} of tree 0: parent {parent}; a parent stands before"):
        build(model)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda model: ArticulationSolver(model, State.at_rest(model), dt=INF), "dt inf s, phi 0.55: need a finite dt"),
        (lambda model: Rollout(model, 2, dt=INF), "2 ticks of inf s, .* a finite dt above 0"),
        (lambda _: PhysicsParameters(dt=INF), "physics.dt is inf; give a finite number"),
        (lambda _: PhysicsParameters(contact_capacity=10001), "contact_capacity is 10001; give a number of 1024 or l"),
        (lambda _: PhysicsParameters(max_held_bodies=10**9), "max_held_bodies is 1000000000; give a number of 1024 or"),
    ],
)
def test_numbers_without_use_are_refused(call: Callable[[Model], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(one_cane())
    assert issubclass(ParameterError, ValueError)


def test_a_negative_radius_is_refused() -> None:
    model = one_cane()
    model.body_radius[3, 1] = -0.01
    with pytest.raises(ValueError, match=r"body 3 of tree 0: radius \[m\] .*; give radii of 0 or more"):
        Physics(model)


@pytest.mark.parametrize("part", ["", "plants", "rigid"])
def test_dt_is_fixed_from_the_start(part: str) -> None:
    physics = Physics(one_cane())
    owner = getattr(physics, part) if part else physics
    with pytest.raises(AttributeError, match=r"property 'dt' of .* has no setter"):
        owner.dt = 0.001
    assert physics.dt == physics.plants.dt == physics.rigid.dt == 0.01


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda physics: physics.wake(np.array([0, 5])), "tree 5 does not exist; give 0 to 0"),
        (lambda physics: physics.wake(-1), "tree -1 does not exist"),
        (lambda physics: physics.wake(0.5), "tree 0.5 does not exist"),
        (lambda physics: physics.plants.wake(5), "tree 5 does not exist"),
        (lambda physics: physics.plants.put_to_sleep(5), "tree 5 does not exist; give 0 to 0"),
        (lambda physics: physics.plants.put_to_sleep(-1), "tree -1 does not exist"),
        (lambda physics: physics.plants.refine(5), "tree 5 does not exist; give 0 to 0"),
        (lambda physics: physics.plants.coarsen(np.array([0, 7])), "tree 7 does not exist"),
        (lambda physics: physics.cut(2.7), "body 2.7 does not exist; give 0 to 15, a whole number"),
        (lambda physics: physics.cut(16), "body 16 does not exist"),
        (lambda physics: physics.plants.cut(2.7), "body 2.7 does not exist"),
        (lambda physics: physics.plants.add_tie(2.7, np.zeros(3), 1.0, 0.0), "body 2.7 does not exist"),
        (lambda physics: physics.plants.add_tie(2, np.zeros(3), INF, 0.0), "tie of body 2 at .*, stiffness inf N/m"),
        (lambda physics: physics.plants.set_mass(2, INF), "body 2: mass inf kg"),
        (lambda physics: physics.pick(0), "bunch 0 does not exist; there is none"),
    ],
)
def test_numbers_that_name_nothing_are_refused(call: Callable[[Physics], object], message: str) -> None:
    physics = Physics(one_cane())
    with pytest.raises(ValueError, match=message) as error:
        call(physics)
    assert "\n" not in str(error.value)
    assert len(physics.plants.awake) == 0
    assert not physics.state.body_cut.any()


def test_a_world_without_plants_steps() -> None:
    physics = Physics(assemble([]))
    physics.add_human(eva(0.0, 0.0, 0.0))
    for _ in range(3):
        physics.step()
    assert physics.time == pytest.approx(0.03)
    assert len(physics.snapshot().body_q) == 0
    assert np.isfinite(physics.snapshot().visual_q).all()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda rigid: rigid.command("anna", np.full(len(HOME), NAN)), "joint position is .*; give finite numbers"),
        (lambda rigid: rigid.command("anna", HOME, np.full(len(HOME), INF)), "joint velocity is .*; give finite"),
        (lambda rigid: rigid.command("anna", np.zeros(99)), r"joint position has the shape \(99,\); give "),
        (lambda rigid: rigid.command_base("anna", (NAN, 0.0, 0.0)), "base velocity is .*; give finite numbers"),
        (lambda rigid: rigid.apply_wrench("anna", "chassis", np.full(3, NAN)), "force is .*; give finite numbers"),
        (lambda rigid: rigid.place_robot("anna", np.full(7, NAN), HOME), "pose is .*; give finite numbers"),
        (lambda rigid: rigid.set_gains("anna", *[np.full(len(HOME), NAN)] * 3), "joint stiffness is .*; give finite"),
        (
            lambda rigid: rigid.set_remote_wrenches("anna", {"chassis": np.full(6, NAN)}),
            "wrench on 'chassis' is .*; give",
        ),
    ],
)
def test_commands_that_are_not_finite_are_refused(call: Callable[[RigidWorld], object], message: str) -> None:
    rigid = RigidWorld(assemble([]))
    rigid.add_robot(arm())
    with pytest.raises(ValueError, match=f"robot 'anna': {message}") as error:
        call(rigid)
    assert "\n" not in str(error.value)
    for _ in range(3):
        rigid.predict()
        rigid.integrate()
    assert rigid.faults == 0
    np.testing.assert_allclose(rigid.joint_measurements("anna")[0], HOME, atol=1e-2)


def test_a_grasp_beyond_the_limit_is_counted_and_the_step_goes_on() -> None:
    physics, spec, body, _ = human_at_bunch(parameters=PhysicsParameters(max_held_bodies=1))
    physics.plants.add_tie(0, np.zeros(3), 1.0, 0.0)
    with pytest.raises(TieLimitError, match=f"body {body} is one too many: 1 are held already"):
        physics.plants.add_tie(body, np.zeros(3), 1.0, 0.0)
    move(physics, spec, 0.0, 0.03, 0.0, ticks=20, wait=30, closed=True)
    assert physics.faults["grasps_refused"] == 1
    assert len(physics.grasp_manager.held_trees) == 0
    assert np.isfinite(physics.snapshot().body_q).all()


@pytest.mark.parametrize(("phi", "share", "warnings"), [(0.55, 0.0, 1), (0.55, 0.9, 1), (0.55, 1.0, 0), (0.5, 0.0, 0)])
def test_less_damping_than_a_step_has_is_reported_once(
    phi: float, share: float, warnings: int, caplog: pytest.LogCaptureFixture
) -> None:
    model = one_cane()
    model.joint_damping[3:5] = share * (2.0 * phi - 1.0) * 0.01 * model.joint_stiffness[3:5]
    model.joint_damping[5:] = model.joint_stiffness[5:]
    model.joint_damping[:3] = model.joint_stiffness[:3]
    with caplog.at_level(logging.WARNING):
        Physics(model, parameters=PhysicsParameters(phi=phi))
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == warnings
    assert all(text.startswith("2 of 16 joints move with more damping than the model gives them: ") for text in said)


def test_warnings_of_mujoco_go_to_the_log_and_not_to_a_file(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    rigid = RigidWorld(assemble([]))
    rigid.add_robot(arm())
    rigid.mj_data.qvel[:] = NAN
    with caplog.at_level(logging.WARNING):
        rigid.predict()
        rigid.integrate()
    assert rigid.faults
    assert "QVEL" in caplog.text
    assert list(tmp_path.iterdir()) == []
