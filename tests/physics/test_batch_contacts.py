"""Contacts of a batch of trees that stay on a device: as those of a whole scene, step by step."""

from typing import Any

import mujoco
import numpy as np
import pytest

from tests.support.long_rows import each_once
from vinesim.core import frames
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.device_buffers import DeviceBuffers
from vinesim.rigid import static_world
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.materials import Material
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.state import State
from vinesim.world import Physics
from vinesim.worlds.batch_contacts import BatchContacts

PARAMETERS = PhysicsParameters(sleep=False)
BARS = np.array([(0.3, -1.0, 1.975), (0.6, -1.0, 1.9)], np.float32)


def canes(count: int, **others: np.ndarray) -> Model:
    """Limp canes in one place above two bars, one with a side branch; each is a world of its own."""
    trees = []
    for i in range(count):
        tree = TreeBuilder(frames.pose(np.array([0.0, 0.0, 2.0])))
        wood = RodMaterial(5e9, 800.0, 0.006)
        bodies = tree.add_rod(-1, 1.0, (0.004, 0.004), wood, 8)
        if i == 0:
            tree.add_rod(bodies[3], 0.3, (0.003, 0.003), wood, 3, rest=frames.from_x_axis(np.array([0.8, 0.0, -0.6])))
        trees.append(tree)
    bars = {
        "fixed_start": BARS,
        "fixed_end": BARS * np.array([1, -1, 1], np.float32),
        "fixed_radius": np.full((len(BARS), 2), 0.012, np.float32),
    }
    return assemble(trees, **(bars | others))


def moving(model: Model) -> State:
    rng = np.random.default_rng(3)
    state = State.at_rest(model)
    state.joint_qd[:] = rng.normal(size=state.joint_qd.shape) * 0.3
    return state


def resident(model: Model, interleave: int = 0, **options: int) -> tuple[ArticulationSolver, BatchContacts]:
    plants = ArticulationSolver(model, moving(model), PARAMETERS, buffers=DeviceBuffers("cpu", interleave))
    plants.wake(np.arange(len(model.tree_first)))
    plants.forward_kinematics()
    return plants, BatchContacts(plants, PARAMETERS, **options)


def assert_as_in_a_scene(model: Model, interleave: int) -> set[str]:
    """Three trees move and press as in :class:`Physics`, for 60 steps; returns the geoms that they pressed on."""
    scene = Physics(model, parameters=PARAMETERS)
    scene.contact_solver.plant_plant_contacts = False
    scene.state.joint_qd[:] = moving(model).joint_qd
    scene.wake(np.arange(3))
    plants, contacts = resident(model, interleave)
    plants.upload()
    most = 0
    sweeps = []
    pressed = set()
    for _ in range(4):
        for _ in range(15):
            scene.step()
            sweeps += [scene.contact_solver.impulses.sweeps] * (scene.contact_solver.count > 0)
        plants.advance(15, contacts.solve)
        plants.download()
        plants.forward_kinematics()
        scene.update_kinematics()
        np.testing.assert_allclose(plants.state.body_q, scene.state.body_q, atol=1e-4)
        most = max(most, scene.contact_solver.count)
        assert contacts.count.sum() == scene.contact_solver.count
        force = np.zeros((3, 3))
        for contact in scene.contacts:
            force[model.body_tree[contact.body]] -= contact.force
            pressed.add(contact.link)
        np.testing.assert_allclose(contacts.force, force, atol=0.02 * np.abs(force).max() + 1e-3)
    assert most >= 3
    assert np.mean(sweeps) < 6.0, "canes slide along the bars: Newton steps find where to"
    assert not contacts.dropped.any()
    return pressed


@pytest.mark.parametrize("interleave", [0, 2])
def test_trees_move_and_press_as_in_a_scene(interleave: int) -> None:
    assert assert_as_in_a_scene(canes(3), interleave) == {"fixed/0", "fixed/1"}


def test_arrays_of_trees_are_copied_to_the_device_only_after_an_upload(monkeypatch: pytest.MonkeyPatch) -> None:
    """Backward Euler steps begin with the next upload."""
    (still, _), (plants, _) = resident(canes(3), 2), resident(canes(3), 2)
    copies = []
    upload = plants.launches.upload_trees
    monkeypatch.setattr(plants.launches, "upload_trees", lambda: copies.append(upload()))

    def difference() -> float:
        for solver in (still, plants):
            solver.advance(2)
            solver.download()
        return float(np.abs(plants.state.joint_q - still.state.joint_q).max())

    still.upload()
    plants.upload()
    assert difference() == difference() == difference() == 0.0
    assert len(copies) == 1
    plants.use_backward_euler(np.arange(3))
    plants.upload()
    still.upload()
    assert difference() > 1e-6
    assert len(copies) == 2


WEDGE = [
    (x, y, z) for y in (-0.5, 0.5) for x, z in ((-0.04, -0.03), (0.04, -0.03), (-0.04, 0.0), (0.04, 0.0), (0.0, 0.03))
]
ANGULAR_GEOMS = {
    "box": {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": [0.03, 0.5, 0.02], "euler": [0.0, 0.3, 0.0]},
    "cylinder": {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "size": [0.02, 0.5, 0.0], "euler": [1.5, 0.0, 0.0]},
    "ellipsoid": {"type": mujoco.mjtGeom.mjGEOM_ELLIPSOID, "size": [0.05, 0.5, 0.02]},
    "wedge": {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": "wedge"},
}


@pytest.mark.parametrize(("interleave", "name"), each_once([0, 2], list(ANGULAR_GEOMS)))
def test_trees_press_on_a_geom_that_is_not_round_as_in_a_scene(
    name: str, interleave: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Round geoms have a kernel of their own, any other takes the general one. No scene file has such a static geom: it
    is added to MuJoCo's world, for both."""
    build = static_world.build_static_world

    def build_with_angular_geom(*args: Any) -> mujoco.MjSpec:
        spec = build(*args)
        if name == "wedge":
            spec.add_mesh(name=name, uservert=np.array(WEDGE, float).ravel().tolist())
        spec.worldbody.add_geom(
            name=name,
            pos=[0.45, 0.0, 1.96],
            contype=static_world.FIXED,
            conaffinity=0,
            userdata=static_world.geom_user(Material.BARK),
            **ANGULAR_GEOMS[name],
        )
        return spec

    monkeypatch.setattr(static_world, "build_static_world", build_with_angular_geom)
    assert name in assert_as_in_a_scene(canes(3), interleave)


def test_contacts_beyond_the_slots_are_counted() -> None:
    low = BARS - np.array([0, 0, 0.06], np.float32)  # a third and a fourth one right below
    start = np.concatenate([BARS, low])
    bars = {
        "fixed_start": start,
        "fixed_end": start * np.array([1, -1, 1], np.float32),
        "fixed_radius": np.full((len(start), 2), 0.028, np.float32),
    }
    plants, contacts = resident(canes(2, **bars), slots=1)
    plants.advance(100, contacts.solve)
    assert contacts.count.max() == 1
    assert contacts.dropped.sum() > 0
    assert np.isfinite(plants.state.joint_q).all()


def test_what_cannot_stay_on_the_device_is_refused() -> None:
    model = canes(2)
    asleep = ArticulationSolver(model, State.at_rest(model), PARAMETERS)
    with pytest.raises(ValueError, match="sleep"):
        BatchContacts(asleep, PARAMETERS)
    crate = {
        "box_pose": frames.pose(np.array([5.0, 0.0, 0.5]))[None].astype(np.float32),
        "box_size": np.array([[0.6, 0.4, 0.3]], np.float32),
        "box_mass": np.ones(1, np.float32),
    }
    with pytest.raises(ValueError, match="crates"):
        resident(canes(1, **crate))
    plants, _ = resident(model)
    with pytest.raises(ValueError, match="must be the same"):
        BatchContacts(plants, PhysicsParameters(dt=0.005))
