"""The tree builder: mass and stiffness of rods, and springs whose rest pose is the drawn shape."""

import numpy as np
import pytest

from tests.support import beam_theory
from vinesim.core import frames
from vinesim.scene import builder
from vinesim.scene.ids import Organ

CANE = builder.RodMaterial(modulus=5e9, density=800.0, damping=0.01)
POSE = np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0])


def beam(pieces=16, load=0.0, length=1.0, radius=0.004):
    tree = builder.TreeBuilder(POSE)
    tip = tree.add_rod(-1, length, (radius, radius), CANE, pieces)[-1]
    if load:
        small = {"mass": load, "inertia": (1e-6,) * 3, "stiffness": (5.0, 5.0, 5.0), "damping": (0.0,) * 3}
        tree.add_body(tip, offset=(length / pieces, 0, 0), organ=int(Organ.BUNCH), **small)
    return tree


def test_mass_of_a_rod_is_that_of_its_wood():
    tree = builder.TreeBuilder(POSE)
    tree.add_rod(-1, 1.2, (0.005, 0.002), CANE, 9)
    cone = np.pi * 1.2 * (0.005**2 + 0.005 * 0.002 + 0.002**2) / 3.0
    assert sum(b["mass"] for b in tree.bodies) == pytest.approx(800.0 * cone, rel=1e-12)


def test_springs_are_ei_over_h_and_twice_that_at_the_root():
    model = builder.assemble([beam()])
    ei_over_h = 5e9 * np.pi * 0.004**4 / 4.0 * 16
    assert model.joint_stiffness[0, 1] == pytest.approx(2.0 * ei_over_h, rel=1e-6)
    assert model.joint_stiffness[1:, 1:] == pytest.approx(ei_over_h, rel=1e-6)
    assert model.joint_stiffness[1:, 0] == pytest.approx(ei_over_h / 1.3, rel=1e-6)  # GJ, Poisson 0.3
    assert model.joint_damping == pytest.approx(0.01 * model.joint_stiffness, rel=1e-6)


def test_a_joint_between_different_pieces_is_two_halves_in_series():
    """Springs of the halves in series, and each wood's damping in its share of the bend."""
    tree = builder.TreeBuilder(POSE)
    below = tree.add_rod(-1, 0.5, (0.006, 0.005), CANE, 5)[-1]
    green = builder.RodMaterial(modulus=1e9, density=900.0, damping=0.05)
    on = tree.add_rod(below, 0.4, (0.004, 0.002), green, 8)[0]
    upper, lower = (2.0 * e * np.pi * r**4 / 4.0 / h for e, r, h in ((1e9, 0.004, 0.05), (5e9, 0.005, 0.1)))
    stiffness, damping = (tree.bodies[on][name] for name in ("stiffness", "damping"))
    assert stiffness[1:] == pytest.approx(upper * lower / (upper + lower), rel=1e-12)
    assert stiffness[0] == pytest.approx(stiffness[1] / 1.3, rel=1e-12)
    share = stiffness[1] / lower
    assert damping[1] == pytest.approx(stiffness[1] * (0.01 * share + 0.05 * (1.0 - share)), rel=1e-12)


def test_a_fork_bends_with_its_parent():
    """Sideways on an equal piece: at its tip half twist and half bend in series; at its middle or before a clamp."""
    tree = builder.TreeBuilder(POSE)
    below = tree.add_rod(-1, 1.0, (0.004, 0.004), CANE, 10)[-1]
    aside = frames.from_yaw(np.pi / 2)
    clamp = 2.0 * 5e9 * np.pi * 0.004**4 / 4.0 / 0.1
    one = clamp / np.array([1.3, 1.0, 1.0])
    tip, half, middle, base = (
        tree.bodies[tree.add_rod(below, 0.5, (0.004, 0.004), CANE, 5, rest=aside, offset=offset)[0]]["stiffness"]
        for offset in (None, (0.075, 0.0, 0.0), (0.05, 0.0, 0.0), (0.0, 0.0, 0.0))
    )
    other = clamp / np.array([1.0, 1.3, 1.0])  # its twist is our bending
    assert tip == pytest.approx(1.0 / (1.0 / one + 1.0 / other), rel=1e-9)
    assert half == pytest.approx(1.0 / (1.0 / one + 0.5 / other), rel=1e-9)
    assert middle == pytest.approx(one, rel=1e-9)
    assert base == pytest.approx(one, rel=1e-9)


def test_inertia_of_a_piece_is_that_of_a_cylinder():
    mass, inertia, *_ = builder.segment_properties(0.1, 0.01, 0.01, 1e9, 1000.0)
    assert inertia == pytest.approx([mass * 0.01**2 / 2, *[mass * (3 * 0.01**2 + 0.1**2) / 12] * 2], rel=1e-12)


def test_solve_rest_pose_keeps_the_drawn_shape_under_load():
    tree = beam(load=0.3)
    tree.bodies[4]["rest"] = frames.exp(np.array([0.1, 0.3, -0.2]))
    drawn = builder.assemble([tree]).forward_kinematics(np.tile(frames.IDENTITY, (17, 1)))
    tree.solve_rest_pose()
    model = builder.assemble([tree])
    assert np.abs(model.forward_kinematics(model.joint_settled) - drawn).max() < 1e-5
    root = beam_theory.spring_torque(model.joint_stiffness[0], frames.log(model.joint_settled[0].astype(float)))
    lever = drawn[:, :3] + frames.rotate(drawn[:, 3:], model.body_com.astype(float)) - POSE[:3]
    moment = np.cross(lever, model.body_mass[:, None] * builder.GRAVITY).sum(0)
    axes = frames.multiply(POSE[3:], model.body_rest[0].astype(float))
    assert frames.rotate(axes, root) == pytest.approx(moment, abs=1e-4)


def test_a_weighted_beam_bends_by_the_angle_of_beam_theory():
    """A beam that is straight under its load is bent without it, by w L^3 / 6 EI + m g L^2 / 2 EI at its tip."""
    load = 0.05
    length = 1.0
    tree = beam(pieces=64, load=load)
    tree.solve_rest_pose()
    model = builder.assemble([tree])
    angle = np.linalg.norm(frames.log(model.joint_settled.astype(float)), axis=1)[:-1].sum()
    ei = 5e9 * np.pi * 0.004**4 / 4.0
    weight = 800.0 * np.pi * 0.004**2 * 9.81
    assert angle == pytest.approx(weight * length**3 / (6.0 * ei) + load * 9.81 * length**2 / (2.0 * ei), rel=2e-3)


def test_rest_poses_of_all_trees_are_those_of_each():
    trees = [beam(pieces=n, load=0.1) for n in (3, 8)]
    all_trees = builder.solve_rest_pose(builder.assemble(trees))
    for number, tree in enumerate(trees):
        tree.solve_rest_pose()
        single = builder.assemble([tree])
        assert np.array_equal(all_trees.joint_settled[all_trees.bodies_of(number)], single.joint_settled)


def test_parents_and_indices_of_a_fork():
    tree = beam(4)
    side = tree.add_rod(1, 0.2, (0.002, 0.001), CANE, 2, rest=frames.from_yaw(0.5))
    model = builder.assemble([beam(2), tree])
    assert model.body_parent.tolist() == [-1, 0, -1, 2, 3, 4, 3, 6]
    assert side == [4, 5]
    assert model.body_offset[6, 0] == pytest.approx(0.25)


def test_invalid_trees_are_refused_with_the_reason():
    with pytest.raises(ValueError, match="all must be positive"):
        builder.TreeBuilder(POSE).add_rod(-1, -1.0, (0.01, 0.01), CANE, 3)
    with pytest.raises(ValueError, match="names parent 3"):
        builder.TreeBuilder(POSE).add_body(3)
    for fields, finding in (
        ({"radius": (0.01, -0.01)}, r"radius is \(0.01, -0.01\); give numbers of 0 or more"),
        ({"mass": 0.0}, "mass is 0.0; give numbers above 0"),
        ({"inertia": (1e-4, float("nan"), 1e-4)}, "inertia is .*; give finite numbers"),
        ({"stiffness": -1.0}, "stiffness is -1.0; give numbers of 0 or more"),
    ):
        with pytest.raises(ValueError, match=f"body 0: {finding}"):
            builder.TreeBuilder(POSE).add_body(-1, **fields)
    with pytest.raises(ValueError, match=r"body 0 has no field 'lenght'; it has: .*length"):
        builder.TreeBuilder(POSE).add_body(-1, lenght=0.1)
    for pose in (np.zeros(7), np.full(7, np.nan), POSE[:3]):
        with pytest.raises(ValueError, match=r"tree: pose is .*; give position"):
            builder.TreeBuilder(pose)
    tree = builder.TreeBuilder(POSE)
    tree.add_rod(-1, 0.1, (0.01, 0.01), CANE, 1)
    for options, finding in (
        ({"parent": -1, "mass": 0.5}, "body -1 does not exist; give 0 to 0"),
        ({"parent": 0, "mass": 0.5, "variety": 99}, "variety 99 does not exist"),
        ({"parent": 0, "mass": -0.5}, "bunch of -0.5 kg, 90 berries; give a finite mass above 0 and 1 to 140"),
        ({"parent": 0, "mass": 0.5, "count": 0}, "bunch of 0.5 kg, 0 berries"),
    ):
        with pytest.raises(ValueError, match=finding):
            tree.add_bunch(**options)
    assert len(tree.bodies) == 1
    without_springs = builder.TreeBuilder(POSE)
    without_springs.add_body(-1, mass=1.0)
    with pytest.raises(ValueError, match="body 0 has joint stiffness"):
        without_springs.solve_rest_pose()


def cane_with_bunch(clusters: bool = True) -> builder.TreeBuilder:
    tree = beam(4)
    stalk = tree.add_rod(
        3, 0.06, (0.0022, 0.0022), CANE, 2, organ=Organ.PEDUNCLE, rest=frames.exp(np.array([0.0, np.pi / 2, 0.0]))
    )
    tree.add_bunch(stalk[-1], 0.6, count=90, seed=7, clusters=clusters, pull=40.0)
    return tree


def test_a_bunch_has_its_clusters_behind_the_core():
    model = builder.assemble([cane_with_bunch(), cane_with_bunch()])
    n = int(model.bunch_clusters[0])
    assert model.tree_core.tolist() == [7, 7]
    assert model.tree_size.tolist() == [7 + n, 7 + n]
    assert model.bunch_cluster.tolist() == [7, 14 + n]
    assert model.body_parent[7 : 7 + n].tolist() == [6, *range(7, 6 + n)]
    assert model.body_parent[14 + n : 14 + 2 * n].tolist() == [13 + n, *range(14 + n, 13 + 2 * n)]
    assert model.bunch_head_mass[0] + model.body_mass[7 : 7 + n].sum() == pytest.approx(0.6, rel=1e-6)
    assert model.body_mass[6] == pytest.approx(0.6, rel=1e-6)
    assert model.bunch_pull.tolist() == [40.0, 40.0]
    assert 0.10 < model.bunch_length[0] < 0.2


def test_clusters_do_not_change_the_rest_pose():
    fine = cane_with_bunch()
    whole = cane_with_bunch(clusters=False)
    for tree in (fine, whole):
        tree.solve_rest_pose()
    models = [builder.assemble([tree]) for tree in (fine, whole)]
    assert len(models[1].body_mass) == 7
    assert models[0].joint_settled[:7] == pytest.approx(models[1].joint_settled, abs=1e-5)
    assert np.linalg.norm(frames.log(models[0].joint_settled[6].astype(float))) < 0.3
