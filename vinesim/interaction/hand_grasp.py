"""Grasps of people's hands, which can hold plants, boxes, bunches, robots and static geoms.

A rigid body is welded to the hand. A plant is held by a spring between the grasped point and the tracked controller.
The plant solver solves this spring implicitly with the plant's springs, and the hand's body is placed on the plant. If
a bunch in a hand is detached from its vine, the hand continues to hold it as a rigid body.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.contact.contact_solver import ContactSolver
from vinesim.core import frames
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.ties import TieLimitError
from vinesim.rigid.human_body import HandBody, HumanBody
from vinesim.rigid.human_posture import GRASP_POINTS, HAND_HALF_THICKNESS
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene.values import Contact, Detachment

_NO_TREES = np.zeros(0, int)


@dataclasses.dataclass(slots=True)
class _PlantGrasp:
    """A body of a plant that a hand holds."""

    body: int
    tie: int
    """Index of the hand's spring, see :meth:`ArticulationSolver.add_tie`."""
    point: np.ndarray
    """[3] m, the grasped point in the body's frame."""
    bunch: int
    """Index of the bunch if the body is one, otherwise -1."""


class GraspManager:
    """Closes and opens the hands of local people and connects plants to them."""

    def __init__(self, plants: ArticulationSolver, rigid: RigidWorld, contact_solver: ContactSolver) -> None:
        self.plants = plants
        self.rigid = rigid
        self.contact_solver = contact_solver
        self.contacts: tuple[Contact, ...] = ()
        """Hands that held a plant in the last step, as contacts; their ``distance`` is 0."""
        self.refused_grasps = 0
        """Number of grasps of plants that were refused since the start, because too many bodies were held or one body
        was held by too many hands."""
        self._grasps: dict[tuple[str, str], _PlantGrasp] = {}
        """Held plants, by person and side."""
        self._steps_to_grasp: dict[tuple[str, str], int] = {}
        """Number of steps for which a hand that closed without grasping anything can still grasp, by person and
        side."""
        self._grasp_steps = rigid.parameters.steps(rigid.parameters.grasp_duration)

    @property
    def held_trees(self) -> np.ndarray:
        """[k] Trees that are held, sorted."""
        if not self._grasps:
            return _NO_TREES
        return np.unique([int(self.plants.model.body_tree[grasp.body]) for grasp in self._grasps.values()])

    # ------------------------------------------------------------------ the step

    def begin_step(self) -> None:
        """Close and open hands before a step, and pull the held plants."""
        for human, hand in self._local_hands():
            key = human.spec.name, hand.side
            if key in self._grasps and not hand.on_plant:  # the person left the world and joined again
                self._remove_tie(key)
            if not hand.closed:
                self._steps_to_grasp[key] = self._grasp_steps
                if hand.held is not None:
                    self.release(*key)
            elif hand.held is None and self._steps_to_grasp.get(key, self._grasp_steps) > 0:
                self._steps_to_grasp[key] = self._steps_to_grasp.get(key, self._grasp_steps) - 1
                self._close(human, hand)
            if key in self._grasps:
                self._pull(human, hand, self._grasps[key])
        if self._grasps:
            self.plants.wake(self.held_trees)

    def _follow_cut(self, grasp: _PlantGrasp) -> _PlantGrasp:
        """Returns a grasp of the wood at the grasped point, which belongs to another body after a cut."""
        plants = self.plants
        if plants.state.stump_of[grasp.body] < 0 and plants.body_start[grasp.body] == 0.0:
            return grasp
        parts = plants.stumps.parts_of(plants.stumps.segment_of(grasp.body))
        body = next((body for body, _, end in parts if grasp.point[0] < end), parts[-1][0])
        if body == grasp.body:
            return grasp
        anchor, stiffness, damping = (
            values[grasp.tie].copy() for values in (plants.tie_anchor, plants.tie_stiffness, plants.tie_damping)
        )
        plants.remove_tie(grasp.body, grasp.tie)
        tie = plants.add_tie(body, grasp.point, float(stiffness), float(damping))
        plants.tie_anchor[tie] = anchor
        return dataclasses.replace(grasp, body=body, tie=tie)

    def end_step(self, detachments: tuple[Detachment, ...]) -> None:
        """Place hands on the plants that they hold after a step, and weld detached bunches to the hands that hold
        them."""
        detached = {detachment.body: detachment.bunch for detachment in detachments if detachment.bunch >= 0}
        contacts = []
        if self._grasps:
            self.plants.forward_kinematics(self.held_trees)
        for human, hand in self._local_hands():
            key = human.spec.name, hand.side
            grasp = self._grasps.get(key)
            if grasp is None:
                continue
            if grasp.body in detached:
                self._remove_tie(key)
                self.rigid.release(*key)
                self.rigid.grasp(*key, f"bunch/{detached[grasp.body]}", "bunch")
            elif self._is_bunch_gone(grasp):
                self.release(*key)
            else:
                moved = self._follow_cut(grasp)
                if moved is not grasp:
                    grasp = self._grasps[key] = moved
                    self.rigid.grasp_plant(*key, grasp.body)
                contacts.append(self._place_on_plant(human, hand, grasp))
        self.contacts = tuple(contacts)

    def release(self, name: str, side: str) -> None:
        """Open a hand and release the plant or body in it."""
        self._remove_tie((name, side))
        self.rigid.release(name, side)

    def remove_ties_of(self, name: str) -> None:
        """Release all plants held by a person who is being removed."""
        for key in [key for key in self._grasps if key[0] == name]:
            self._remove_tie(key)

    # ------------------------------------------------------------------ internal

    def _local_hands(self) -> list[tuple[HumanBody, HandBody]]:
        humans = (self.rigid.human(name) for name in self.rigid.humans)
        return [(human, hand) for human in humans if not human.is_remote for hand in human.hands]

    def _close(self, human: HumanBody, hand: HandBody) -> None:
        """Grasp the plant or body nearest to the hand if it is near enough."""
        key = (human.spec.name, hand.side)
        distance = self.rigid.parameters.grasp_distance
        palm = self.rigid.hand_sample(*key).pose
        rigid = self.rigid.nearest_to_hand(*key, distance)
        points = palm[:3] + frames.rotate(palm[3:], GRASP_POINTS)
        plant = self.contact_solver.nearest_body(points, distance + HAND_HALF_THICKNESS)
        if plant is not None and (rigid is None or plant[0] - HAND_HALF_THICKNESS < rigid[0]):
            body = plant[1]
            self.plants.wake(self.plants.model.body_tree[body])
            pose = self.plants.state.body_q[body].astype(float)
            hand.grasp_pose = frames.compose(frames.inverse(pose), palm)
            bunch = np.flatnonzero(self.plants.model.bunch_body == body)
            try:
                tie = self.plants.add_tie(body, hand.grasp_pose[:3], hand.stiffness, hand.damping)
            except TieLimitError:  # the hand holds nothing and does not try again until it opens
                self.refused_grasps += 1
                self._steps_to_grasp[key] = 0
                return
            self._grasps[key] = _PlantGrasp(body, tie, hand.grasp_pose[:3].copy(), next(iter(bunch.tolist()), -1))
            self.rigid.grasp_plant(*key, body)
        elif rigid is not None:
            self.rigid.grasp(*key, *rigid[1:])

    def _pull(self, human: HumanBody, hand: HandBody, grasp: _PlantGrasp) -> None:
        """Set the world end (anchor) of the spring that pulls a held plant to the hand's controller.

        The anchor is so near to the grasped point that the spring's force does not exceed the hand's largest force.
        """
        at = self._grasped_point(grasp)
        velocity = human.controller_velocity(hand, self.rigid.dt)
        pull = human.controller_pose(hand)[:3] + hand.damping / hand.stiffness * velocity - at
        most = hand.max_force / hand.stiffness
        self.plants.tie_anchor[grasp.tie] = at + pull * min(1.0, most / max(float(np.linalg.norm(pull)), 1e-12))

    def _grasped_point(self, grasp: _PlantGrasp) -> np.ndarray:
        """Returns the position [3] m of the grasped point in the world."""
        pose = self.plants.state.body_q[grasp.body].astype(float)
        return pose[:3] + frames.rotate(pose[3:], grasp.point)

    def _place_on_plant(self, human: HumanBody, hand: HandBody, grasp: _PlantGrasp) -> Contact:
        """Place the body of a hand on the plant that the hand holds, and set the force on the hand. Returns this force
        as a contact."""
        plants = self.plants
        pose = plants.state.body_q[grasp.body].astype(float)
        motion = plants.state.body_qd[grasp.body].astype(float)
        self.rigid.place_hand(human.spec.name, hand.side, frames.compose(pose, hand.grasp_pose))
        at = self._grasped_point(grasp)
        velocity = motion[:3] + frames.cross(motion[3:], at - pose[:3])
        hand.force = plants.tie_stiffness[grasp.tie] * (plants.tie_anchor[grasp.tie] - at) - hand.damping * velocity
        hand.steps_since_contact = 0
        return Contact(human.spec.name, hand.link, grasp.body, at, -hand.force, 0.0)

    def _is_bunch_gone(self, grasp: _PlantGrasp) -> bool:
        """Returns whether a held bunch has been detached by another cause, for example by another client."""
        return grasp.bunch >= 0 and not self.plants.state.bunch_attached[grasp.bunch]

    def _remove_tie(self, key: tuple[str, str]) -> None:
        grasp = self._grasps.pop(key, None)
        if grasp is not None:
            self.plants.remove_tie(grasp.body, grasp.tie)
