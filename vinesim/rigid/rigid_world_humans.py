"""Motion of people and the grasps of their hands, by name; part of
:class:`vinesim.rigid.rigid_world.RigidWorld`."""

from __future__ import annotations

import mujoco
import numpy as np

from vinesim.core import frames
from vinesim.rigid.hand_wrenches import hand_wrenches
from vinesim.rigid.human_shapes import PALM_TO_FINGERTIP
from vinesim.rigid.mujoco_world import WorldCore
from vinesim.scene.values import HandSample, HumanPose


class HumanAccess(WorldCore):
    """People of a rigid world. Every method raises :class:`HumanError` if no person or hand has the name given."""

    def move_human(self, name: str, pose: HumanPose) -> None:
        """Set where a person's tracked points are at the end of the coming step, which hands are closed or have
        shears."""
        human = self.human(name)
        busy = [hand.busy for hand in human.hands]
        shears = human.shears_parts
        human.set_pose(pose)
        if shears != human.shears_parts:
            self._list_visuals()
        if busy != [hand.busy for hand in human.hands]:
            human.update_hand_collisions(self.mj_model)
            self._update_geoms()

    def hand_sample(self, name: str, side: str) -> HandSample:
        """A person's ``"left"`` or ``"right"`` hand after the last step."""
        human = self.human(name)
        return human.hand_sample(human.hand(side), self.mj_data)

    def hand_wrenches(self, name: str) -> tuple[dict[str, dict[str, np.ndarray]], tuple[bool, bool]]:
        """Wrenches of a person's hands on robots in the last step; see :mod:`vinesim.rigid.hand_wrenches`."""
        robots = self._robots.items()
        links = {body: (robot, link) for robot, found in robots for link, body in found.bodies.items()}
        return hand_wrenches(self.mj_model, self.mj_data, self.human(name), links)

    # ------------------------------------------------------------------ grasps

    def grasp(self, name: str, side: str, actor: str, link: str) -> None:
        """Weld a hand to a link of an actor, a box or a bunch at its present pose; names are those of
        ``RigidGeoms``."""
        hand = self.human(name).hand(side)
        body = self._body_of_object(actor, link)
        self.update_kinematics()
        pose = np.concatenate([self.mj_data.xpos[[body, hand.body]], self.mj_data.xquat[[body, hand.body]]], -1)
        pose[:, 3:] = frames.from_wxyz(pose[:, 3:])
        hand.grasp_pose = frames.compose(frames.inverse(pose[0]), pose[1])
        hand.held = (actor, link)
        hand.weld_to(self.mj_model, self.mj_data, body)
        self._update_geoms()

    def grasp_plant(self, name: str, side: str, body: int) -> None:
        """Let a hand hold a plant's ``body``: it touches nothing, and :meth:`place_hand` puts it on the plant."""
        hand = self.human(name).hand(side)
        hand.held = ("plants", f"body/{body}")
        hand.weld_to(self.mj_model, self.mj_data, None)
        self._update_geoms()

    def place_hand(self, name: str, side: str, pose: np.ndarray) -> None:
        """Put a hand at ``pose`` [7], at rest."""
        self.human(name).hand(side).place(self.mj_data, pose)
        self._kinematics_current = False

    def release(self, name: str, side: str) -> None:
        """Open a hand."""
        self.human(name).hand(side).release(self.mj_model, self.mj_data)
        self._update_geoms()

    def nearest_to_hand(self, name: str, side: str, reach: float) -> tuple[float, str, str] | None:
        """What a hand can grasp: gap [m], actor and link of the nearest rigid body; None if none is nearer than
        ``reach``.

        The ground and the person's own body are left out.
        """
        hand = self.human(name).hand(side)
        self.update_kinematics()
        m = self.mj_model
        d = self.mj_data
        of_hand = range(m.body_geomadr[hand.body], m.body_geomadr[hand.body] + m.body_geomnum[hand.body])
        best: tuple[float, str, str] | None = None
        for geoms in (self.geoms, self.static_geoms):
            distance = np.linalg.norm(d.geom_xpos[geoms.id] - d.xpos[hand.body], axis=1)
            for i in np.flatnonzero(distance - geoms.radius < reach + PALM_TO_FINGERTIP):
                if geoms.kind[i] != mujoco.mjtGeom.mjGEOM_PLANE and geoms.actor[i] != name:
                    gap = min(mujoco.mj_geomDistance(m, d, geom, int(geoms.id[i]), reach, None) for geom in of_hand)
                    if gap < reach and (best is None or gap < best[0]):
                        best = (gap, geoms.actor[i], geoms.link[i])
        return best
