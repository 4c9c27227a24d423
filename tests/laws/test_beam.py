"""A rod of 16 bodies against the beam it stands for: elastica, natural frequencies, damping, buckling."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_bvp
from scipy.optimize import brentq, curve_fit
from scipy.special import jv

from vinesim import frames
from vinesim.physics.plants import Plants
from vinesim.world.grow import Tree, Wood, assemble
from vinesim.world.state import State

LENGTH, RADIUS, DENSITY, PIECES, G = 1.0, 0.004, 800.0, 16, 9.81
AREA, SECOND_MOMENT = np.pi * RADIUS**2, np.pi * RADIUS**4 / 4.0
LINE_WEIGHT = DENSITY * AREA * G
"""[N/m]"""


def cane(modulus: float, *, beta: float = 0.0, tip: float = 0.0, up: bool = False, side: float = 0.0) -> Tree:
    """A clamped rod along +x (or +z), with a point mass [kg] on its tip."""
    along = frames.aligned(np.array([0.0, 0.0, 1.0])) if up else frames.IDENTITY
    tree = Tree(frames.pose(np.array([0.0, side, 5.0]), along))
    pieces = tree.rod(-1, LENGTH, (RADIUS, RADIUS), Wood(modulus, DENSITY, beta), PIECES)
    last = tree.bodies[pieces[-1]]
    tree.add(
        pieces[-1], offset=(last["length"], 0, 0), mass=max(tip, 1e-6), inertia=[max(tip, 1e-6) * 1e-6] * 3,
        length=1e-3, stiffness=[1e-3] * 3, damping=[1e-3] * 3,
    )  # fmt: skip
    return tree


def run(plants: Plants, ticks: int, watch: int | None = None) -> np.ndarray:
    """Step; the watched body's position at the start of every tick [tick, 3]."""
    seen = np.zeros((ticks, 3))
    for tick in range(ticks):
        plants.free()
        if watch is not None:
            seen[tick] = plants.state.body_q[watch, :3]
        plants.commit()
    return seen


def standing(trees: list[Tree], **options: float) -> Plants:
    model = assemble(trees)
    plants = Plants(model, State.at_rest(model), **options)
    plants.wake(np.arange(len(trees)))
    return plants


def elastica(load: float, weight: float, rigidity: float) -> tuple[float, float]:
    """Reach and drop of the tip of a horizontal cantilever with tip load [N] and line weight [N/m].

    Euler's elastica: EI theta'' = -(load + weight (L - s)) cos theta, theta(0) = 0, theta'(L) = 0.
    """
    s = np.linspace(0.0, LENGTH, 200)
    start = np.zeros((4, len(s)))
    for share in np.linspace(0.1, 1.0, 10):

        def slope(s: np.ndarray, y: np.ndarray, share: float = share) -> np.ndarray:
            shear = share * (load + weight * (LENGTH - s))
            return np.vstack([y[1], -shear * np.cos(y[0]) / rigidity, np.cos(y[0]), np.sin(y[0])])

        solution = solve_bvp(
            slope, lambda a, b: np.array([a[0], b[1], a[2], a[3]]), s, start, tol=1e-8, max_nodes=20000
        )
        assert solution.success
        start = solution.sol(s)
    return float(start[2, -1]), float(start[3, -1])


def settled_tips(trees: list[Tree]) -> np.ndarray:
    """Where the tips come to rest, seen from the clamps [tree, (x, z)]; dead-beat damping."""
    plants = standing(trees, phi=1.0, dt=0.02)
    run(plants, 1500)
    plants.kinematics()
    assert plants.tree_rate.max() < 1e-3
    tips = np.cumsum(plants.model.tree_size) - 1
    return plants.state.body_q[tips][:, [0, 2]] - np.array([0.0, 5.0])


def test_elastica_under_own_weight() -> None:
    ratios = np.array([0.5, 1.0, 2.0, 4.0])  # w L^3 / EI
    moduli = LINE_WEIGHT * LENGTH**3 / ratios / SECOND_MOMENT
    tips = settled_tips([cane(e, beta=0.3, side=i) for i, e in enumerate(moduli)])
    truth = np.array([elastica(0.0, LINE_WEIGHT, e * SECOND_MOMENT) for e in moduli])
    np.testing.assert_allclose(-tips[:, 1], truth[:, 1], rtol=0.005)
    np.testing.assert_allclose(tips[:, 0], truth[:, 0], rtol=0.005)


def test_elastica_with_a_bunch_on_the_tip() -> None:
    modulus = 5.9e9
    loads = np.array([0.05, 0.1, 0.2, 0.5, 0.8]) * G
    assert loads[-1] * LENGTH**2 / (modulus * SECOND_MOMENT) == pytest.approx(6.6, abs=0.05)  # alpha
    tips = settled_tips([cane(modulus, beta=0.3, tip=load / G, side=i) for i, load in enumerate(loads)])
    truth = np.array([elastica(load, LINE_WEIGHT, modulus * SECOND_MOMENT) for load in loads])
    np.testing.assert_allclose(-tips[:, 1], truth[:, 1], rtol=0.005)
    np.testing.assert_allclose(tips[:, 0], truth[:, 0], rtol=0.01)


def test_frequencies() -> None:
    """First three of a cantilever: beta L solves cos cosh = -1 (dt small enough that time is not the error)."""
    modulus, dt, ticks = 5e9, 0.001, 1 << 15
    roots = [brentq(lambda b: np.cos(b) * np.cosh(b) + 1.0, *span) for span in ((1, 3), (4, 5.5), (7, 8.5))]
    truth = np.square(roots) / (2 * np.pi) * np.sqrt(modulus * SECOND_MOMENT / (DENSITY * AREA)) / LENGTH**2
    plants = standing([cane(modulus)], phi=0.5, dt=dt)
    plants.state.joint_qd[3:5, 2] = 0.3  # a kick to the side, where gravity does not bend
    plants.state.joint_qd[10, 2] = -0.5
    side = run(plants, ticks, watch=PIECES - 1)[:, 1]
    spectrum = np.abs(np.fft.rfft((side - side.mean()) * np.hanning(ticks)))
    seen = []
    for f in truth:
        near = np.arange(int(0.9 * f * ticks * dt), int(1.1 * f * ticks * dt) + 2)
        peak = near[np.argmax(spectrum[near])]
        left, middle, right = np.log(spectrum[peak - 1 : peak + 2])
        seen.append((peak + 0.5 * (left - right) / (left - 2 * middle + right)) / (ticks * dt))
    np.testing.assert_array_less(abs(np.array(seen) / truth - 1.0), [0.01, 0.03, 0.05])


def ring_down(height: np.ndarray, dt: float) -> tuple[float, float]:
    """Frequency [Hz] and damping ratio of a decaying swing."""
    time = np.arange(len(height)) * dt

    def swing(t: np.ndarray, rest: float, size: float, f: float, zeta: float, phase: float) -> np.ndarray:
        w = 2 * np.pi * f
        return rest + size * np.exp(-zeta * w * t) * np.cos(w * np.sqrt(1 - zeta * zeta) * t + phase)

    rest = height[-len(height) // 4 :].mean()
    guess = (rest, height[0] - rest, 2.8, 0.05, 0.0)
    bounds = ((-10, -2, 0.5, -0.5, -7), (10, 2, 10, 0.9, 7))
    values, _ = curve_fit(swing, time, height, p0=guess, bounds=bounds)
    return values[2], values[3]


@pytest.mark.parametrize("zeta", [0.01, 0.02, 0.05, 0.1, 0.2])
def test_damping_seen_is_damping_asked(zeta: float) -> None:
    """At 100 Hz and the shipping phi, in the first mode: joint damping beta K gives zeta = beta w / 2."""
    modulus = 5e9
    w = 1.8751041**2 * np.sqrt(modulus * SECOND_MOMENT / (DENSITY * AREA)) / LENGTH**2
    plants = standing([cane(modulus, beta=2 * zeta / w)])
    assert plants.damping_floor(w / (2 * np.pi)) < 0.01
    height = run(plants, 400, watch=PIECES - 1)[:, 2]
    f, seen = ring_down(height[20:], plants.dt)
    assert seen == pytest.approx(zeta, abs=0.005)
    assert f == pytest.approx(w / (2 * np.pi), rel=0.01)


def test_error_falls_with_the_square_of_the_pieces() -> None:
    """Tip drop under own weight: order of convergence at least 1.8."""
    global PIECES
    modulus = LINE_WEIGHT * LENGTH**3 / SECOND_MOMENT
    truth = elastica(0.0, LINE_WEIGHT, modulus * SECOND_MOMENT)[1]
    errors = []
    for pieces in (4, 8, 16):
        tree = Tree(frames.pose(np.array([0.0, 0.0, 5.0])))
        tree.rod(-1, LENGTH, (RADIUS, RADIUS), Wood(modulus, DENSITY, 0.3), pieces)
        plants = standing([tree], phi=1.0, dt=0.02)
        run(plants, 1500)
        plants.kinematics()
        tip = frames.compose(plants.state.body_q[-1].astype(float), frames.pose([LENGTH / pieces, 0.0, 0.0]))
        errors.append(abs(5.0 - tip[2] - truth))
    assert np.log2(errors[0] / errors[1]) > 1.8
    assert np.log2(errors[1] / errors[2]) > 1.8


@pytest.mark.parametrize(("share", "stands"), [(0.95, True), (1.05, False)])
def test_greenhill(share: float, stands: bool) -> None:
    """A rod of more than the self-buckling length falls over: rho g A L^3 / EI = 9/4 j^2, J_-1/3(j) = 0."""
    critical = 2.25 * brentq(lambda z: jv(-1.0 / 3.0, z), 1.5, 2.2) ** 2
    modulus = LINE_WEIGHT * LENGTH**3 / (critical * share**3 * SECOND_MOMENT)
    plants = standing([cane(modulus, beta=0.05, up=True)])
    plants.state.joint_qd[0, 1] = 0.02
    run(plants, 6000)
    plants.kinematics()
    lean = np.hypot(*plants.state.body_q[PIECES, :2])
    assert lean < 0.02 if stands else lean > 0.2
