"""Beams: theory, computed independently of the solver, and measurements on the solver.

References are boundary value problems and eigenvalue problems (SciPy) and elliptic integrals; tests compare, and
``tests/laws/plots.py`` plots the comparisons.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from scipy.integrate import solve_bvp, solve_ivp
from scipy.linalg import eig, eigh
from scipy.optimize import brentq, curve_fit
from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc

from vinesim.core import frames
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.state import State

G = 9.81
HEIGHT = 5.0
"""Where all clamps are [m]."""


@dataclasses.dataclass(frozen=True)
class Beam:
    """A round rod, clamped at one end at an angle above the horizon, with a point mass on the other."""

    modulus: float = 5e9
    radius: float = 0.004
    """At the clamp [m]."""
    taper: float = 1.0
    """Radius at the tip over that at the clamp."""
    length: float = 1.0
    density: float = 800.0
    angle: float = 0.0
    """[rad] above the horizon."""
    tip: float = 0.0
    """[kg]"""
    pieces: int = 16
    beta: float = 0.0
    """Damping over stiffness of every joint [s]."""

    @property
    def rigidity(self) -> float:
        """EI at the clamp [N m^2]."""
        return self.modulus * np.pi * self.radius**4 / 4.0

    @property
    def line_mass(self) -> float:
        """At the clamp [kg/m]."""
        return self.density * np.pi * self.radius**2

    def tree(self, side: float = 0.0) -> TreeBuilder:
        """The beam as bodies; the tip mass is a separate body on a joint that carries hardly any moment."""
        along = np.array([np.cos(self.angle), 0.0, np.sin(self.angle)])
        tree = TreeBuilder(frames.pose(np.array([0.0, side, HEIGHT]), frames.from_x_axis(along)))
        wood = RodMaterial(self.modulus, self.density, self.beta)
        last = tree.add_rod(-1, self.length, (self.radius, self.taper * self.radius), wood, self.pieces)[-1]
        mass = max(self.tip, 1e-6)
        tree.add_body(
            last,
            offset=(self.length / self.pieces, 0, 0),
            mass=mass,
            inertia=[mass * 1e-6] * 3,
            length=1e-3,
            stiffness=[1e-3] * 3,
            damping=[1e-3] * 3,
        )
        return tree


def of_load(alpha: float, share: float, **others: float) -> Beam:
    """The beam whose tip load P and own weight W together are alpha = (P + W) L^2 / EI, ``share`` of it the tip's."""
    beam = Beam(**others)
    weight = beam.line_mass * beam.length
    tip = 4.0 if share == 1.0 else weight * share / (1.0 - share)  # the beam's own weight is then a hundredth
    modulus = (tip + weight) * G * beam.length**2 / alpha / (beam.rigidity / beam.modulus)
    return dataclasses.replace(beam, tip=tip, modulus=modulus)


# ---------------------------------------------------------------------------------------------- theory


def elastica(beam: Beam) -> tuple[float, float]:
    """Rest position of the tip relative to the clamp: (forward, up) [m]."""
    line = elastica_line(beam)
    return float(line[0, -1]), float(line[1, -1])


def elastica_line(beam: Beam) -> np.ndarray:
    """Rest line of the beam from clamp to tip: (forward, up) [2, point] m.

    EI(s) theta' = m, m' = V(s) cos theta, theta(0) = angle, m(L) = 0, with the weight V(s) of all beyond s.
    """
    L = beam.length
    thin = beam.taper - 1.0

    def radius(s: np.ndarray) -> np.ndarray:
        return 1.0 + thin * s / L

    def weight_beyond(s: np.ndarray) -> np.ndarray:
        if thin == 0.0:
            volume = L - s
        else:
            volume = L / (3.0 * thin) * (radius(np.asarray(L)) ** 3 - radius(s) ** 3)
        return G * (beam.tip + beam.line_mass * volume)

    s = np.linspace(0.0, L, 80)
    steps = 1 + int(np.sqrt(weight_beyond(np.asarray(0.0)) * L**2 / beam.rigidity))
    y = np.stack([np.full_like(s, beam.angle), 0.0 * s, s * np.cos(beam.angle), s * np.sin(beam.angle)])
    for load in np.linspace(0.0, 1.0, steps + 1)[1:] ** 2:

        def slope(s: np.ndarray, y: np.ndarray, load: float = load) -> np.ndarray:
            bend = y[1] / (beam.rigidity * radius(s) ** 4)
            return np.stack([bend, load * weight_beyond(s) * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])])

        solution = solve_bvp(
            slope, lambda a, b: np.array([a[0] - beam.angle, b[1], a[2], a[3]]), s, y, tol=1e-6, max_nodes=5000
        )
        assert solution.success, solution.message
        s = solution.x
        y = solution.y
    return y[2:]


def elastica_of_parts(parts: list[Beam]) -> tuple[float, float]:
    """:func:`elastica` of rods joined end to end; only the first's angle and the last's tip mass are used.

    Integrates from the tip, which carries no moment, and solves for its angle. Parts may taper.
    """

    def weight(part: Beam, s: np.ndarray) -> np.ndarray:  # of the part beyond s
        thin = part.taper - 1.0
        r = 1.0 + thin * s / part.length
        volume = part.length - s if thin == 0.0 else part.length / (3.0 * thin) * (part.taper**3 - r**3)
        return G * part.line_mass * volume

    def back(tip_angle: float) -> np.ndarray:
        y = np.array([tip_angle, 0.0, 0.0, 0.0])
        beyond = G * parts[-1].tip
        for part in reversed(parts):

            def slope(s: float, y: np.ndarray, part: Beam = part, beyond: float = beyond) -> list[float]:
                r = 1.0 + (part.taper - 1.0) * s / part.length
                force = beyond + weight(part, s)
                return [y[1] / (part.rigidity * r**4), force * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])]

            y = solve_ivp(slope, (part.length, 0.0), y, rtol=1e-9, atol=1e-11).y[:, -1]
            beyond += weight(part, 0.0)
        return y

    clamp = parts[0].angle
    angle = brentq(lambda tip: back(tip)[0] - clamp, -np.pi / 2 + 1e-6, clamp, xtol=1e-12)
    _, _, x, z = back(angle)
    return float(-x), float(-z)


def elastica_by_integrals(alpha: float) -> tuple[float, float]:
    """The same for a level weightless cantilever with a tip load: forward and up, in lengths.

    Bisshopp and Drucker 1945, Quarterly of Applied Mathematics 3:272: with p^2 = (1 + sin theta_L) / 2 and
    sin theta_1 = 1 / (p sqrt 2), sqrt(alpha) = K(p) - F(theta_1, p).
    """

    def solve(tip: float) -> tuple[float, float, float]:
        m = 0.5 * (1.0 + np.sin(tip))
        first = np.arcsin(1.0 / np.sqrt(2.0 * m))
        root = ellipk(m) - ellipkinc(first, m)
        drop = 1.0 - 2.0 * (ellipe(m) - ellipeinc(first, m)) / root
        return root**2, np.sqrt(2.0 * np.sin(tip)) / root, drop

    tip = brentq(lambda t: solve(t)[0] - alpha, 1e-9, np.pi / 2 - 1e-9)
    _, reach, drop = solve(tip)
    return float(reach), -float(drop)


@dataclasses.dataclass(frozen=True)
class Rod:
    """A rod in space: level at its clamp, along x, optionally curved to the left, with a weight beside its tip."""

    bend: float = 2.0
    """EI [N m^2]"""
    twist: float = 1.5
    """GJ [N m^2]"""
    length: float = 1.0
    turn: float = 0.0
    """Rotation about z of the end of the relaxed rod [rad]."""
    line_weight: float = 0.0
    """[N/m]"""
    weight: float = 0.0
    """[N]"""
    beside: float = 0.0
    """Offset of the weight to the left of the tip, along the tip's y axis [m]."""


def kirchhoff(rod: Rod) -> tuple[np.ndarray, np.ndarray]:
    """Position [3] m and rotation [4] xyzw of the tip at rest.

    Kirchhoff's rod: r' = R e_x, R' = R [u]x, u = u_0 + K^-1 R^T M, M' = -r' x F, with F the weight beyond s, and
    M(L) = R(L) (0, beside, 0) x weight.
    """
    compliance = np.array([1.0 / rod.twist, 1.0 / rod.bend, 1.0 / rod.bend])[:, None]
    L = rod.length
    relaxed = np.array([0.0, 0.0, rod.turn / rod.length])[:, None]
    s = np.linspace(0.0, L, 60)
    half = 0.5 * rod.turn * s / L
    y = np.zeros((10, len(s)))
    y[0], y[5], y[6] = s, np.sin(half), np.cos(half)
    for load in np.linspace(0.0, 1.0, 5):

        def slope(s: np.ndarray, y: np.ndarray, load: float = load) -> np.ndarray:
            q = y[3:7].T
            moment = y[7:].T
            along = frames.rotate(q, np.array([1.0, 0.0, 0.0]))
            force = np.zeros_like(along)
            force[:, 2] = -load * (rod.weight + rod.line_weight * (L - s))
            u = relaxed.T + compliance.T * frames.rotate(frames.conjugate(q), moment)
            spin = 0.5 * frames.multiply(q, np.concatenate([u, np.zeros((len(s), 1))], 1))
            return np.concatenate([along, spin, -np.cross(along, force)], 1).T

        def ends(a: np.ndarray, b: np.ndarray, load: float = load) -> np.ndarray:
            arm = frames.rotate(b[3:7], np.array([0.0, rod.beside, 0.0]))
            moment = np.cross(arm, [0.0, 0.0, -load * rod.weight])
            return np.concatenate([a[:7] - [0, 0, 0, 0, 0, 0, 1], b[7:] - moment])

        solution = solve_bvp(slope, ends, s, y, tol=1e-6, max_nodes=5000)
        assert solution.success, solution.message
        s = solution.x
        y = solution.y
    return y[:3, -1], frames.normalize(y[3:7, -1])


def cantilever_frequencies(beam: Beam, count: int = 3) -> np.ndarray:
    """Of a uniform clamped beam [Hz]: cos(bL) cosh(bL) = -1 (Euler and Bernoulli)."""
    guesses = [1.8751, *(np.arange(1, count) + 0.5) * np.pi]
    roots = [brentq(lambda b: np.cos(b) + 1.0 / np.cosh(b), g - 0.3, g + 0.3) for g in guesses]
    return np.square(roots) / (2 * np.pi) * np.sqrt(beam.rigidity / beam.line_mass) / beam.length**2


def chain(tree: TreeBuilder) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inertia, damping and stiffness of a straight chain swinging sideways, from its bodies' numbers alone.

    Small angles about z: body k turns by the sum of the joints up to its own, and its middle moves by what they carry.
    """
    n = len(tree.bodies)
    joint_at = np.cumsum([body["offset"][0] for body in tree.bodies])
    middle = joint_at + [body.get("com", (0.0, 0.0, 0.0))[0] for body in tree.bodies]
    mass = np.array([body["mass"] for body in tree.bodies])
    inertia = np.array([body["inertia"][2] for body in tree.bodies])
    move = np.tril(middle[:, None] - joint_at)
    turn = np.tril(np.ones((n, n)))
    M = move.T @ (mass[:, None] * move) + turn.T @ (inertia[:, None] * turn)
    C, K = (np.diag([body.get(name, np.zeros(3))[2] for body in tree.bodies]) for name in ("damping", "stiffness"))
    return M, C, K


def chain_modes(tree: TreeBuilder) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies [Hz] and damping ratios of the oscillating modes of :func:`chain`, slowest first."""
    M, C, K = chain(tree)
    zero = np.zeros_like(M)
    one = np.eye(len(M))
    s = eig(np.block([[zero, one], [-K, -C]]), np.block([[one, zero], [zero, M]]), right=False)
    s = s[np.argsort(abs(s))]
    s = s[s.imag > 1e-3 * abs(s)]
    return abs(s) / (2 * np.pi), -s.real / abs(s)


def first_shape(tree: TreeBuilder) -> np.ndarray:
    """Joint angles of the first mode without damping, the largest of them 1."""
    M, _, K = chain(tree)
    shape = eigh(K, M, subset_by_index=[0, 0])[1][:, 0]
    return shape / shape[np.argmax(abs(shape))]


def spring_torque(stiffness: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Torque [..., 3] N m, in joint axes, that turns a spring [..., 3] N m/rad by a rotation vector theta [..., 3] rad.

    J^-T K theta with the left Jacobian J of the exponential map: the gradient of theta^T K theta / 2.
    """
    angle = np.maximum(np.linalg.norm(rotation, axis=-1, keepdims=True), 1e-4)
    moment = stiffness * rotation
    across = np.cross(rotation, moment)
    return moment + 0.5 * across + (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / angle**2 * np.cross(rotation, across)


# ---------------------------------------------------------------------------------------------- the solver


def standing(trees: list[TreeBuilder], **options: float) -> ArticulationSolver:
    """A solver with all trees awake at the drawn pose."""
    model = assemble(trees)
    plants = ArticulationSolver(model, State.at_rest(model), **options)
    plants.wake(np.arange(len(trees)))
    return plants


def run(plants: ArticulationSolver, ticks: int, watch: np.ndarray | None = None) -> np.ndarray:
    """Step; positions of the watched bodies at the start of every tick [tick, body, 3]."""
    measured = np.zeros((ticks, 0 if watch is None else len(watch), 3))
    for tick in range(ticks):
        plants.predict()
        if watch is not None:
            measured[tick] = plants.state.body_q[watch, :3]
        plants.integrate()
    return measured


def settle(trees: list[TreeBuilder], seconds: float = 30.0) -> ArticulationSolver:
    """A solver whose trees have come to rest, with phi 1 (which changes no equilibrium)."""
    plants = standing(trees, phi=1.0, dt=0.02)
    run(plants, int(seconds / plants.dt))
    plants.forward_kinematics()
    assert plants.tree_rate.max() < 2e-3, f"tree {plants.tree_rate.argmax()} still moves"
    return plants


def joined_rods(parts: list[Beam], side: float = 0.0) -> TreeBuilder:
    """Rods joined end to end, as bodies; the last carries its tip mass."""
    first = parts[0]
    last = parts[-1]
    tree = dataclasses.replace(first, tip=0.0).tree(side)
    tree.bodies.pop()
    for part in parts[1:]:
        wood = RodMaterial(part.modulus, part.density, part.beta)
        tree.add_rod(len(tree.bodies) - 1, part.length, (part.radius, part.taper * part.radius), wood, part.pieces)
    mass = max(last.tip, 1e-6)
    tree.add_body(
        len(tree.bodies) - 1,
        offset=(last.length / last.pieces, 0, 0),
        mass=mass,
        inertia=[mass * 1e-6] * 3,
        length=1e-3,
        stiffness=[1e-3] * 3,
        damping=[1e-3] * 3,
    )
    return tree


def last_bodies(plants: ArticulationSolver) -> np.ndarray:
    """The last body of each tree."""
    return np.cumsum(plants.model.tree_size) - 1


def resting_tips(beams: list[Beam]) -> np.ndarray:
    """Rest positions of tips by the solver, as :func:`elastica` [beam, 2] m."""
    plants = settle([dataclasses.replace(beam, beta=0.3).tree(i) for i, beam in enumerate(beams)])
    return plants.state.body_q[last_bodies(plants)][:, [0, 2]] - np.array([0.0, HEIGHT])


def fitted_swing(time: np.ndarray, height: np.ndarray, guess: float) -> tuple[float, float]:
    """Frequency [Hz] and damping ratio of a decaying oscillation about its final value."""

    def swing(t: np.ndarray, rest: float, size: float, f: float, zeta: float, phase: float) -> np.ndarray:
        w = 2 * np.pi * f
        return rest + size * np.exp(-zeta * w * t) * np.cos(w * np.sqrt(1 - zeta * zeta) * t + phase)

    rest = height[-len(height) // 4 :].mean()
    start = (rest, height[0] - rest, guess, 0.01, 0.0)
    bounds = ((-10, -2, 0.5 * guess, -0.5, -7), (10, 2, 2.0 * guess, 0.9, 7))
    values, _ = curve_fit(swing, time, height, p0=start, bounds=bounds, xtol=1e-12, ftol=1e-12)
    return float(values[2]), float(values[3])


def spectral_peaks(signal: np.ndarray, dt: float, near: np.ndarray) -> np.ndarray:
    """Frequency of the highest peak within a tenth of each given one [Hz]."""
    span = len(signal) * dt
    spectrum = np.abs(np.fft.rfft((signal - signal.mean()) * np.hanning(len(signal))))
    peaks = []
    for f in near:
        around = np.arange(int(0.9 * f * span), int(1.1 * f * span) + 2)
        peak = around[np.argmax(spectrum[around])]
        left, middle, right = np.log(spectrum[peak - 1 : peak + 2])
        peaks.append((peak + 0.5 * (left - right) / (left - 2 * middle + right)) / span)
    return np.array(peaks)


# ---------------------------------------------------------------------------------------------- comparisons

ALPHAS = (0.05, 0.5, 1.0, 2.0, 3.5, 6.6, 10.0, 14.0, 20.0)
SHARES = (0.0, 0.5, 1.0)
ANGLES = (-1.0, -0.5, 0.0, 0.5, 1.0)


@functools.cache
def elastica_sweep() -> tuple[list[tuple[float, float, float]], np.ndarray, np.ndarray]:
    """(alpha, share, angle) of each beam, and the rest position of its tip by theory and solver [beam, 2] m."""
    cases = [(a, s, t) for a in ALPHAS for s in SHARES for t in ANGLES]
    beams = [of_load(alpha, share, angle=angle) for alpha, share, angle in cases]
    return cases, np.array([elastica(beam) for beam in beams]), resting_tips(beams)


def order(sizes: list[float], errors: np.ndarray) -> float:
    """Slope of log error over log size."""
    return float(np.polyfit(np.log(sizes), np.log(errors), 1)[0])


PIECES = (4, 8, 16, 32)
CONVERGING = {
    "level, own weight": of_load(1.0, 0.0),
    "level, tip load, alpha 10": of_load(10.0, 1.0),
    "raised 0.5 rad, both, alpha 6.6": of_load(6.6, 0.5, angle=0.5),
    "tapered to a half, alpha 2": of_load(2.0, 0.3, taper=0.5),
}


@functools.cache
def errors_over_pieces() -> dict[str, np.ndarray]:
    """Distance of the resting tip from the elastica [m], for each of ``PIECES``."""
    beams = [dataclasses.replace(beam, pieces=n) for beam in CONVERGING.values() for n in PIECES]
    expected = np.repeat([elastica(beam) for beam in CONVERGING.values()], len(PIECES), axis=0)
    error = np.linalg.norm(resting_tips(beams) - expected, axis=1).reshape(-1, len(PIECES))
    return dict(zip(CONVERGING, error, strict=True))


SOFT = Beam(modulus=1e9, length=0.5, tip=0.01)
STIFF = Beam(modulus=5e9, length=0.5, tip=0.01)
JOINED = {
    "stiff wood, then soft": [STIFF, SOFT],
    "soft wood, then stiff": [SOFT, STIFF],
    "thick, then thin": [Beam(radius=0.005, length=0.5), Beam(radius=0.003, length=0.5, tip=0.02)],
    "three, tapering, of unlike length": [
        Beam(radius=0.006, taper=0.8, length=0.3, angle=0.4, density=600.0),
        Beam(modulus=2e9, radius=0.0045, taper=0.7, length=0.5),
        Beam(modulus=1e9, radius=0.004, taper=0.6, length=0.2, density=1000.0, tip=0.1),
    ],
}


@functools.cache
def errors_over_pieces_of_joined() -> dict[str, np.ndarray]:
    """The same for rods of different wood and thickness joined end to end."""
    trees = [
        joined_rods([dataclasses.replace(part, pieces=n // 2, beta=0.3) for part in parts], i)
        for i, (parts, n) in enumerate((parts, n) for parts in JOINED.values() for n in PIECES)
    ]
    plants = settle(trees)
    measured = plants.state.body_q[last_bodies(plants)][:, [0, 2]] - np.array([0.0, HEIGHT])
    expected = np.repeat([elastica_of_parts(parts) for parts in JOINED.values()], len(PIECES), axis=0)
    error = np.linalg.norm(measured - expected, axis=1).reshape(-1, len(PIECES))
    return dict(zip(JOINED, error, strict=True))


STEPS = (0.01, 0.005, 0.0025, 0.00125)


@functools.cache
def errors_over_dt() -> dict[str, np.ndarray]:
    """A cane swinging sideways in its first mode, phi 1/2, for each of ``STEPS``.

    ``frequency``: relative error to the eigenvalue of :func:`chain`; ``theory``: the trapezoidal rule's
    error (w dt)^2 / 12; ``tip``: distance of its tip after half a second from a run at 0.5 ms [m].
    """
    beam = Beam(modulus=1.6e10, pieces=8)  # so stiff that its weight is negligible
    expected = chain_modes(beam.tree())[0][0]
    fine = released(beam, 0.0005, 0.5)[-1]
    frequency = []
    tip = []
    for dt in STEPS:
        swing = released(beam, dt, 2.0)
        f, _ = fitted_swing(np.arange(len(swing)) * dt, swing[:, 1], expected)
        frequency.append(abs(f / expected - 1.0))
        tip.append(np.linalg.norm(swing[round(0.5 / dt)] - fine))
    theory = (2 * np.pi * expected * np.array(STEPS)) ** 2 / 12.0
    return {"frequency": np.array(frequency), "theory": theory, "tip": np.array(tip)}


def released(beam: Beam, dt: float, seconds: float, size: float = 0.003) -> np.ndarray:
    """Tip [tick, 3] m of a cane released in its first mode, at most ``size`` [rad] a joint, in whole steps."""
    tree = beam.tree()
    tree.solve_rest_pose()
    plants = standing([tree], phi=0.5, dt=dt, substeps=False)
    bend = frames.exp(size * first_shape(tree)[:, None] * np.array([0.0, 0.0, 1.0]))
    plants.state.joint_q[:] = frames.multiply(plants.state.joint_q.astype(float), bend)
    return run(plants, round(seconds / dt) + 1, watch=last_bodies(plants))[:, 0]


ZETAS = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.15, 0.2)


@functools.cache
def damping_sweep() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First mode of canes at 100 Hz and the default phi, for each of ``ZETAS``: measured damping ratio, frequency over
    theory, and the solver's ``ArticulationSolver.damping_floor``."""
    f = cantilever_frequencies(Beam(), 1)[0]
    trees = [Beam(beta=zeta / (np.pi * f)).tree(i) for i, zeta in enumerate(ZETAS)]
    plants = standing(trees)
    swings = run(plants, 400, watch=last_bodies(plants))[20:, :, 2]
    time = np.arange(len(swings)) * plants.dt
    fits = np.array([fitted_swing(time, swing, f) for swing in swings.T])
    return fits[:, 1], fits[:, 0] / f, np.full(len(ZETAS), plants.damping_floor(f))


def two_woods(stiff_first: bool, *, beta: tuple[float, float] = (0.0, 0.0), density: float = 800.0) -> TreeBuilder:
    """A level cane of a metre, one half 5 GPa, the other 1 GPa."""
    moduli = (5e9, 1e9) if stiff_first else (1e9, 5e9)
    tree = TreeBuilder(frames.pose(np.array([0.0, 0.0, HEIGHT])))
    half = tree.add_rod(-1, 0.5, (0.004, 0.004), RodMaterial(moduli[0], density, beta[0]), 8)
    tree.add_rod(half[-1], 0.5, (0.004, 0.004), RodMaterial(moduli[1], density, beta[1]), 8)
    return tree


@functools.cache
def measured_frequencies(dt: float = 0.001, ticks: int = 1 << 15) -> tuple[np.ndarray, np.ndarray]:
    """First three frequencies of a level cane kicked sideways: measured and by theory [Hz]."""
    beam = Beam()
    expected = cantilever_frequencies(beam)
    plants = standing([beam.tree()], phi=0.5, dt=dt)
    plants.state.joint_qd[3:5, 2] = 0.3
    plants.state.joint_qd[10, 2] = -0.5
    side = run(plants, ticks, watch=np.array([beam.pieces - 1]))[:, 0, 1]
    return spectral_peaks(side, dt, expected), expected
