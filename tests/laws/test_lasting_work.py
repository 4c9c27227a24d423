"""Work on plants that lasts: notches weaken in proportion, stumps keep their sets, leaves leave exactly."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from vinesim import Simulation
from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.interaction.cutting_force import remaining_strength
from vinesim.scene import spec as scenes
from vinesim.scene.cane import CaneBuilder, assemble
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.spare_bodies import with_spares
from vinesim.scene.surroundings import Wire


def cane(**numbers) -> Model:
    """A level cane of 0.3 m and 10 mm in 12 segments that cracks at 80 MPa, with two spare bodies."""
    given = {"length": 0.3, "radius": 0.005, "youngs_modulus": 5.9e9, "strength": 80e6, "segments": 12}
    return with_spares(assemble([CaneBuilder(density=900.0, damping_ratio=0.3, **(given | numbers))]))


def breaking_moment(depth: float, segment: int, share: float) -> tuple[float, Simulation]:
    """Bend a brittle cane by a moment at its tip that grows until it parts, in about two seconds. Returns the moment
    [N m]."""
    simulation = Simulation(cane(toughness=1.0), parameters=PhysicsParameters(gravity=0.0, sleep=False))
    if depth > 0.0:
        at = share * float(simulation.model.body_length[segment])
        assert simulation.physics.detachment_monitor.notch(segment, at, depth)
    rate = 4.0 * remaining_strength(depth)[1]
    for _ in range(400):
        moment = rate * simulation.time
        simulation.apply_wrench(11, (0.0, 0.0, 0.0), torque=(0.0, moment, 0.0))
        simulation.step()
        if simulation.detachments:
            return moment, simulation
    pytest.fail("the cane did not break")


def test_a_notch_weakens_a_cane_by_the_section_modulus_that_it_leaves():
    whole, _ = breaking_moment(0.0, 0, 0.0)
    assert whole == pytest.approx(80e6 * 0.25 * np.pi * 0.005**3, rel=0.05)
    for depth in (0.2, 0.5, 0.8):
        weak, simulation = breaking_moment(depth, 6, 0.3)
        assert weak / whole == pytest.approx(remaining_strength(depth)[1], rel=0.05)
        (parted,) = simulation.detachments
        assert (parted.segment, parted.at) == (6, pytest.approx(0.3 * 0.025, abs=6e-4))  # it parts at the notch


def test_a_notch_near_the_tip_of_a_segment_weakens_the_next_joint():
    simulation = Simulation(cane())
    monitor = simulation.physics.detachment_monitor
    before = monitor.wood.law.breaks[:12].copy()
    monitor.notch(4, 0.02, 0.5)
    weaker = monitor.wood.law.breaks[:12] / before
    assert weaker[5] == pytest.approx(remaining_strength(0.5)[1])
    np.testing.assert_array_equal(np.delete(weaker, 5), 1.0)
    assert not monitor.notch(4, 0.003, 0.4), "a segment has one notch, the deepest"
    monitor.notch(4, 0.003, 0.6)
    weaker = monitor.wood.law.breaks[:12] / before
    assert weaker[4] == pytest.approx(remaining_strength(0.6)[1])
    assert weaker[5] == 1.0
    simulation.cut(4, 0.003)  # through the notch
    np.testing.assert_array_equal(monitor.wood.law.breaks[:12], before)


def test_a_stump_keeps_the_set_of_its_joint():
    model = cane(yield_strength=40e6, toughness=1e6)
    simulation = Simulation(model, parameters=PhysicsParameters(gravity=0.0))
    for _ in range(400):
        force = min(8.0 * simulation.time, 16.0)
        simulation.apply_wrench(11, (0.0, 0.0, -force))
        simulation.step()
    simulation.step(400)
    state = simulation.state
    kept, flow = state.joint_set[0].copy(), float(state.joint_flow[0])
    assert flow > 3e-3
    before = simulation.body_pose(0).astype(float)
    simulation.cut(0, 0.015)
    (stump,) = simulation.physics.plants.stumps.table[:, 0].astype(int)
    np.testing.assert_array_equal(state.joint_set[stump], kept)
    assert state.joint_flow[stump] == np.float32(flow)
    assert state.joint_flow[0] == 0.0
    simulation.step(300)
    after = simulation.body_pose(int(stump)).astype(float)
    assert np.linalg.norm(frames.log(frames.multiply(frames.conjugate(before[3:]), after[3:]))) < 2e-3


@pytest.fixture(scope="module")
def summer() -> Model:
    scene = scenes.load_scene("vsp")
    return generate(msgspec.structs.replace(scene, layout=msgspec.structs.replace(scene.layout, rows=1, vines=1)))


def test_leaves_that_are_taken_off_leave_with_their_mass_moments_and_area(summer: Model):
    simulation = Simulation(summer)
    plants = simulation.physics.plants
    segment = int(np.argmax(np.bincount(summer.leaf_body)))
    leaves = np.flatnonzero(summer.leaf_body == segment)
    assert simulation.take_leaves(segment) == len(leaves) >= 1
    assert simulation.take_leaves(segment) == 0
    mass, at = summer.leaf_mass[leaves].astype(float), summer.leaf_pose[leaves, :3].astype(float)
    left = float(summer.body_mass[segment]) - mass.sum()
    assert plants.body_mass[segment] == pytest.approx(left, rel=1e-5)
    first = summer.body_mass[segment] * summer.body_com[segment].astype(float) - mass @ at
    np.testing.assert_allclose(left * plants.body_com[segment], first, atol=1e-7)
    bare = float(summer.body_drag[segment] - summer.leaf_drag[leaves].sum())
    assert plants.body_drag[segment] == pytest.approx(max(bare, 0.0), abs=1e-8)
    assert (plants.body_inertia[segment] > 0.0).all()
    assert simulation.state.leaf_off.sum() == len(leaves)
    (event,) = [one for one in simulation_events(simulation) if one.kind == "leaves"]
    assert (event.body, event.cause) == (segment, "command")
    simulation.step(100)
    assert simulation.faults == {}


def simulation_events(simulation: Simulation) -> list:
    simulation.step()
    return list(simulation.breakages)


def test_a_part_of_a_cut_shoot_loses_only_its_own_leaves(summer: Model):
    simulation = Simulation(summer)
    plants = simulation.physics.plants
    counts = np.bincount(summer.leaf_body, minlength=len(summer.body_mass))
    segment = int(np.argmax(counts))
    base = summer.leaf_base[summer.leaf_body == segment, 0]
    at = 0.5 * float(summer.body_length[segment])
    simulation.cut(segment, at)
    end = float(plants.stumps.table[0, 2])
    stump = int(plants.stumps.table[0, 0])
    before = plants.body_mass[[segment, stump]].copy()
    assert simulation.take_leaves(stump) == (base < end).sum()
    assert plants.body_mass[segment] == before[0]
    assert simulation.take_leaves(segment) == (base >= end).sum()
    gone = summer.leaf_mass[summer.leaf_body == segment].sum()
    assert before.sum() - plants.body_mass[[segment, stump]].sum() == pytest.approx(gone, rel=1e-4, abs=1e-9)


def test_a_tied_shoot_rests_beside_the_wire_and_its_tree_sleeps():
    wire = Wire((0.17, 0.5, 1.03), (0.17, -0.5, 1.03))
    shoot = CaneBuilder(length=0.3, radius=0.002, segments=8, damping_ratio=0.3)
    simulation = Simulation(assemble([shoot], wires=[wire]))
    tie = simulation.tie(4)
    simulation.step(600)
    assert tie.is_done
    assert tie.is_held
    assert np.linalg.norm(tie.position - tie.target) < 5e-3
    assert not simulation.state.tree_awake.any()
    tie.release()
    assert not tie.is_held
    assert not tie.force.any()
    with pytest.raises(UsageError, match=r"leaves from 0\.2 to 0\.1 m"):
        simulation.take_leaves(3, 0.2, 0.1)
    with pytest.raises(UsageError, match=r"body 3 has wood from 0 to 0\.\d+ m, not at 1 m"):
        simulation.tie(3, 1.0, (0.0, 0.0, 1.0))


def test_an_actor_works_on_the_wood_at_its_tool(summer: Model):
    physics = Simulation(summer).physics
    handwork = physics.handwork
    tie = int(np.argmax(np.isin(summer.tie_body, summer.leaf_body)))
    body = int(summer.tie_body[tie])
    pose = physics.state.body_q[body].astype(float)
    at = pose[:3] + frames.rotate(pose[3:], summer.tie_point[tie].astype(float))
    assert handwork.work_at("untie", at, "ada").startswith("opens tie ")
    assert physics.state.tie_broken.sum() == 1
    assert "to the nearest wire" in handwork.work_at("tie", at, "ada")
    (bound,) = handwork.ties.values()
    assert handwork.touched == ((int(summer.body_tree[bound.segment]), "ada"),)
    said = handwork.work_at("take_leaves", at, "ada")
    assert said.startswith(f"takes {physics.state.leaf_off.sum()} leaves off body ")
    for what, reason in (
        ("shake", "no work on plants 'shake'; give one of tie, untie, take_leaves"),
        ("tie", r"no cane within 100 mm of the tool; the nearest is \d+ mm away; move the tool there"),
        ("untie", "no tie within 100 mm of the tool"),
    ):
        with pytest.raises(ValueError, match=reason):
            handwork.work_at(what, np.array([0.0, 0.0, 50.0]), "ada")
