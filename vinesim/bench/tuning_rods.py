"""Tracks of ``vinesim bench tune`` from PyElastica: a Cosserat rod, let go from vinesim's equilibrium of the same cane.

Its steps are explicit, so what damps wood, a moment by the rate of curvature, would ask for steps of nanoseconds.
PyElastica's own damper takes the same share of every velocity instead. The first mode gets the case's damping ratio by
it; the second one then decays no faster than the first, in vinesim's cane some thirty times faster. Shear modulus
E / 16, as along the grain of wood; PyElastica's own E / 3 asks for steps half as long.
"""

# PyElastica names what it exports only at run time, and takes arrays where it asks for a float.
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
"""Number of elements of the rod; the cane is half an element shorter."""
FINE = 64
"""Segments of vinesim's chain whose equilibrium is the rod's at the start, and whose first mode is damped."""
SHEAR = 16.0
"""[1] Young's modulus over the shear modulus."""
STEP_PHASE = 1.6
"""[rad] Rotation of an element against its own shear in a step; PyElastica's scheme is unstable from 2 on."""
PICTURE_STEP = 1e-3
"""[s] Time between the positions that are kept."""


def is_installed() -> bool:
    """Whether PyElastica is installed."""
    return importlib.util.find_spec("elastica") is not None


def rod_track(case: Case) -> Trajectory:
    """The case's track from a Cosserat rod of PyElastica."""
    e = case.experiment
    path = _swing(case.truth, *_held_shape(case), damping_rate(case.truth), e.number("duration") + 2.0 * PICTURE_STEP)
    clock = np.arange(math.ceil((e.hold + e.number("duration")) * e.rate)) / e.rate
    after = np.maximum(clock - e.hold, 0.0)
    seen = np.stack([np.interp(after, PICTURE_STEP * np.arange(len(path)), axis) for axis in path.T], -1)
    noise = np.random.default_rng(e.seed).normal(0.0, e.noise, (len(clock), 1, 3))
    return Trajectory(clock, seen[:, None] + noise, source=f"PyElastica, seed {e.seed}")


def damping_rate(specimen: Specimen) -> float:
    """[1/s] The share of every velocity that must be lost for the first mode's damping ratio to be the specimen's."""
    mode = CaneBuilder(
        length=specimen.length.value,
        radius=(0.5 * specimen.base_diameter.value, 0.5 * specimen.tip_diameter.value),
        youngs_modulus=specimen.modulus.value,
        density=specimen.density.value,
        segments=FINE,
    ).first_mode()
    return specimen.damping.value * mode**2


def _held_shape(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Nodes [node, 3] m and tangents [element, 3] of the rod in vinesim's equilibrium under the pull.

    The clamp holds the first element, and bending is between the middles of elements: so the first element ends half an
    element beyond the clamp, straight, and its middle lies in the clamp.
    """
    specimen, names = with_nodes(msgspec.structs.replace(case.truth, segments=FINE), FINE)
    candidates = Candidates(specimen, names, dt=1e-3)
    row = np.zeros((1, len(COLUMNS)))
    row[0, 5:] = pull_for(candidates, case.experiment.number("displacement"), math.radians(case.experiment.angle))
    nodes = np.concatenate([np.zeros((1, 3)), candidates.shape(row)[0]])
    chords = np.diff(nodes, axis=0)
    # the tangent of a chain of segments at their middles, at the clamp that of the clamp
    piece = specimen.length.value / FINE
    along = np.concatenate([[0.0], piece * (np.arange(FINE) + 0.5)])
    known = np.concatenate([[[1.0, 0.0, 0.0]], chords / np.linalg.norm(chords, axis=1, keepdims=True)])
    h = specimen.length.value / (ELEMENTS - 0.5)
    tangents = np.stack([np.interp(h * np.arange(ELEMENTS), along, axis) for axis in known.T], -1)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    start = -0.5 * h * tangents[:1]
    return np.concatenate([start, start + np.cumsum(h * tangents, 0)]), tangents


def _swing(specimen: Specimen, nodes: np.ndarray, tangents: np.ndarray, rate: float, seconds: float) -> np.ndarray:
    """Positions [sample, 3] m of the tip, :data:`PICTURE_STEP` apart, of a rod that is let go at rest.

    Args:
        specimen: diameters, modulus, density.
        nodes: [node, 3] m at the start.
        tangents: [element, 3] at the start.
        rate: [1/s] of the damping.
        seconds: how long.
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
    # an element turns against its shear at 2 / r sqrt(G / rho), whatever its length
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
