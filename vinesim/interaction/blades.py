"""Blades that close: the edges move, the force follows their depth in the wood, and the wood is held while they close.

One closing takes several steps. The edges approach each other with the blade's speed until they meet, until the wood
takes more force than the blade has (the blade stalls), or until a wire, a post or old wood is between them (the blade
is blocked). :mod:`vinesim.interaction.cutting_force` has the laws.

The wood between the edges cannot pass them, and wood that they have bitten into does not slide: a spring holds it,
whose force acts on the plant and, in the same step, with opposite sign on the link that carries the blade. The two
edges press on the wood with equal and opposite forces, which cancel. That the edges of a bypass blade pass each other
at a distance, so that their forces also twist the wood, is not modelled.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from vinesim.core import frames
from vinesim.interaction.cutting_force import (
    BLADE_FACTORS,
    KERF,
    SAW_FORCE,
    SAW_RATE,
    energy_to_depth,
    force_share,
    remaining_strength,
)
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.ties import TieLimitError
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene.values import Contact, Detachment

GRIP_STIFFNESS = 1000.0
"""[N/m] Stiffness of the spring that holds wood between the edges. GUESSED: a sixteenth of 4 m / dt^2, from which on a
hand of 0.4 kg would be unstable at 10 ms."""
GRIP_DAMPING = 10.0
"""[N s/m] Damping of that spring. GUESSED."""
GRIP_FORCE = 100.0
"""[N] Largest force of that spring. GUESSED: more would pull the wood out of the edges."""
GAP_STEP = 5e-5
"""[m] Distance between two gaps at which the force of a closing is evaluated."""


@dataclasses.dataclass(slots=True)
class WoodPiece:
    """Wood between the edges of a closing blade."""

    body: int
    """Body nearest to the root of those of its branch that are in the mouth."""
    bunch: int
    """Index of the bunch to whose peduncle it belongs, -1 for a cane."""
    segment: int
    """Body that the edges cut."""
    at: float
    """[m] Place of the cut along this body."""
    diameter: float
    """[m] Diameter at that place."""
    force: float
    """[N] Largest force of a whole cut there, for a bypass blade."""
    kept: float
    """[1] Depth of the cut that an earlier closing has left there, as a share of the diameter."""
    depth: float
    """[1] Depth that the edges have reached."""
    floats: bool
    """Whether the wood was cut off below before."""
    point: np.ndarray
    """[3] m, the place of the cut in the frame of the mouth when it was last free."""


@dataclasses.dataclass(slots=True)
class Blade:
    """The mouth of a cutter: a box fixed to a link. When the blade closes, it cuts the wood that passes through the
    box."""

    actor: str
    link: str
    pose: np.ndarray
    """[7] pose of the mouth's centre in the link: x along the blades, y from blade to blade, z across their plane."""
    half: np.ndarray
    """[3] m, half edges of the mouth. Wood within ``half[1]`` of the centre, in the closing direction, is caught."""
    limit: float = np.inf
    """[N] Force that the cutter has."""
    speed: float = np.inf
    """[m/s] Speed with which the edges approach each other. Infinite: they close within a step."""
    kind: str = "bypass"
    """``bypass``, ``anvil`` or ``saw``, see :data:`~vinesim.interaction.cutting_force.BLADE_FACTORS`."""
    force: float = np.inf
    """[N] Largest force of the present or last closing."""
    closing: bool = False
    gap: float = 0.0
    """[m] Distance between the edges in the present closing, or where the last one ended."""
    closures: int = 0
    """Number of closings that have ended so far."""
    detachments: tuple[Detachment, ...] = ()
    """Parts that the blade cut off when it last closed."""
    resistance: float = 0.0
    """[N] Force that closing takes, at its largest, with the wood in the mouth at the last closing, whether the wood
    was cut or not; 0 for an empty mouth."""
    peak: float = 0.0
    """[N] Largest force that the last closing exerted."""
    energy: float = 0.0
    """[J] Energy that the last closing put into the wood."""
    stalled: bool = False
    """Whether the last closing ended before the edges met."""
    outcome: str = ""
    """What came of the last closing, as a sentence without a name; empty before the first."""
    pieces: list[WoodPiece] = dataclasses.field(default_factory=list)
    """Wood between the edges of the present closing."""

    @property
    def opening(self) -> float:
        """[m] Distance between the edges of the open blade."""
        return 2.0 * float(self.half[1])

    def close(self, force: float = np.inf) -> None:
        """Begin to close with at most ``force`` [N]. The blade opens again when the closing has ended. A blade that
        closes already goes on, with the new force. Raises :class:`ValueError` unless the force is above 0."""
        if not force > 0.0:
            raise ValueError(f"a blade closes with {force:g} N; give more than 0")
        self.force = min(force, self.limit)
        if not self.closing:
            self.closing = True
            self.gap = self.opening
            self.resistance = self.peak = self.energy = 0.0
            self.stalled = False

    def open(self) -> None:
        """Open, and leave the wood as deep as it is cut."""
        self.closing = False

    def advance(self, goal: float, dt: float, energy_share: float) -> bool:
        """Move the edges from :attr:`gap` towards ``goal`` [m] and cut into :attr:`pieces`. Returns whether the blade
        stalled on the way. ``energy_share``: see :func:`cutting_energy`; ``dt`` [s] counts for saws."""
        wood = self.pieces
        if self.kind == "saw":
            reached, stalled = self._saw_to(goal, dt)
        else:
            reached, stalled = self._shear_to(goal, energy_share)
        for piece in wood:
            before = max(piece.depth, piece.kept)
            piece.depth = max(piece.depth, _depth(piece.diameter, reached))
            after = max(piece.depth, piece.kept)
            if self.kind != "saw":
                work = energy_to_depth(np.array([before, after]), energy_share)
                factor = BLADE_FACTORS[self.kind]
                self.energy += factor * piece.force * piece.diameter * float(work[1] - work[0])
        self.gap = reached
        return stalled

    def describe(self, obstacle: str, thickest: WoodPiece | None) -> str:
        """Returns what came of a closing, without the name of the blade. ``obstacle``: what is between the edges and
        cannot be cut; empty for nothing. ``thickest``: the thickest wood between them."""
        if obstacle:
            return f"is blocked by {obstacle}; nothing was cut off"
        if thickest is None:
            return "missed: there was no wood between the blades"
        size = 1e3 * thickest.diameter
        if self.stalled:
            depth = size * max(thickest.depth, thickest.kept)
            return (
                f"stalled: this wood takes {self.resistance:,.0f} N, the blades close with {self.force:,.0f} N; "
                f"they cut {depth:.1f} of {size:.1f} mm"
            )
        return f"cut wood of {size:.1f} mm with {self.peak:,.0f} N"

    def _shear_to(self, goal: float, energy_share: float) -> tuple[float, bool]:
        """Returns the gap [m] that the edges reach on the way to ``goal`` [m], and whether they stall there."""
        count = max(int(np.ceil(self.gap / GAP_STEP)), 1) + 1
        gaps = np.linspace(self.gap, 0.0, count)
        needed = self._needed(gaps, energy_share)
        self.resistance = max(self.resistance, float(needed.max()))
        gaps = np.append(gaps[gaps > goal], goal)
        needed = self._needed(gaps, energy_share)
        too_much = np.flatnonzero(needed > self.force)
        if len(too_much) == 0:
            self.peak = max(self.peak, float(needed.max()))
            return goal, False
        first = int(too_much[0])
        if first == 0:
            return self.gap, True
        low = gaps[first]
        high = gaps[first - 1]
        for _ in range(40):
            middle = 0.5 * (low + high)
            is_possible = self._needed(np.array([middle]), energy_share)[0] <= self.force
            low, high = (low, middle) if is_possible else (middle, high)
        self.peak = max(self.peak, float(needed[:first].max()), float(self._needed(np.array([high]), energy_share)[0]))
        return float(high), True

    def _needed(self, gaps: np.ndarray, energy_share: float) -> np.ndarray:
        """Returns the force [gap] N of all wood on the edges at these gaps [gap] m."""
        total = np.zeros(len(gaps))
        for piece in self.pieces:
            depth = _depths(piece.diameter, gaps)
            total += np.where(depth > piece.kept, piece.force * force_share(depth, energy_share), 0.0)
        return total * BLADE_FACTORS[self.kind]

    def _saw_to(self, goal: float, dt: float) -> tuple[float, bool]:
        """Returns the gap [m] that a saw reaches within ``dt`` [s] on the way to ``goal`` [m], and whether it is
        pressed too weakly to cut."""
        if not any(_depth(piece.diameter, goal) > piece.kept for piece in self.pieces):
            return goal, False
        self.resistance = max(self.resistance, SAW_FORCE)
        touch = max(piece.diameter * (1.0 - max(piece.kept, piece.depth)) for piece in self.pieces)
        start = min(self.gap, touch)
        if self.force < SAW_FORCE:
            return start, True
        self.peak = max(self.peak, SAW_FORCE)
        room = self._uncut(start) - SAW_RATE * dt
        if self._uncut(goal) >= room:
            return goal, False
        low = goal
        high = start
        for _ in range(40):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if self._uncut(middle) >= room else (middle, high)
        return high, False

    def _uncut(self, gap: float) -> float:
        """Returns the area [m^2] of the wood that is not cut when the edges are at ``gap`` [m]."""
        return sum(
            0.25 * np.pi * piece.diameter**2 * remaining_strength(max(_depth(piece.diameter, gap), piece.kept))[0]
            for piece in self.pieces
        )


def _depths(diameter: float, gaps: np.ndarray) -> np.ndarray:
    """Returns how deep edges at distances ``gaps`` [gap] m are in wood of ``diameter`` [m], from both sides, as
    shares [gap] of the diameter."""
    return np.maximum(1.0 - gaps / diameter, 0.0)


def _depth(diameter: float, gap: float) -> float:
    """Returns the same as :func:`_depths` for one ``gap`` [m]."""
    return max(1.0 - gap / diameter, 0.0)


class BladeGrips:
    """Holds the wood between the edges of closing blades, and lets the links of the blades feel it."""

    def __init__(self, plants: ArticulationSolver, rigid: RigidWorld) -> None:
        self.plants = plants
        self.rigid = rigid
        self.contacts: tuple[Contact, ...] = ()
        """Wood that blades held in the last step, as contacts with a distance of 0."""
        self._held: dict[tuple[int, int], tuple[Blade, int, float, int]] = {}
        """For each blade (its ``id``) and body that it holds: blade, body, place [m] along it, and the spring, see
        :meth:`ArticulationSolver.add_tie`."""

    def begin_step(self, blades: Sequence[Blade]) -> None:
        """Before a step: hold the wood that the edges touch, where the blades are now, and release all other wood."""
        self.contacts = ()
        if not self._held and not any(blade.closing and blade.pieces for blade in blades):
            return
        anchors = {
            (id(blade), piece.segment): (blade, piece, anchor)
            for blade in blades
            if blade.closing
            for piece in blade.pieces
            if (anchor := self._anchor(blade, piece)) is not None
        }
        for key, (_, segment, at, tie) in list(self._held.items()):
            if key not in anchors or abs(anchors[key][1].at - at) > KERF:
                self._remove(segment, tie, key)
        for key, (blade, piece, anchor) in anchors.items():
            if key not in self._held:
                try:
                    along = np.array([piece.at, 0.0, 0.0])
                    tie = self.plants.add_tie(piece.segment, along, GRIP_STIFFNESS, GRIP_DAMPING)
                except TieLimitError:  # too many bodies are held: this wood is cut without being held
                    continue
                self._held[key] = blade, piece.segment, piece.at, tie
            _, segment, at, tie = self._held[key]
            here = self._place(segment, at)
            pull = anchor - here
            most = min(GRIP_FORCE, blade.force) / GRIP_STIFFNESS
            self.plants.tie_anchor[tie] = here + pull * min(1.0, most / max(float(np.linalg.norm(pull)), 1e-12))
        if self._held:
            self.plants.wake(self._trees())

    def react(self) -> np.ndarray | None:
        """After the plants were integrated: returns the generalised force [dof] of the held wood on the links of the
        blades; None if no blade holds wood. The same forces are in :attr:`contacts`."""
        if not self._held:
            return None
        plants = self.plants
        plants.forward_kinematics(self._trees())
        total = np.zeros(self.rigid.mj_model.nv)
        contacts = []
        for blade, segment, along, tie in self._held.values():
            at = self._place(segment, along)
            pose = plants.state.body_q[segment].astype(float)
            motion = plants.state.body_qd[segment].astype(float)
            velocity = motion[:3] + np.cross(motion[3:], at - pose[:3])
            force = GRIP_DAMPING * velocity - GRIP_STIFFNESS * (plants.tie_anchor[tie] - at)
            total += self.rigid.generalised_force(blade.actor, blade.link, force, at)
            contacts.append(Contact(blade.actor, blade.link, segment, at, force, 0.0))
        self.contacts = tuple(contacts)
        return total

    def release_all(self, blade: Blade) -> None:
        """Release the wood of a blade that is being removed."""
        for key, (one, segment, _, tie) in list(self._held.items()):
            if one is blade:
                self._remove(segment, tie, key)

    def _trees(self) -> np.ndarray:
        """Returns the trees that blades hold [k]."""
        return np.unique([int(self.plants.model.body_tree[segment]) for _, segment, _, _ in self._held.values()])

    def _remove(self, segment: int, tie: int, key: tuple[int, int]) -> None:
        self.plants.remove_tie(segment, tie)
        del self._held[key]

    def _anchor(self, blade: Blade, piece: WoodPiece) -> np.ndarray | None:
        """Returns where the edges hold wood [3] m in the world; None if the wood is free between them."""
        mouth = frames.compose(self.rigid.link_pose(blade.actor, blade.link), blade.pose)
        if blade.gap < piece.diameter:
            held = np.array([piece.point[0], 0.0, piece.point[2]])
        else:
            here = frames.rotate(frames.conjugate(mouth[3:]), self._place(piece.segment, piece.at) - mouth[:3])
            room = 0.5 * (blade.gap - piece.diameter)
            if abs(here[1]) <= room:
                return None
            held = np.array([here[0], np.clip(here[1], -room, room), here[2]])
        return mouth[:3] + frames.rotate(mouth[3:], held)

    def _place(self, segment: int, at: float) -> np.ndarray:
        """Returns the position [3] m in the world of a place ``at`` [m] along a body."""
        pose = self.plants.state.body_q[segment].astype(float)
        return pose[:3] + frames.rotate(pose[3:], np.array([at, 0.0, 0.0]))
