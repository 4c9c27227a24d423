"""Predictions of eight trees at once: the bits of a tree alone, whichever trees share its vector."""

import numpy as np
import pytest

from vinesim.core import frames
from vinesim.plants.articulation_solver import ArticulationSolver, Topologies, group_starts
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.state import State

COUNT = 11


def bush(i: int) -> TreeBuilder:
    """A stem with a branch and a leaf; every number differs from tree to tree."""
    tree = TreeBuilder(frames.pose(np.array([0.0, i, 2.0]), frames.from_yaw(0.3 * i)))
    wood = RodMaterial((2 + i) * 1e9, 800.0, 0.01)
    stem = tree.add_rod(-1, 0.5 + 0.02 * i, (0.004, 0.003), wood, 5)
    turned = frames.exp(np.array([0.0, 0.4 + 0.05 * i, 0.9]))
    branch = tree.add_rod(stem[1], 0.3, (0.003, 0.002), wood, 3, rest=turned)
    tree.add_body(
        branch[-1], offset=(0.1, 0.0, 0.0), organ=int(Organ.LEAF), mass=0.002, com=(0.03, 0.01, 0.0),
        inertia=(1e-6, 2e-6, 3e-6), length=0.06, radius=(0.03, 0.03), damping=(1e-5, 1e-5, 1e-5),
        stiffness=np.full(3, 1e-3),
    )  # fmt: skip
    return tree


@pytest.fixture(scope="module")
def model() -> Model:
    """Bushes, of which every second is tied to a wire and every third has a leaf without drag."""
    tied = np.arange(1, COUNT, 2)
    model = assemble(
        [bush(i) for i in range(COUNT)],
        tie_body=9 * tied + 3,
        tie_point=np.full((len(tied), 3), 0.01),
        tie_anchor=np.tile([0.4, 1.0, 2.1], (len(tied), 1)),
        tie_stiffness=50.0 * tied,
        tie_damping=np.full(len(tied), 0.5),
    )
    model.body_drag[8::9] = 0.002 * (np.arange(COUNT) % 3)
    return model


def run(model: Model, trees: np.ndarray, steps: int = 12) -> dict[int, list[bytes]]:
    """Steps of some trees, pushed in between: what each of them went through."""
    plants = ArticulationSolver(model, State.at_rest(model))
    plants.wake(trees)
    rng = np.random.default_rng(4)
    plants.state.joint_qd[:] = rng.normal(scale=2.0, size=plants.state.joint_qd.shape)
    plants.body_load[:, :3] = rng.normal(scale=0.1, size=(len(model.body_mass), 3))
    plants.tree_air[:] = rng.normal(scale=3.0, size=(COUNT, 3))
    plants.root_rests.turn[:], plants.root_rests.rate[:] = rng.normal(scale=[[[0.1]], [[1.0]]], size=(2, COUNT, 3))
    plants.phi[:] = np.resize([0.55, 0.6, 1.0, 0.55], COUNT)
    seen: dict[int, list[bytes]] = {int(tree): [] for tree in trees}
    for tick in range(steps):
        plants.predict()
        bodies = model.tree_first[trees] + 4
        response = plants.impulse_response(bodies)
        if tick in (3, 4):
            plants.integrate(bodies, np.tile([0.1, -0.2, 0.3, 0.0, 0.01, 0.0], (len(bodies), 1)))
        else:
            plants.integrate()
        for k, tree in enumerate(trees):
            of_tree = model.bodies_of(int(tree))
            arrays = (plants.state.body_q, plants.state.joint_q, plants.velocity_free, plants.acceleration)
            seen[int(tree)] += [x[of_tree].tobytes() for x in arrays] + [response[k, :, k].tobytes()]
    return seen


def test_a_tree_gets_the_bits_that_it_gets_alone(model: Model) -> None:
    """All share vectors of eight and three lanes, some of two and one: a tree cannot tell."""
    alone = {tree: run(model, np.array([tree]))[tree] for tree in range(COUNT)}
    assert len({tuple(x) for x in alone.values()}) == COUNT
    for company in (np.arange(COUNT), np.array([2, 7]), np.array([1, 3, 4, 9, 10])):
        for tree, seen in run(model, company).items():
            assert seen == alone[tree], f"tree {tree} in company of {company.tolist()}"


def test_a_faulty_tree_spoils_no_other_in_its_vector(model: Model) -> None:
    """NaN in one lane stays in it."""
    plants, sound = (ArticulationSolver(model, State.at_rest(model)) for _ in range(2))
    for solver in (plants, sound):
        solver.wake(np.arange(COUNT))
    plants.state.joint_qd[model.tree_first[4]] = np.nan
    for solver in (plants, sound):
        solver.predict()
    others = model.body_tree != 4
    assert np.isnan(plants.velocity_free[~others]).any()
    np.testing.assert_array_equal(plants.velocity_free[others], sound.velocity_free[others])


def test_topologies_tell_apart_what_walks_differently() -> None:
    """Equal parents are one topology, whatever else differs; a tree with something cut off shares it with none."""
    long = bush(0)
    long.add_rod(2, 0.1, (0.002, 0.002), RodMaterial(1e9, 800.0, 0.01), 1)
    model = assemble([bush(1), bush(2), long, bush(3)])
    state = State.at_rest(model)
    topologies = Topologies(model, state.body_cut, model.tree_size.copy())
    a, b, c, d = topologies.of(np.arange(4))
    assert a == b == d != c
    state.body_cut[model.tree_first[1] + 2] = True
    a, b, c, d = topologies.of(np.arange(4))
    assert a == d
    assert len({a, b, c}) == 3


def test_groups_hold_up_to_eight_neighbours_of_one_topology() -> None:
    """None holds trees of whole steps and of substeps."""
    topologies = np.array([5] * 19 + [6] * 3 + [5] * 2)
    assert group_starts(topologies, 24).tolist() == [0, 8, 16, 19, 22, 24]
    assert group_starts(topologies, 10).tolist() == [0, 8, 10, 18, 19, 22, 24]
    assert group_starts(topologies[:0], 0).tolist() == [0]
