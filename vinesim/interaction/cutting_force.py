"""The force that blades need to cut wood: laws of diameter and depth, and the published figures behind them.

All published figures are from the abstracts of the papers; their tables and regressions could not be read. No abstract
gives the diameters of the canes. The ratio of a paper's force and strength implies them.

* Canes with leaves, Okuzgozu, JKSUS 2024 36:103034: 13.16 MPa, 775 N and 5.94 J at veraison, 9.63 MPa, 568 N and 3.33 J
  at harvest.
* Dormant canes, Ozdemir et al. 2015, Sci. Papers B Hort. LIX: 13.94 MPa, 982 N and 2.39 J (Tannat) to 21.68 MPa, 1,398
N
  and 3.68 J (Cabernet Franc).
* Pruning in spring, Bogazkere, Sessiz et al. 2019, Sci. Papers B Hort. LXIII: 9.34 MPa, 264 N and 2.70 J with a flat
  blade. More energy than force times diameter: other work than cutting must be in it, so it is not used.
* Peduncles: none found, see :data:`PEDUNCLE_STRENGTH`.

The regression of shear force on diameter of Bu et al. 2025, BioResources 20(3):6662, is not in its abstract and is not
used.
"""

from __future__ import annotations

import functools
import math

import numpy as np

CANE_STRENGTH = 13.16e6
"""[Pa] Largest cutting force per cross-section of a cane with leaves. READ: Okuzgozu at veraison, JKSUS 2024 36:103034
(abstract), measured with a testing machine. Validity: forces of 386 to 995 N, which are diameters of 6.1 to 9.8 mm."""
DORMANT_STRENGTH = 17.8e6
"""[Pa] The same of a dormant cane. DERIVED: the middle between eight wine cultivars, 13.94 to 21.68 MPa, Ozdemir et al.
2015 (abstract). Validity: forces of 982 to 1,398 N, which are diameters of 9.1 to 9.5 mm."""
PEDUNCLE_STRENGTH = 4.8e6
"""[Pa] The same of a bunch's peduncle. GUESSED: no cutting force of grape peduncles was found. It is the strength at
which a strawberry's peduncle takes its 15 N (arXiv 2207.12552, READ) if that is 2 mm thick. Peduncles of 3 to 5.6 mm
then take 34 to 118 N."""
CHORD_ENERGY_SHARE = 0.25 * math.pi
"""[1] Cutting energy per force and diameter, if the force is proportional to the chord of the section at the edge.
DERIVED. For the forces of 386 and 995 N of JKSUS 2024 36:103034 it gives the energies of 1.85 and 7.34 J within 0.1 and
5 %; for the means at veraison and harvest 11 % too little and 16 % too much."""
DORMANT_ENERGY_SHARE = 0.27
"""[1] The same of dormant canes. DERIVED: 0.257 and 0.291 from force, strength and energy of Tannat and Cabernet Franc,
Ozdemir et al. 2015 (abstract)."""
BLADE_FACTORS = {"bypass": 1.0, "anvil": 1.15, "saw": 0.0}
"""[1] Force of each kind of blade relative to a blade that passes a counter edge. The blades of the papers are such
blades. An anvil's blade also crushes the wood; 1.15 is GUESSED. Only for comparison: thick serrated blades take 1.67
times the force of thin flat ones (440 and 264 N at 6 mm, Sessiz et al. 2019, abstract). A saw does not shear; see
:data:`SAW_FORCE`."""
SAW_FORCE = 40.0
"""[N] Force with which a saw must be pressed on the wood, for any diameter. GUESSED for a hand saw."""
SAW_RATE = 7e-5
"""[m^2/s] Cross-section that a saw cuts in a second. GUESSED: a hand saw takes 10 s for old wood of 30 mm."""
KERF = 1e-3
"""[m] Distance along the wood within which a blade enters the cut that an earlier closing has left. GUESSED: the
thickness of a blade."""
_NODES = 4001


def shear_force(diameter: float, strength: float = CANE_STRENGTH) -> float:
    """Returns the largest force [N] while a blade cuts round wood of ``diameter`` [m]: cross-section times
    ``strength`` [Pa].

    The papers support it in that one diameter explains two strengths each: 8.66 and 8.67 mm for canes at veraison and
    harvest (JKSUS 2024 36:103034), 5.99 and 6.00 mm for two blades (Sessiz et al. 2019).
    """
    return strength * 0.25 * math.pi * diameter * diameter


def cutting_energy(diameter: float, strength: float = CANE_STRENGTH, share: float = CHORD_ENERGY_SHARE) -> float:
    """Returns the energy [J] that a cut through wood of ``diameter`` [m] takes: ``share`` of largest force times
    diameter. Validity: as the strength and the share."""
    return share * shear_force(diameter, strength) * diameter


def force_share(depth: float | np.ndarray, share: float = CHORD_ENERGY_SHARE) -> np.ndarray:
    """Returns the force as a share of the largest force, when the edge has come to ``depth``, as a share of the
    diameter, of wood whose cut takes the energy ``share``.

    It is the chord of a circle, raised to the power with which the energy is right. The shape is an assumption; no
    paper shows force over depth.
    """
    inside = np.clip(np.asarray(depth, float), 0.0, 1.0)
    return np.asarray((4.0 * inside * (1.0 - inside)) ** energy_exponent(share))


def energy_to_depth(depth: float | np.ndarray, share: float = CHORD_ENERGY_SHARE) -> np.ndarray:
    """Returns the integral of :func:`force_share` from 0 to ``depth``: the energy, per largest force and diameter. It
    ends at ``share``."""
    nodes, energy = _energy_table(share)
    return np.asarray(np.interp(depth, nodes, energy))


def peak_beyond(depth: float, share: float = CHORD_ENERGY_SHARE) -> float:
    """Returns the largest value of :func:`force_share` from ``depth`` on: what a cut that is ``depth`` deep already
    still takes."""
    return float(force_share(max(depth, 0.5), share))


def remaining_strength(depth: float) -> tuple[float, float]:
    """Returns what a cut leaves of round wood: the share of the cross-section, which pull needs, and the share of the
    section modulus, which bending needs. ``depth``: depth of the cut as a share of the diameter.

    What remains is a segment of a circle. Its section modulus is that for bending that opens the cut, about the
    segment's own centre.
    """
    if depth <= 0.0:
        return 1.0, 1.0
    if depth >= 1.0:
        return 0.0, 0.0
    # the unit circle, cut from above; y is the height above its centre
    top = 1.0 - 2.0 * depth
    half = math.acos(-top)  # half the angle of the remaining segment, seen from the centre
    area = half - math.sin(half) * math.cos(half)
    first = -2.0 / 3.0 * math.sin(half) ** 3
    second = 0.25 * (half - 0.25 * math.sin(4.0 * half))
    centre = first / area
    own = second - area * centre * centre
    modulus = own / max(top - centre, centre + 1.0)
    return area / math.pi, modulus / (0.25 * math.pi)


def saw_time(diameter: float) -> float:
    """Returns the time [s] that a saw takes for wood of ``diameter`` [m]: cross-section by :data:`SAW_RATE`."""
    return 0.25 * math.pi * diameter * diameter / SAW_RATE


@functools.cache
def energy_exponent(share: float) -> float:
    """Returns the power p with which the integral of (4 s (1 - s))^p over s from 0 to 1 is ``share``. Raises
    :class:`ValueError` unless the share is between 0.01 and 1."""
    if not 0.01 <= share < 1.0:
        raise ValueError(f"a cutting energy of {share} of force times diameter; give 0.01 to 1")
    low = 0.0
    high = 1e4
    for _ in range(200):
        middle = 0.5 * (low + high)
        integral = math.exp(middle * math.log(4.0) + 2.0 * math.lgamma(middle + 1.0) - math.lgamma(2.0 * middle + 2.0))
        low, high = (middle, high) if integral > share else (low, middle)
    return 0.5 * (low + high)


@functools.cache
def _energy_table(share: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns depths [node] and the integrals of :func:`force_share` up to them."""
    # nodes are dense at both ends, where the slope of the chord is infinite
    nodes = 0.5 * (1.0 - np.cos(np.linspace(0.0, math.pi, _NODES)))
    middle = 0.5 * (nodes[1:] + nodes[:-1])
    ends = force_share(nodes, share)
    steps = np.diff(nodes) * (ends[1:] + ends[:-1] + 4.0 * force_share(middle, share)) / 6.0
    energy = np.append(0.0, np.cumsum(steps))
    return nodes, energy * (share / energy[-1])
