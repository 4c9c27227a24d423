"""Wood that gives: peduncles in tension, bending and twist, at both ends and for seconds of load. Canes that keep a
set, crack and break, against beam theory. Ties that slip and break."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.stats import kstest, weibull_min

from vinesim import Simulation
from vinesim.api.energy import momentum
from vinesim.core import frames
from vinesim.interaction.breaking import WoodMonitor
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.device_buffers import DeviceBuffers
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.cane import CaneBuilder
from vinesim.scene.cane import assemble as assemble_canes
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.spec import load_scene
from vinesim.scene.state import State
from vinesim.scene.strength import peduncle_strength, weibull
from vinesim.scene.surroundings import Tie, Wire
from vinesim.scene.values import Detachment
from vinesim.world import Physics

DOWN = frames.from_x_axis(np.array([0.0, 0.0, -1.0]))


def stalks(pull: np.ndarray, bend: float, *, length: float = 0.08, modulus: float = 1e9) -> Model:
    """Bunches of 0.4 kg that hang straight down on stalks of 4.4 mm from fixed points, with given strengths."""
    trees = []
    for i, strength in enumerate(np.asarray(pull, float).tolist()):
        tree = TreeBuilder(frames.pose(np.array([0.5 * i, 0.0, 2.0]), DOWN))
        green = RodMaterial(modulus, 1000.0, 0.05)
        last = tree.add_rod(-1, length, (0.0022, 0.0022), green, 2, organ=Organ.PEDUNCLE)[-1]
        tree.add_bunch(last, 0.4, seed=i, clusters=False, pull=strength, bend=bend)
        trees.append(tree)
    return assemble(trees)


def load_until_broken(model: Model, dt: float, rate: np.ndarray, seconds: float, **numbers: float) -> list[Detachment]:
    """Load all bunches by a wrench that grows by ``rate`` [6] each second. Returns the breaks, bunch by bunch."""
    physics = Physics(model, parameters=PhysicsParameters(dt=dt, sleep=False, **numbers))
    physics.plants.wake(np.arange(len(model.tree_first)))
    found: dict[int, Detachment] = {}
    for step in range(round(seconds / dt)):
        hanging = physics.state.bunch_attached
        physics.plants.body_load[model.bunch_body] = np.where(hanging[:, None], (step + 1) * dt * rate, 0.0)
        physics.step()
        found |= {one.bunch: one for one in physics.detachments}
        if len(found) == len(model.bunch_body):
            break
    return [found[bunch] for bunch in sorted(found)]


def test_peduncles_that_are_pulled_break_as_the_distribution_says():
    """200 strengths from a Weibull distribution, measured by pulling: Kolmogorov-Smirnov, and equal at all dt."""
    low, high = 30.0, 120.0
    pull, _ = peduncle_strength(np.random.default_rng(5).random(200), low, high)
    forces = []
    for dt in (0.001, 0.005, 0.01):
        broken = load_until_broken(stalks(pull, 1e3), dt, np.array([0.0, 0, -40.0, 0, 0, 0]), 6.0)
        assert len(broken) == 200
        assert {one.cause for one in broken} == {"pull"}
        forces.append([one.force[2] for one in broken])
        assert [one.time for one in broken] == pytest.approx([(f - 0.4 * 9.81) / 40.0 for f in forces[-1]], abs=0.03)
    scale, shape = weibull(low, high)
    assert kstest(forces[2], weibull_min(shape, scale=scale).cdf).pvalue > 0.05
    np.testing.assert_allclose(forces[1], forces[0], rtol=0.02)
    np.testing.assert_allclose(forces[2], forces[0], rtol=0.02)
    # the break comes 30 ms after the strength was passed
    np.testing.assert_allclose(forces[0], pull + 0.03 * 40.0, rtol=0.01)


@pytest.mark.parametrize("dt", [0.001, 0.01])
def test_tension_bending_and_twist_add_up_as_stresses(dt):
    """A stalk that does not bend, with force across, along and a twist: it breaks where von Mises' stress of the beam
    reaches its strength, at the shoot."""
    model = stalks(np.array([60.0]), 0.5, modulus=1e11)
    model.joint_damping[:] = 0.03 * model.joint_stiffness
    across, along, twist = 4.0, 25.0, 0.6
    rate = np.array([across, 0.0, -along, 0.0, 0.0, twist])
    (broken,) = load_until_broken(model, dt, rate, 3.0, detachment_duration=1e-6)
    share = broken.time
    tension = share * along + 9.81 * (model.body_mass.sum())
    used = np.hypot(tension / 60.0 + share * across * 0.08 / 0.5, 0.5 * np.sqrt(3.0) * share * twist / 0.5)
    assert used == pytest.approx(1.0, rel=0.02)
    assert broken.segment == 0
    assert broken.place == pytest.approx(broken.at)
    assert broken.point[2] == pytest.approx(2.0, abs=1e-3)
    assert broken.at < 1e-3


@pytest.mark.parametrize(("rate", "cause", "end"), [
    ([0, 0, -30.0, 0, 0, 0], "pull", None),
    ([6.0, 0, 0, 0, 0, 0], "bend", 0),  # a force at the bunch: the moment is largest at the shoot
    ([0, 0, 0, 0, 0, 0.5], "twist", None),
])  # fmt: skip
def test_the_event_names_cause_and_end(rate, cause, end):
    model = stalks(np.array([60.0]), 0.3, modulus=1e11)
    model.joint_damping[:] = 0.03 * model.joint_stiffness
    (broken,) = load_until_broken(model, 0.01, np.array(rate, float), 4.0)
    assert broken.cause == cause
    if end is not None:
        assert broken.segment == end


def test_a_stalk_that_is_pushed_does_not_break_by_pull():
    broken = load_until_broken(stalks(np.array([20.0]), 1e3), 0.01, np.array([0.0, 0.0, 30.0, 0, 0, 0]), 1.0)
    assert broken == []


# Canes.

E_WOOD = 5.9e9
STRENGTH = 80e6


def wood(**numbers) -> CaneBuilder:
    """A cane of 0.3 m and 10 mm, level, that cracks at 80 MPa unless other numbers are given."""
    given = {"length": 0.3, "radius": 0.005, "youngs_modulus": E_WOOD, "strength": STRENGTH, "segments": 12}
    return CaneBuilder(density=900.0, damping_ratio=0.3, **(given | numbers))


def push_tip(model: Model, dt: float, rate: float, seconds: float, largest: float = np.inf) -> Simulation:
    """Push the tip of a level cane down, by a force that grows by ``rate`` [N/s] up to ``largest``, without weight,
    until the cane cracks."""
    simulation = Simulation(model, parameters=PhysicsParameters(dt=dt, gravity=0.0, sleep=False))
    for _ in range(round(seconds / dt)):
        force = min(rate * simulation.time, largest)
        simulation.apply_wrench(simulation.tip_body(), (0.0, 0.0, -force), at=simulation.tip())
        simulation.step()
        if simulation.breakages:
            break
    return simulation


def elastica(moment: float, length: float, stiffness: float) -> tuple[float, float]:
    """Force [N] across the tip of a clamped level beam with this moment at the clamp, and the tip's angle [rad]."""

    def bend(force: float) -> tuple[float, float]:
        # theta' = M / EI, M' = -F cos(theta)
        made = solve_ivp(
            lambda _, y: [y[1] / stiffness, -force * np.cos(y[0])], (0.0, length), [0.0, moment], rtol=1e-9, atol=1e-12
        )
        return made.y[1, -1], made.y[0, -1]

    force = brentq(lambda f: bend(f)[0], 0.5 * moment / length, 3.0 * moment / length)
    return force, bend(force)[1]


@pytest.mark.parametrize("dt", [0.002, 0.01])
@pytest.mark.parametrize("length", [0.3, 0.6])
def test_a_cane_cracks_at_the_force_and_angle_of_beam_theory(dt, length):
    section = np.pi * 0.005**3 / 4.0
    force, angle = elastica(STRENGTH * section, length, E_WOOD * section * 0.005)
    simulation = push_tip(wood(length=length).build(), dt, 0.7 * force, 3.0)
    (crack,) = simulation.breakages
    assert (crack.kind, crack.cause, crack.body, crack.place) == ("crack", "bend", 0, 0.0)
    assert np.linalg.norm(crack.moment) == pytest.approx(STRENGTH * section, rel=0.03)
    assert np.linalg.norm(crack.force) == pytest.approx(force, rel=0.05)
    pose = simulation.body_pose(simulation.tip_body())
    tip = frames.rotate(pose[3:], np.array([1.0, 0.0, 0.0]))
    assert np.arcsin(-tip[2]) == pytest.approx(angle, rel=0.05)


def test_wood_bent_past_its_yield_keeps_a_set_and_then_springs():
    """Of the moment above the yield the law leaves a known set, which does not grow when the same load comes again."""
    model = wood(yield_strength=50e6).build()
    simulation = Simulation(model, parameters=PhysicsParameters(gravity=0.0, sleep=False))
    law = simulation.physics.detachment_monitor.wood.law
    largest = 0.85 * float(law.breaks[0]) / 0.3
    flows = []
    for _ in range(2):
        for step in range(300):
            force = largest * min(step / 200.0, 1.0) if step < 250 else 0.0
            simulation.apply_wrench(simulation.tip_body(), (0.0, 0.0, -force), at=simulation.tip())
            simulation.step()
            assert simulation.breakages == simulation.detachments == ()
            if step == 249:
                moment = largest * simulation.tip()[0]
        flows.append(simulation.state.joint_flow.copy())
    simulation.step(300)
    expected = (moment - law.yields[0]) * 0.6 / 0.4 / model.joint_stiffness[0, 2]
    assert flows[0][0] == pytest.approx(expected, rel=0.1)
    np.testing.assert_allclose(flows[1], flows[0], rtol=0.02, atol=1e-5)
    kept = frames.log(simulation.state.joint_set.astype(float))
    np.testing.assert_allclose(np.linalg.norm(kept, axis=1), flows[1], rtol=0.02, atol=1e-5)
    tip = frames.rotate(simulation.body_pose(11)[3:], np.array([1.0, 0.0, 0.0]))
    assert np.arcsin(-tip[2]) == pytest.approx(flows[1].sum(), rel=0.03)


@pytest.mark.parametrize("speed", [0.1, 0.3])
def test_the_work_of_a_break_is_accounted_for(speed):
    """A cane is bent by a tie that moves down until the cane parts: work of the tie = elastic + kinetic + set + crack +
    damping; and the crack takes at least toughness times cross-section."""
    model = wood(yield_strength=50e6, toughness=5e3).build()
    simulation = Simulation(model, parameters=PhysicsParameters(dt=0.002, gravity=0.0, sleep=False))
    simulation.wake(0)
    plants = simulation.physics.plants
    monitor = simulation.physics.detachment_monitor.wood
    tip = simulation.tip_body()
    tie = plants.add_tie(tip, np.array([float(model.body_length[tip]), 0.0, 0.0]), 5e3, 1.0)
    work = 0.0
    start = plants.tie_anchor[tie].astype(float)
    for step in range(round(0.35 / speed / 0.002)):
        stretch = simulation.tip() - plants.tie_anchor[tie]
        if simulation.detachments:
            break
        at = start + np.array([-0.3, 0.0, -1.0]) * speed * 0.002 * (step + 1)
        work -= float(5e3 * stretch @ (at - plants.tie_anchor[tie]))
        plants.tie_anchor[tie] = at
        simulation.step()
    (broken,) = simulation.detachments
    assert broken.cause == "bend"
    elastic = 0.5 * 5e3 * float(stretch @ stretch)
    gained = simulation.energy().total + elastic + monitor.work.sum()
    assert monitor.work[:, 1].sum() > 5e3 * np.pi * 0.005**2 * 0.95
    assert gained == pytest.approx(work, rel=0.06)
    assert gained < work * 1.01


def test_a_side_shoot_tears_off_at_its_base():
    tree = wood().tree()
    thin = RodMaterial(1e9, 950.0, 0.02, strength=45e6, yield_strength=30e6, toughness=5e3)
    side = tree.add_rod(5, 0.2, (0.002, 0.002), thin, 6, rest=frames.exp(np.array([0.0, 0.0, 0.5 * np.pi])))
    simulation = Simulation(assemble([tree]), parameters=PhysicsParameters(gravity=0.0, sleep=False))
    found = []
    for _ in range(400):
        simulation.apply_wrench(side[-1], (0.0, 0.0, -3.0 * simulation.time), at=simulation.body_pose(side[-1])[:3])
        simulation.step()
        found += simulation.detachments
        if found:
            break
    assert [one.body for one in found] == [side[0]]
    assert found[0].place == pytest.approx(6 * 0.025)


def test_wood_gives_alike_in_the_memory_layout_of_a_gpu():
    model = assemble([wood(yield_strength=50e6).tree() for _ in range(3)])
    runs = []
    for interleave in (0, 32):
        state = State.at_rest(model)
        buffers = DeviceBuffers("cpu", interleave)
        solver = ArticulationSolver(model, state, PhysicsParameters(gravity=0.0), buffers=buffers)
        monitor = WoodMonitor(solver, np.zeros(3, bool))
        solver.wake(np.arange(3))
        found = []
        for step in range(110):
            solver.body_load[[11, 23, 35], 2] = -step * np.array([0.25, 0.3, 0.35])
            solver.predict()
            solver.integrate()
            found += [(step, one.body, one.is_crack) for one in monitor.update()]
        assert len(found) >= 2
        runs.append((found, state.joint_set.tobytes(), state.joint_flow.tobytes()))
    assert runs[0] == runs[1]


# Ties.


def tied_cane(**numbers: float) -> Model:
    """A pinned cane that stands 0.6 m high, bound at 0.5 m to a wire along y that does not deflect."""
    up = frames.pose(np.zeros(3), frames.from_x_axis(np.array([0.0, 0.0, 1.0])))
    cane = CaneBuilder(length=0.6, radius=0.006, segments=3, pose=up, base="pinned", beta=0.02)
    wire = Wire((0.0, -2.0, 0.5), (0.0, 2.0, 0.5), tension=1e5)
    return assemble_canes([cane], wires=[wire], ties=[Tie(along=0.5, wire=0, stiffness=2000.0, **numbers)])


def pull_top(model: Model, direction: list[float], rate: float, seconds: float, dt: float) -> tuple[Simulation, list]:
    simulation = Simulation(model, parameters=PhysicsParameters(dt=dt, gravity=0.0, sleep=False))
    found = []
    for _ in range(round(seconds / dt)):
        force = rate * simulation.time * np.array(direction)
        simulation.apply_wrench(2, force, at=simulation.tip())
        simulation.step()
        found += simulation.breakages
        if found:
            break
    return simulation, found


@pytest.mark.parametrize("dt", [0.001, 0.01])
def test_a_tie_slips_along_its_wire_at_its_force_and_breaks_at_its_strength(dt):
    """A pull at 0.6 m is 0.6 / 0.5 of it at the tie."""
    model = tied_cane(slip=12.0, strength=40.0)
    simulation, (slip,) = pull_top(model, [0.0, 1.0, 0.0], 10.0, 3.0, dt)
    assert (slip.kind, slip.tie, slip.place) == ("slip", 0, pytest.approx(0.5))
    assert simulation.time * 10.0 * 0.6 / 0.5 == pytest.approx(12.0, rel=0.05)
    simulation.step(20)
    held = 2000.0 * (simulation.physics.plants.tie_anchor[0] - simulation.body_pose(2)[:3] - [0.0, 0.0, 0.1])
    assert abs(held[1]) < 12.5
    simulation, (broken,) = pull_top(model, [1.0, 0.0, 0.0], 20.0, 3.0, dt)
    assert (broken.kind, simulation.state.tie_broken.tolist()) == ("untie", [True])
    assert np.linalg.norm(broken.force) == pytest.approx(40.0, rel=0.02)
    assert simulation.time * 20.0 * 0.6 / 0.5 == pytest.approx(40.0, rel=0.03)
    assert simulation.physics.plants.tie_stiffness[0] == 0.0


def test_ties_without_a_strength_hold():
    simulation, found = pull_top(tied_cane(), [0.6, 0.8, 0.0], 200.0, 1.0, 0.01)
    assert found == []
    assert not simulation.state.tie_broken.any()


SCENES = ("demo", "vsp", "tendone", "cordon", "slope", "harvest")


def pulled_body(physics: Physics, random: np.random.Generator, cane: bool) -> int:
    """Returns a random body of a cane, or of a bunch that hangs, in a tree that stands."""
    model = physics.model
    state = physics.state
    bunches = np.flatnonzero(state.bunch_attached & hangs(physics)[model.bunch_body])
    if cane or not len(bunches):
        fits = (model.body_organ == int(Organ.CANE)) & hangs(physics) & (model.body_strength > 0.0)
        return int(random.choice(np.flatnonzero(fits)))
    return int(model.bunch_body[random.choice(bunches)])


def hangs(physics: Physics) -> np.ndarray:
    """[body] Whether each body hangs on its tree, and is no part of a piece that has come off."""
    return physics.plants._root < 0


def break_at_random(scene: str, count: int, seed: int, at_once: int = 24) -> None:
    """Pull canes and bunches of a scene at random, by forces in random directions that grow by 100 N/s, until ``count``
    have broken. What has come off is let go. In each step with breaks: mass and momentum of the trees before and after
    the break."""
    model = generate(load_scene(scene))
    random = np.random.default_rng(seed)
    # a fine shoot of cordon that 80 N pull through picked bunches and against its arm has up to 106 contacts
    physics = Physics(model, parameters=PhysicsParameters(max_contacts_per_tree=128))
    plants = physics.plants
    contacts_of_trees = 0
    hooks: list[tuple[int, np.ndarray, int]] = []
    breaks = 0
    for step in range(40 * count):
        hooks = [hook for hook in hooks if step - hook[2] < 200]
        while len(hooks) < at_once:
            body = pulled_body(physics, random, cane=random.random() < 0.7)
            direction = random.normal(size=3)
            hooks.append((body, direction / np.linalg.norm(direction), step))
        plants.body_load[:] = 0.0
        for body, direction, since in hooks:
            plants.body_load[body, :3] = 1.0 * (step - since) * direction
        plants.wake(np.unique(model.body_tree[[body for body, _, _ in hooks]]))
        for name, stage in physics.stages:
            if not name.startswith("detachment"):
                stage()
                continue
            awake = plants.awake.copy()
            plants.forward_kinematics(awake)
            mass = plants.body_mass.copy()
            was = momentum(plants, awake)
            stage()
            torn = physics.detachments
            if torn and all(one.bunch < 0 for one in torn):
                plants.forward_kinematics(awake)
                here = np.concatenate([np.arange(*model.bodies_of(tree).indices(len(mass))) for tree in awake])
                speed = np.abs(plants.state.body_qd[here]).max(1) * plants.body_mass[here]
                is_now = momentum(plants, awake)
                np.testing.assert_array_equal(plants.body_mass, mass)
                assert np.abs(is_now.linear - was.linear).max() <= 2e-6 * speed.sum() + 1e-9, (step, torn)
        physics.tick += 1
        contacts_of_trees = max(contacts_of_trees, int(physics.contact_solver.detection.candidates.count.max()))
        gone = {one.body for one in torn} | {int(model.bunch_body[one.bunch]) for one in torn if one.bunch >= 0}
        breaks += len(torn)
        here = hangs(physics)
        hooks = [hook for hook in hooks if hook[0] not in gone and here[hook[0]]]
        if breaks >= count:
            break
    plants.body_load[:] = 0.0
    for _ in range(50):
        physics.step()
    assert breaks >= count
    assert np.isfinite(physics.snapshot().body_q).all()
    assert contacts_of_trees < physics.parameters.max_contacts_per_tree
    # 750 trees of vsp that are awake at once have up to 1064 contacts, and a world has room for 1024
    faults = {name: n for name, n in physics.faults.items() if n}
    assert faults.keys() <= {"trees_slowed", "contacts_dropped"}, faults


def test_random_breaks_of_the_demo_keep_mass_and_momentum() -> None:
    break_at_random("demo", 17, seed=5)


@pytest.mark.long
@pytest.mark.parametrize("scene", SCENES)
def test_a_thousand_random_breaks_keep_mass_and_momentum(scene: str) -> None:
    break_at_random(scene, 167, seed=11)
