"""Cut canes that hang from ties: they lose energy only, and come to rest."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.long_rows import each_once
from vinesim.api.energy import energy
from vinesim.api.simulation import Simulation
from vinesim.core import frames
from vinesim.plants import ties
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.state import State
from vinesim.world import Physics

pytestmark = pytest.mark.slow

G = 9.81


def tied_piece(pieces: int, tied: tuple[int, ...], stiffness: float = 2000.0) -> Model:
    """A level piece of cane of 15 cm, tied where each of the bodies ``tied`` begins; damping of the ties 10 ms."""
    tree = TreeBuilder(frames.pose(np.array([0.0, 0.0, 2.0])))
    tree.add_rod(-1, 0.15, (0.004, 0.004), RodMaterial(3e9, 900.0, 0.008), pieces)
    return assemble(
        [tree],
        tie_body=np.array(tied),
        tie_point=np.zeros((len(tied), 3)),
        tie_anchor=np.array([[0.15 * body / pieces, 0.0, 2.0] for body in tied]),
        tie_stiffness=np.full(len(tied), stiffness),
        tie_damping=np.full(len(tied), 0.01 * stiffness),
    )


@pytest.mark.parametrize(
    ("where", "stiffness", "spin", "grip"),
    each_once(
        [(1, (0,)), (3, (0,)), (3, (1,)), (3, (2,)), (3, (0, 1))],
        [20.0, 2000.0],
        [(0.0, 0.0, 0.0), (1.0, 2.0, 1.0)],
        [True, False],
    ),
)
def test_what_hangs_from_a_tie_gains_no_energy(
    where: tuple[int, tuple[int, ...]], stiffness: float, spin: tuple, grip: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cut off level, it swings down: in 20 s, without air and whether or not the tie resists that it turns, its energy
    never is above that at the start by 1 % of the largest kinetic one, and ends below it. Before, one stiff
    piece tied by its end gained 150 times the kinetic energy of its swing."""
    if not grip:
        monkeypatch.setattr(ties, "TURNING_TIME", 0.0)
    model = tied_piece(*where, stiffness)
    plants = ArticulationSolver(model, State.at_rest(model))
    plants.body_drag[:] = 0.0
    plants.cut(0)
    plants.state.joint_qd[0] = spin
    plants.forward_kinematics()
    start = energy(plants, G)
    most = start.total
    kinetic = start.kinetic
    for _ in range(200):
        for _ in range(10):
            plants.predict()
            plants.integrate()
        plants.forward_kinematics()
        now = energy(plants, G)
        most = max(most, now.total)
        kinetic = max(kinetic, now.kinetic)
    assert most < start.total + 0.01 * kinetic + 1e-6
    assert now.total < start.total


@pytest.mark.parametrize(("pieces", "tied"), [(1, (0,)), (3, (1,)), (3, (0, 2))])
def test_what_hangs_from_a_tie_falls_asleep(pieces: int, tied: tuple[int, ...]) -> None:
    """Within 30 s of the cut."""
    physics = Physics(tied_piece(pieces, tied))
    physics.cut(0)
    for _ in range(3000):
        physics.step()
        if len(physics.plants.awake) == 0:
            return
    raise AssertionError("still awake after 30 s")


@pytest.mark.long
def test_cut_shoots_of_the_demo_that_hang_from_ties_calm_down() -> None:
    """64 of its shoots are cut at a random joint: 30 s later nothing that hangs turns faster than ``sleep_rate``, and
    three in five of what hangs are asleep."""
    physics = Simulation("demo").physics
    model = physics.model
    plants = physics.plants
    rng = np.random.default_rng(0)
    for tree in rng.permutation(len(model.tree_first))[:64]:
        bodies = model.tree_first[tree] + np.arange(int(model.tree_core[tree]))
        physics.cut(int(rng.choice(bodies[model.body_organ[bodies] == int(Organ.CANE)])))
    hanging = np.unique(model.body_tree[model.tie_body[plants._root[model.tie_body] >= 0]])
    assert len(hanging) > 40
    for _ in range(3000):
        physics.step()
    assert plants.tree_rate[hanging].max() < physics.parameters.sleep_rate
    assert (~plants.state.tree_awake[hanging]).mean() > 0.6
