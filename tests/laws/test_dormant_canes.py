"""Dormant canes swing as beams of lignified wood, and a touch at a bud is the force on that bud."""

import numpy as np
import pytest
from scipy.linalg import eigh

from tests.support.beam_theory import fitted_swing
from vinesim.api.simulation import Simulation
from vinesim.core import frames
from vinesim.scene import spec as scenes
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.season import load_season

pytestmark = pytest.mark.slow

G = 9.81
BACK = np.array([0.0, 0.03, 0.0])
"""[m] Way back from the cane to where the ball starts."""


def beam_frequency(length: float, base: float, tip: float, modulus: float, density: float, rise: float) -> float:
    """First frequency [Hz] of a clamped, tapered beam under its own weight, by finite elements (cubic shape functions).
    ``rise``: sine of its angle above the horizon; weight along the axis softens a standing beam."""
    count = 40
    h = length / count
    stiff, mass = np.zeros((2, 2 * count + 2, 2 * count + 2))
    points, weights = np.polynomial.legendre.leggauss(5)
    for e in range(count):
        at = slice(2 * e, 2 * e + 4)
        for point, weight in zip(points, weights, strict=True):
            x = 0.5 * (point + 1.0)
            s = (e + x) * h
            r = base + (tip - base) * s / length
            beyond, _ = np.polynomial.legendre.leggauss(8)
            far = s + 0.5 * (beyond + 1.0) * (length - s)
            radius = base + (tip - base) * far / length
            w = np.polynomial.legendre.leggauss(8)[1] * 0.5 * (length - s)
            pressed = rise * G * density * np.pi * (w * radius**2).sum()
            shape = [1 - 3 * x**2 + 2 * x**3, h * (x - 2 * x**2 + x**3), 3 * x**2 - 2 * x**3, h * (x**3 - x**2)]
            slope = [(-6 * x + 6 * x**2) / h, 1 - 4 * x + 3 * x**2, (6 * x - 6 * x**2) / h, 3 * x**2 - 2 * x]
            curve = [(-6 + 12 * x) / h**2, (-4 + 6 * x) / h, (6 - 12 * x) / h**2, (6 * x - 2) / h]
            area = 0.5 * h * weight
            stiff[at, at] += area * modulus * np.pi / 4.0 * r**4 * np.outer(curve, curve)
            stiff[at, at] -= area * pressed * np.outer(slope, slope)
            mass[at, at] += area * density * np.pi * r**2 * np.outer(shape, shape)
    square = eigh(stiff[2:, 2:], mass[2:, 2:], eigvals_only=True)[0]
    return float(np.sqrt(square)) / (2.0 * np.pi)


def without_ties(model: Model) -> Model:
    free = model.copy()
    for name in model.array_fields():
        if name.startswith("tie_"):
            setattr(free, name, getattr(model, name)[:0])
    return free


@pytest.fixture(scope="module")
def spurs() -> Model:
    return generate(scenes.load_scene("winter_spur"))


def test_an_untied_cane_swings_as_a_tapered_beam(spurs: Model) -> None:
    """Within 4 %: the theory has a straight cane on a clamp; here it is crooked and stands on two-year wood."""
    dormant = load_season().dormant
    canes = spurs.canes
    borne = np.bincount(canes.parent[canes.year == 1], minlength=len(canes.body))
    lone = np.flatnonzero((canes.year == 1) & (borne[canes.parent] == 1))[:3]
    for cane in lone.tolist():
        simulation = Simulation(without_ties(spurs), dt=0.002)
        body = int(canes.body[cane] + canes.size[cane] - 1)
        foot = simulation.body_pose(int(canes.body[cane]))[:3]
        tip = _tip(simulation, body)
        along = (tip - foot) / np.linalg.norm(tip - foot)
        for _ in range(150):
            simulation.apply_wrench(body, (0.0, 0.15, 0.0), at=_tip(simulation, body))
            simulation.step()
        simulation.step(50)
        swing = []
        for _ in range(1000):
            simulation.step()
            swing.append(_tip(simulation, body)[1])
        base, end = (float(spurs.body_radius[b, k]) for b, k in ((int(canes.body[cane]), 0), (body, 1)))
        length = float(canes.length[cane])
        wanted = beam_frequency(length, base, end, dormant.modulus.value, dormant.density.value, float(along[2]))
        found, damping = fitted_swing(0.002 * np.arange(1000), np.array(swing), wanted)
        assert found == pytest.approx(wanted, rel=0.04)
        print(f"{wanted:.3f} Hz by theory, {found:.3f} Hz simulated, damping ratio {damping:.3f}")
        own = np.pi * wanted * dormant.damping.value
        numerical = np.pi * wanted * simulation.dt  # of a step of first order
        assert 0.9 * own < damping < 1.1 * (own + numerical)


def _tip(simulation: Simulation, body: int) -> np.ndarray:
    pose = simulation.body_pose(body).astype(float)
    return pose[:3] + frames.rotate(pose[3:], np.array([float(simulation.model.body_length[body]), 0.0, 0.0]))


def test_a_dormant_vineyard_stays_as_it_is_drawn() -> None:
    for name in ("winter_spur", "winter_cane"):
        simulation = Simulation(name)
        before = simulation.state.body_q[:, :3].astype(float)
        simulation.wake()
        simulation.step(50)
        simulation.physics.update_kinematics()
        moved = np.linalg.norm(simulation.state.body_q[:, :3] - before, axis=1)
        assert moved.max() < 3e-4
        assert simulation.faults == {}


def test_a_push_at_a_bud_is_the_force_on_that_bud(spurs: Model) -> None:
    """A ball that presses a bud's place is a force on this bud alone; half an internode away, on none."""
    nodes = spurs.nodes
    canes = spurs.canes
    cane = int(np.flatnonzero(canes.year == 1)[7])
    mine = np.flatnonzero(nodes.cane == cane)
    node = int(mine[4])
    pose = nodes.bud_poses(generate_rest(spurs))[nodes.bud[node]]
    bud_middle = pose[:3] + frames.rotate(pose[3:], np.array([0.5 * float(nodes.bud_length[node]), 0.0, 0.0]))
    q = generate_rest(spurs)[nodes.body[node]]
    axis = frames.rotate(q[3:], np.array([1.0, 0.0, 0.0]))
    on_axis = q[:3] + axis * ((bud_middle - q[:3]) * axis).sum()
    half_way = 0.5 * (nodes.positions(generate_rest(spurs))[mine[4]] + nodes.positions(generate_rest(spurs))[mine[5]])
    for place, touched in ((on_axis, {int(nodes.bud[node])}), (half_way, set())):
        simulation = Simulation(spurs)
        ball = simulation.add_pusher(shape="sphere", size=(0.004,), position=place - BACK, force=20.0)
        ball.follow([place - BACK, place - 0.13 * BACK], speed=0.1)
        most = np.zeros(len(simulation.bud_forces))
        pushed = 0.0
        for _ in range(60):
            simulation.step()
            forces = simulation.bud_forces
            mine_now = [c for c in simulation.contacts if c.actor == ball.name]
            total = sum(float(np.linalg.norm(c.force)) for c in mine_now)
            pushed = max(pushed, total)
            assert forces.sum() == pytest.approx(total if touched else 0.0)
            most = np.maximum(most, forces)
        assert pushed > 0.05
        assert set(np.flatnonzero(most > 0.0).tolist()) == touched


def generate_rest(model: Model) -> np.ndarray:
    return model.forward_kinematics(model.joint_settled)
