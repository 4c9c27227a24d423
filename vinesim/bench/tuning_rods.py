"""Tracks of ``vinesim bench tune`` from PyElastica: a Cosserat rod that is released from vinesim's equilibrium of the
same cane.

The steps of PyElastica are explicit. Damping as in wood, a moment in proportion to the rate of curvature, would need
steps of nanoseconds. PyElastica's own damper takes the same share of every velocity instead. That share is chosen for
the case's damping ratio in the first mode. The second mode then decays no faster than the first; in vinesim's cane it
decays some thirty times faster. The shear modulus is E / 16, as along the grain of wood; PyElastica's own E / 3 needs
steps half as long.
"""

# PyElastica names its exports only at run time, and accepts arrays where its types ask for a float.
# pyright: reportPrivateImportUsage=false, reportArgumentType=false

from __future__ import annotations

import importlib.util
import math

import msgspec
import numpy as np

from vinesim.bench.tuning_cases import Case
from vinesim.bench.tuning_pictures import with_nodes
from vinesim.scene.builder import GRAVITY
from vinesim.scene.cane import CaneBuilder
from vinesim.scene.plant_parameters import Specimen
from vinesim.tune import Trajectory
from vinesim.tune.candidates import COLUMNS, Candidates
from vinesim.tune.experiment import pull_for

ELEMENTS = 32
"""Number of elements of the rod. The cane is half an element shorter than the rod."""
FINE = 64
"""Number of segments of vinesim's chain, whose equilibrium is the start of the rod and whose first mode sets the rod's
damping."""
SHEAR = 16.0
"""Ratio of Young's modulus to the shear modulus [1]."""
STEP_PHASE = 1.6
"""Rotation of an element against its own shear in one step [rad]; PyElastica's scheme is unstable from 2 on."""
PICTURE_STEP = 1e-3
"""Time between recorded positions [s]."""


def is_installed() -> bool:
    """Returns whether PyElastica is installed."""
    return importlib.util.find_spec("elastica") is not None


def rod_track(case: Case) -> Trajectory:
    """Returns the case's track from a Cosserat rod of PyElastica."""
    e = case.experiment
    path = _swing(case.truth, *_held_shape(case), damping_rate(case.truth), e.number("duration") + 2.0 * PICTURE_STEP)
    clock = np.arange(math.ceil((e.hold + e.number("duration")) * e.rate)) / e.rate
    after = np.maximum(clock - e.hold, 0.0)
    seen = np.stack([np.interp(after, PICTURE_STEP * np.arange(len(path)), axis) for axis in path.T], -1)
    noise = np.random.default_rng(e.seed).normal(0.0, e.noise, (len(clock), 1, 3))
    return Trajectory(clock, seen[:, None] + noise, source=f"PyElastica, seed {e.seed}")


def damping_rate(specimen: Specimen) -> float:
    """Returns the rate at which every velocity must decay so that the first mode has the specimen's damping ratio
    [1/s]."""
    mode = CaneBuilder(
        length=specimen.length.value,
        radius=(0.5 * specimen.base_diameter.value, 0.5 * specimen.tip_diameter.value),
        youngs_modulus=specimen.modulus.value,
        density=specimen.density.value,
        segments=FINE,
    ).first_mode()
    return specimen.damping.value * mode**2


def _held_shape(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Returns nodes [node, 3] m and tangents [element, 3] of the rod in vinesim's equilibrium under the pull.

    The clamp holds the first element, and joints are between the middles of elements. So the middle of the first
    element is at the clamp, and the element ends, straight, half an element beyond it.
    """
    specimen, names = with_nodes(msgspec.structs.replace(case.truth, segments=FINE), FINE)
    candidates = Candidates(specimen, names, dt=1e-3)
    row = np.zeros((1, len(COLUMNS)))
    row[0, 5:] = pull_for(candidates, case.experiment.number("displacement"), math.radians(case.experiment.angle))
    nodes = np.concatenate([np.zeros((1, 3)), candidates.shape(row)[0]])
    chords = np.diff(nodes, axis=0)
    # tangents of the chain at the middles of its segments; at the clamp, the direction of the clamp
    piece = specimen.length.value / FINE
    along = np.concatenate([[0.0], piece * (np.arange(FINE) + 0.5)])
    known = np.concatenate([[[1.0, 0.0, 0.0]], chords / np.linalg.norm(chords, axis=1, keepdims=True)])
    h = specimen.length.value / (ELEMENTS - 0.5)
    tangents = np.stack([np.interp(h * np.arange(ELEMENTS), along, axis) for axis in known.T], -1)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    start = -0.5 * h * tangents[:1]
    return np.concatenate([start, start + np.cumsum(h * tangents, 0)]), tangents


def _swing(specimen: Specimen, nodes: np.ndarray, tangents: np.ndarray, rate: float, seconds: float) -> np.ndarray:
    """Returns the positions [sample, 3] m of the tip, :data:`PICTURE_STEP` apart, of a rod that is released at rest.

    Args:
        specimen: diameters, modulus, density.
        nodes: [node, 3] m at the start.
        tangents: [element, 3] at the start.
        rate: rate of the damping [1/s].
        seconds: duration [s].
    """
    import elastica

    class World(elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing, elastica.Damping):
        pass

    middles = specimen.length.value / (ELEMENTS - 0.5) * np.arange(ELEMENTS)
    thick = 0.5 * specimen.base_diameter.value
    thin = 0.5 * specimen.tip_diameter.value
    radius = thick + (thin - thick) * middles / specimen.length.value
    side = np.broadcast_to([0.0, 1.0, 0.0], tangents.shape)  # the cane bends in the plane of x and z
    directors = np.stack([side, np.cross(tangents, side), tangents]).transpose(0, 2, 1)
    modulus = specimen.modulus.value
    density = specimen.density.value
    rod = elastica.CosseratRod.straight_rod(
        ELEMENTS,
        nodes[0],
        np.array([1.0, 0.0, 0.0]),
        np.array([0.0, 1.0, 0.0]),
        specimen.length.value,
        radius,
        density,
        youngs_modulus=modulus,
        shear_modulus=modulus / SHEAR,
        position=nodes.T.copy(),
        directors=directors.copy(),
    )
    # an element oscillates against its shear with the angular frequency 2 / r sqrt(G / rho), whatever its length
    every = math.ceil(PICTURE_STEP * 2.0 / radius.min() * math.sqrt(modulus / SHEAR / density) / STEP_PHASE)
    dt = PICTURE_STEP / every
    world = World()
    world.append(rod)
    world.constrain(rod).using(elastica.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,))
    world.add_forcing_to(rod).using(elastica.GravityForces, acc_gravity=GRAVITY)
    world.dampen(rod).using(elastica.AnalyticalLinearDamper, uniform_damping_constant=rate, time_step=dt)
    world.finalize()
    stepper = elastica.PositionVerlet()
    time = 0.0
    path = [rod.position_collection[:, -1].copy()]
    for _ in range(math.ceil(seconds / PICTURE_STEP)):
        for _ in range(every):
            time = stepper.step(world, time, dt)
        path.append(rod.position_collection[:, -1].copy())
    return np.array(path)
