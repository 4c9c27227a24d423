"""Cut canes lie and hang over wires: they pass through none however they come, and wires bear their weight."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.contact_scenes import cane
from tests.support.long_rows import each_once, long
from vinesim.core import frames
from vinesim.scene.builder import assemble
from vinesim.scene.ids import Organ
from vinesim.world import Physics

pytestmark = pytest.mark.slow

RADIUS = 0.0014
"""[m] of a wire."""
G = 9.81


def wires(places: list[tuple[float, float]]) -> dict:
    """Level wires of 2 m along y at (x, z) m, for :func:`assemble`."""
    ends = [np.array([(x, y, z) for x, z in places]) for y in (-1.0, 1.0)]
    return {
        "fixed_start": ends[0],
        "fixed_end": ends[1],
        "fixed_radius": np.full((len(places), 2), RADIUS),
        "fixed_organ": [int(Organ.WIRE)] * len(places),
        "fixed_index": np.arange(len(places)),
    }


class Crossings:
    """How often the axis of a cane has gone through a wire along y: by how often it is wound about the wire, which
    changes otherwise only as far as its two ends turn about it."""

    def __init__(self, physics: Physics, wire: tuple[float, float], first: int = 0) -> None:
        """``wire``: (x, z) m; ``first``: the first body of the cane."""
        self._physics = physics
        self._wire = np.array(wire)
        self._first = first
        self._angle = self._ends()[:2]
        self._turns = self.turns()

    def _ends(self) -> tuple[float, float, float]:
        """Angle of both ends about the wire, and that from the first to the last along the cane [rad]."""
        pose = self._physics.snapshot().body_q[self._first :].astype(float)
        last = pose[-1, :3] + frames.rotate(pose[-1, 3:], np.array([self._physics.model.body_length[-1], 0.0, 0.0]))
        at = np.append(pose[:, :3], last[None], 0)[:, ::2] - self._wire
        angle = np.arctan2(at[:, 1], at[:, 0])
        turned = (np.diff(angle) + np.pi) % (2.0 * np.pi) - np.pi
        return angle[0], angle[-1], turned.sum()

    def turns(self) -> int:
        """To be called after every step: turns about the wire that the motion of the ends does not explain."""
        first, last, along = self._ends()
        self._angle = tuple(np.unwrap([before, now])[1] for before, now in zip(self._angle, (first, last), strict=True))
        return round((along - self._angle[1] + self._angle[0]) / (2.0 * np.pi))

    @property
    def count(self) -> int:
        return abs(self.turns() - self._turns)


def weight(physics: Physics) -> float:
    return G * float(physics.plants.body_mass.sum())


def borne(physics: Physics) -> np.ndarray:
    """Force of the wires on the plants [3] N: a contact's force is that on its other side."""
    return -sum((c.force for c in physics.contacts if c.link.startswith("fixed/")), np.zeros(3))


def force_at_rest(physics: Physics, places: list[tuple[float, float]]) -> np.ndarray:
    """What the wires bear [3] N when the plants fall asleep; nothing passes them until then."""
    crossings = [Crossings(physics, place) for place in places]
    force = np.zeros(3)
    for _ in range(2500):
        physics.step()
        assert [c.count for c in crossings] == [0] * len(places)
        if len(physics.plants.awake) == 0:
            return force
        force = borne(physics)
    raise AssertionError("still awake after 25 s")


def lie_on_wires(places: list[tuple[float, float]]) -> Physics:
    """A cane at a height of 1 m that was cut sleeps on wires at ``places``, which bear its weight within 1 %."""
    physics = Physics(assemble([cane((0.0, 0.0, 1.0))], **wires(places)))
    physics.cut(0)
    force = force_at_rest(physics, places)
    np.testing.assert_allclose(force, [0.0, 0.0, weight(physics)], atol=0.01 * weight(physics))
    return physics


@pytest.mark.parametrize("drop", [0.0, 0.6, *long(0.05, 0.1, 0.2, 0.3)])
def test_a_cut_cane_that_falls_on_wires_lies_on_them_and_sleeps(drop: float) -> None:
    """Falls of up to 3.4 m/s onto two wires: both bear it, together its weight within 1 %, until it sleeps on them."""
    places = [(0.2, 0.99 - drop), (0.8, 0.99 - drop)]
    height = lie_on_wires(places).snapshot().body_q[:, 2]
    assert abs(height - places[0][1]).max() < 0.05


@pytest.mark.parametrize("radius", [0.004, 0.006])
@pytest.mark.parametrize("drop", [1.93, 2.0, *long(1.9, 1.96, 2.03, 2.07, 2.5)])
def test_a_cut_cane_that_falls_two_metres_passes_no_wire(drop: float, radius: float) -> None:
    """At 6 to 7 m/s, at several moments within a step: it lies on both wires after 2 s, and passed none before.

    Of 84 falls on rigid wires 20 passed one, before the root of a cut piece turned as its joints do.
    """
    places = [(0.2, 1.49), (0.8, 1.49)]
    physics = Physics(assemble([cane((0.0, 0.0, 1.5 + drop), radius=radius)], **wires(places)))
    physics.cut(0)
    crossings = [Crossings(physics, place) for place in places]
    for _ in range(200):
        physics.step()
        assert [c.count for c in crossings] == [0, 0]
    assert abs(physics.snapshot().body_q[:, 2] - 1.49).max() < 0.05


@pytest.mark.parametrize("above", [5e-3, 2e-3, 1e-3])
def test_a_cane_that_grew_about_a_wire_hangs_on_it_when_it_is_cut(above: float) -> None:
    """Drawn with its axis just above those of two wires, to which it is not tied: they bear it all the same."""
    lie_on_wires([(0.2, 1.0 - above), (0.8, 1.0 - above)])


def test_what_was_cut_off_above_its_tie_bears_on_the_wire() -> None:
    """Tied to a wire by the end of its eighth piece and cut behind it: the ninth no longer passes through the wire."""
    place = (0.53, 0.99)
    model = assemble(
        [cane((0.0, 0.0, 1.0))],
        tie_body=[7],
        tie_point=[[0.0625, 0.0, 0.0]],
        tie_anchor=[[0.5, 0.0, 1.0]],
        tie_stiffness=[2000.0],
        tie_damping=[20.0],
        tie_wire=[0],
        fixed_tension=[900.0],
        **wires([place]),
    )
    physics = Physics(model)
    physics.cut(8)
    crossings = Crossings(physics, place, first=8)
    touched = set()
    for _ in range(60):
        physics.step()
        assert crossings.count == 0
        touched |= {c.body for c in physics.contacts if c.link == "fixed/0"}
    assert touched == {8}


@pytest.mark.parametrize(
    ("direction", "held"), each_once([(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.7, 0.0, -0.7)], [0, 15])
)
def test_a_cut_cane_that_a_hand_drags_over_a_wire_does_not_pass_it(direction: tuple, held: int) -> None:
    """By one end, at 1 m/s, with the spring of a hand (100 N/m, at most 100 N): sideways, downward, slanting."""
    place = (0.5, 0.97)
    physics = Physics(assemble([cane((0.0, 0.0, 1.0))], **wires([place])))
    physics.cut(0)
    plants = physics.plants
    crossings = Crossings(physics, place)
    tie = plants.add_tie(held, np.zeros(3), 100.0, 10.0)
    start = plants.tie_anchor[tie].copy()
    for step in range(120):
        plants.tie_anchor[tie] = start + physics.dt * step * np.array(direction)
        plants.wake(np.array([0]))
        physics.step()
        assert crossings.count == 0
