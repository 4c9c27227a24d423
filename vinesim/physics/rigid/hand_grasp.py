"""Hands that close: they hold what they are at, wherever it grows, lies, stands or drives.

What is rigid is welded to the hand. A plant is held by a spring between the point that the hand holds and the
controller: the spring of the hand itself, solved with the plant's own, and the hand rides on what it holds. When a
bunch leaves its vine in the hand, the hand keeps it.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim import frames
from vinesim.physics.contact.contact_solver import ContactSolver
from vinesim.physics.plants.articulation_solver import ArticulationSolver
from vinesim.physics.rigid.human_body import FINGERS, THICK, HandBody, HumanBody
from vinesim.physics.rigid.rigid_world import RigidWorld
from vinesim.scene.values import Contact, Detachment, Haptic

GRASP = 0.03
"""[m] A hand takes what its palm or its fingers are so close to."""
PATIENCE = 20
"""[tick] So long a hand that has closed on nothing still takes what comes into it; then it is a fist."""
PULSE = 5
"""[tick] A touch that goes on vibrates as often as this."""
FELT = 0.2
"""Amplitude that is surely felt: an onset has at least this."""
FAINT = 0.01
"""Amplitude not worth a message."""

_NOBODY = np.zeros(0, int)


@dataclasses.dataclass(slots=True)
class _Grip:
    """A plant in a hand."""

    body: int
    tie: int
    point: np.ndarray
    """[3] in the body's frame."""
    bunch: int
    """Which bunch the body is, -1 if it is none."""


class GraspManager:
    """What the hands of all people hold, and what their controllers feel of it."""

    def __init__(self, plants: ArticulationSolver, rigid: RigidWorld, contact_solver: ContactSolver) -> None:
        self.plants, self.rigid, self.contact_solver = plants, rigid, contact_solver
        self.haptics: tuple[Haptic, ...] = ()
        """Vibrations of the last tick, by person and hand."""
        self.contacts: tuple[Contact, ...] = ()
        """Hands that held a plant in the last tick, as contacts; their ``distance`` is 0."""
        self._grips: dict[tuple[str, str], _Grip] = {}
        self._waiting: dict[tuple[str, str], int] = {}
        self._known: dict[tuple[str, str], int] = {}

    @property
    def held_trees(self) -> np.ndarray:
        """Trees that somebody holds, sorted [k]."""
        if not self._grips:
            return _NOBODY
        return np.unique([int(self.plants.model.body_tree[grip.body]) for grip in self._grips.values()])

    # ------------------------------------------------------------------ the tick

    def begin_step(self) -> None:
        """Before a tick: close and open hands, and pull at the plants that are held."""
        for person, hand in self._hands():
            key = person.spec.name, hand.side
            if key in self._grips and not hand.on_plant:  # its person left and came back
                self._drop(key)
            if not hand.closed:
                self._waiting[key] = PATIENCE
                if hand.held is not None:
                    self.release(*key)
            elif hand.held is None and self._waiting.get(key, PATIENCE) > 0:
                self._waiting[key] = self._waiting.get(key, PATIENCE) - 1
                self._close(person, hand)
            if key in self._grips:
                self._pull(person, hand, self._grips[key])
        if self._grips:
            self.plants.wake(self.held_trees)

    def end_step(self, partings: tuple[Detachment, ...]) -> None:
        """After a tick: keep bunches that left their vines, put hands where what they hold is, tell what is felt."""
        gone = {parting.body: parting.bunch for parting in partings if parting.bunch >= 0}
        contacts, haptics = [], []
        if self._grips:
            self.plants.forward_kinematics(self.held_trees)
        for person, hand in self._hands():
            key = person.spec.name, hand.side
            if (grip := self._grips.get(key)) is not None:
                if grip.body in gone:
                    self._drop(key)
                    self.rigid.release(*key)
                    self.rigid.grasp(*key, f"bunch/{gone[grip.body]}", "bunch")
                elif not self._torn(grip):
                    contacts.append(self._ride(person, hand, grip))
                else:
                    self.release(*key)
            haptics += self._vibrate(person, hand)
        self.contacts, self.haptics = tuple(contacts), tuple(haptics)

    def release(self, name: str, side: str) -> None:
        """Open a hand, whatever it holds."""
        self._drop((name, side))
        self.rigid.release(name, side)

    def remove_ties_of(self, name: str) -> None:
        """Take all ties off that a person who leaves holds."""
        for key in [key for key in self._grips if key[0] == name]:
            self._drop(key)

    # ------------------------------------------------------------------ inside

    def _hands(self) -> list[tuple[HumanBody, HandBody]]:
        people = (self.rigid.human(name) for name in self.rigid.humans)
        return [(person, hand) for person in people if not person.is_remote for hand in person.hands]

    def _close(self, person: HumanBody, hand: HandBody) -> None:
        """Take what is nearest to the hand, if anything is near enough."""
        key = person.spec.name, hand.side
        palm = self.rigid.hand_sample(*key).pose
        rigid = self.rigid.nearest_to_hand(*key, GRASP)
        plant = self.contact_solver.nearest_body(palm[:3] + frames.rotate(palm[3:], FINGERS), GRASP + THICK)
        if plant is not None and (rigid is None or plant[0] - THICK < rigid[0]):
            body = plant[1]
            self.plants.wake(self.plants.model.body_tree[body])
            pose = self.plants.state.body_q[body].astype(float)
            hand.grasp_pose = frames.compose(frames.inverse(pose), palm)
            bunch = np.flatnonzero(self.plants.model.bunch_body == body)
            tie = self.plants.add_tie(body, hand.grasp_pose[:3], person.spec.stiffness, person.damping)
            self._grips[key] = _Grip(body, tie, hand.grasp_pose[:3].copy(), next(iter(bunch.tolist()), -1))
            self.rigid.grasp_plant(*key, body)
        elif rigid is not None:
            self.rigid.grasp(*key, *rigid[1:])

    def _pull(self, person: HumanBody, hand: HandBody, grip: _Grip) -> None:
        """Set the far end of the spring: no further from the plant than the hand is strong."""
        spec, at = person.spec, self._point(grip)
        pull = person.controller(hand)[:3] + person.damping / spec.stiffness * person.speed(hand, self.rigid.dt) - at
        most = spec.force / spec.stiffness
        self.plants.tie_anchor[grip.tie] = at + pull * min(1.0, most / max(float(np.linalg.norm(pull)), 1e-12))

    def _point(self, grip: _Grip) -> np.ndarray:
        pose = self.plants.state.body_q[grip.body].astype(float)
        return pose[:3] + frames.rotate(pose[3:], grip.point)

    def _ride(self, person: HumanBody, hand: HandBody, grip: _Grip) -> Contact:
        """Put a hand where the plant is that it holds, and say with what force it holds it."""
        plants = self.plants
        pose, motion = plants.state.body_q[grip.body].astype(float), plants.state.body_qd[grip.body].astype(float)
        self.rigid.place_hand(person.spec.name, hand.side, frames.compose(pose, hand.grasp_pose))
        at = self._point(grip)
        speed = motion[:3] + frames.cross(motion[3:], at - pose[:3])
        hand.force = plants.tie_stiffness[grip.tie] * (plants.tie_anchor[grip.tie] - at) - person.damping * speed
        hand.steps_since_contact = 0
        return Contact(person.spec.name, hand.link, grip.body, at, -hand.force, 0.0)

    def _torn(self, grip: _Grip) -> bool:
        """Whether a held bunch is no longer there: picked by other means."""
        return grip.bunch >= 0 and not self.plants.state.bunch_attached[grip.bunch]

    def _drop(self, key: tuple[str, str]) -> None:
        grip = self._grips.pop(key, None)
        if grip is not None:
            self.plants.remove_tie(grip.body, grip.tie)

    def _vibrate(self, person: HumanBody, hand: HandBody) -> list[Haptic]:
        """A pulse when a touch begins, then as strong as the force."""
        key = person.spec.name, hand.side
        if hand.steps_since_contact > 0:
            if hand.steps_since_contact >= PULSE:
                self._known.pop(key, None)
            return []
        since = self._known[key] = self._known.get(key, -1) + 1
        share = min(1.0, float(np.linalg.norm(hand.force)) / person.spec.force)
        seconds = PULSE * self.rigid.dt
        if since == 0:
            return [Haptic(*key, True, max(FELT, share), seconds)]
        return [Haptic(*key, False, share, seconds)] if since % PULSE == 0 and share > FAINT else []
