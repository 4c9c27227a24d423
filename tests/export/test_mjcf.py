"""The exported MJCF in MuJoCo: masses, equilibrium and frequencies are those of vinesim."""

from __future__ import annotations

import time

import mujoco
import numpy as np
import pytest

import vinesim
from tests.export.scenes import bent_cane, bodies_of, one_vine, vine_on_a_slope
from tests.export.small_vibrations import model_frequencies
from tests.export.swings import crossing_frequency, modes
from tests.support.clustered_trees import clustered
from vinesim.core import frames


def load(source, tmp_path, **options) -> mujoco.MjModel:
    file = tmp_path / "vineyard.xml"
    vinesim.export_vineyard(source, file, **options)
    return mujoco.MjModel.from_xml_path(str(file))


def plant_bodies(world: mujoco.MjModel) -> tuple[list[str], np.ndarray]:
    """Names and MuJoCo indices of the bodies of plants."""
    number = [i for i in range(1, world.nbody) if not world.body(i).name.startswith("box_")]
    return [world.body(i).name for i in number], np.array(number)


MODELS = {"cane": bent_cane, "bunch": clustered, "vine": one_vine}


@pytest.mark.parametrize("name", MODELS)
def test_masses_and_places_are_those_of_the_model(name, tmp_path):
    model = MODELS[name]()
    world = load(model, tmp_path)
    names, number = plant_bodies(world)
    bodies = bodies_of(model, names)
    plants = vinesim.Simulation(model).physics.plants  # bunches are compounds there
    np.testing.assert_allclose(world.body_mass[number], plants.body_mass[bodies], rtol=1e-6)
    data = mujoco.MjData(world)
    mujoco.mj_forward(world, data)
    drawn = model.forward_kinematics(model.joint_settled)[bodies]
    np.testing.assert_allclose(data.xpos[number], drawn[:, :3], atol=2e-6)
    com = drawn[:, :3] + frames.rotate(drawn[:, 3:], plants.body_com[bodies].astype(float))
    np.testing.assert_allclose(data.xipos[number], com, atol=5e-6)
    pieces = sorted(set(range(len(model.body_mass))) - set(bodies.tolist()))
    # berry clusters are parts of their bunch, spare bodies are nothing
    assert all(model.bunch_of_body()[body] >= 0 or model.is_spare()[body] for body in pieces)
    assert len(model.box_mass) == sum(world.body(i).name.startswith("box_") for i in range(world.nbody))


@pytest.mark.parametrize("name", MODELS)
def test_the_drawn_shape_stays_in_equilibrium(name, tmp_path):
    world = load(MODELS[name](), tmp_path)
    data = mujoco.MjData(world)
    mujoco.mj_forward(world, data)
    start = data.xpos.copy()
    for _ in range(int(1.0 / world.opt.timestep)):
        mujoco.mj_step(world, data)
    number = plant_bodies(world)[1]
    assert np.abs(data.xpos - start)[number].max() < 1e-4
    assert not data.warning.number.any()


def test_a_slack_cane_sags_as_in_vinesim(tmp_path):
    cane = vinesim.CaneBuilder(tip_mass=0.05, damping_ratio=0.5, radius=(0.005, 0.003), segments=8)
    world = load(cane, tmp_path)
    data = mujoco.MjData(world)
    simulation = vinesim.Simulation(cane, sleep=False)
    simulation.step(1000)
    for _ in range(int(10.0 / world.opt.timestep)):
        mujoco.mj_step(world, data)
    plants = simulation.physics.plants.state.body_q[:, :3]
    sag = np.abs(plants[-1] - data.xpos[-1])
    assert 1.0 - plants[-1, 2] > 0.1
    assert sag.max() < 0.02 * (1.0 - plants[-1, 2])


def test_small_vibrations_of_a_cane_have_the_frequencies_of_the_model(tmp_path):
    model = bent_cane()
    ours = model_frequencies(model)
    world = load(model, tmp_path)
    theirs = modes(world, np.arange(world.nv))[0]
    np.testing.assert_allclose(theirs[:6], ours[:6], rtol=1e-4)


@pytest.mark.parametrize("name", ["bunch", "vine"])
def test_a_shoot_with_a_bunch_swings_at_the_same_frequency(name, tmp_path):
    """The mode is started by velocities in both simulators. On the vine, ties, wires and the arm take part."""
    model = MODELS[name]()
    world = load(model, tmp_path)
    bunch = 0
    tree = int(model.body_tree[model.bunch_body[bunch]])
    names, number = plant_bodies(world)
    bodies = bodies_of(model, names)
    mine = np.flatnonzero(model.body_tree[bodies] == tree)
    hinges = np.concatenate([np.arange(3) + world.body_dofadr[number[i]] for i in mine])
    frequencies, shapes = modes(world, hinges)
    frequency, rates = frequencies[0], shapes[:, 0]
    rates = rates * 0.02 * 2 * np.pi * frequency / np.abs(rates).max()

    simulation = vinesim.Simulation(model, sleep=False, dt=0.004)
    state = simulation.physics.plants.state
    for row, i in enumerate(mine):
        body = int(bodies[i])
        axes = world.jnt_axis[world.body_jntadr[number[i]] :][:3]
        state.joint_qd[body] = frames.rotate(state.joint_q[body].astype(float), rates[3 * row : 3 * row + 3] @ axes)
    simulation.physics.plants.wake(np.array([tree], np.int32))
    start = state.body_q[:, :3].copy()
    ours, theirs = [], []
    duration = 1.7 / frequency
    for _ in range(int(duration / 0.004)):
        simulation.step()
        ours.append(state.body_q[bodies[mine[-1]], :3] - start[bodies[mine[-1]]])
    data = mujoco.MjData(world)
    data.qvel[hinges] = rates
    mujoco.mj_forward(world, data)
    place = data.xpos[number[mine[-1]]].copy()
    for _ in range(int(duration / world.opt.timestep)):
        mujoco.mj_step(world, data)
        theirs.append(data.xpos[number[mine[-1]]] - place)
    along = np.linalg.svd(np.array(ours))[2][0]
    ours = crossing_frequency(np.array(ours) @ along, 0.004)
    theirs = crossing_frequency(np.array(theirs) @ along, world.opt.timestep)
    assert theirs == pytest.approx(ours, rel=0.02)


def test_the_same_scene_gives_the_same_bytes(tmp_path):
    for name in ("one.xml", "two.xml"):
        vinesim.export_vineyard(one_vine(), tmp_path / name)
    assert (tmp_path / "one.xml").read_bytes() == (tmp_path / "two.xml").read_bytes()


def test_leaves_are_drawn_without_mass_or_contact(tmp_path):
    model = one_vine()
    bare = load(model, tmp_path)
    leafy = load(model, tmp_path, leaves=True)
    assert leafy.ngeom - bare.ngeom == len(model.leaf_body)
    np.testing.assert_array_equal(leafy.body_mass, bare.body_mass)


def test_plants_touch_robots_ground_and_boxes_but_not_each_other(tmp_path):
    world = load(one_vine(), tmp_path)
    plants = np.isin(world.geom_bodyid, plant_bodies(world)[1])
    assert not (world.geom_contype[plants][:, None] & world.geom_conaffinity[plants]).any()
    assert (world.geom_contype[plants] & world.geom("ground").conaffinity).all()
    assert (world.geom_contype[plants] & 1).all()  # a geom without options has conaffinity 1


@pytest.mark.long
def test_the_demo_stands_for_a_second_in_mujoco(tmp_path):
    world = load("demo", tmp_path)
    data = mujoco.MjData(world)
    mujoco.mj_forward(world, data)
    start = data.xpos.copy()
    begin = time.perf_counter()
    for _ in range(int(1.0 / world.opt.timestep)):
        mujoco.mj_step(world, data)
    print(f"{world.nbody} bodies, 1 s in {time.perf_counter() - begin:.1f} s")
    assert np.abs(data.xpos - start).max() < 1e-3
    assert not data.warning.number.any()


def test_uneven_ground_is_a_height_field_with_the_heights_of_the_model(tmp_path):
    model = vine_on_a_slope()
    world = load(model, tmp_path)
    data = mujoco.MjData(world)
    mujoco.mj_kinematics(world, data)
    low, high = np.array(model.terrain.origin), np.array(model.terrain.end)
    hit = np.zeros(1, np.int32)
    for x, y in np.random.default_rng(1).uniform(low + 0.1, high - 0.1, (50, 2)):
        far = mujoco.mj_rayHfield(world, data, world.geom("ground").id, [x, y, 50.0], [0.0, 0.0, -1.0], None)
        assert 50.0 - far == pytest.approx(float(model.terrain.height(x, y)), abs=2e-4), hit
    assert np.ptp(model.terrain.nodes()) > 0.1


def test_a_urdf_of_uneven_ground_is_refused_in_one_line(tmp_path):
    with pytest.raises(vinesim.UsageError, match="a URDF has no uneven ground, which this scene has; write MJCF"):
        vinesim.export_vineyard(vine_on_a_slope(), tmp_path / "vineyard.urdf")
