"""Wrenches of a person's hands on links of robots: from contacts, and from welds of hands that hold one."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np

from vinesim.core import frames
from vinesim.rigid.human_body import HumanBody


def hand_wrenches(
    m: mujoco.MjModel, d: mujoco.MjData, human: HumanBody, links: Mapping[int, tuple[str, str]]
) -> tuple[dict[str, dict[str, np.ndarray]], tuple[bool, bool]]:
    """Wrenches of the last step by robot and link, and which hands applied one (left, right).

    ``links`` names the MuJoCo bodies of robots: robot and link. A wrench [6] is a force [N] and a moment about the
    link's centre of mass [N m], world axes, at the poses of the step's start.
    """
    wrenches: dict[str, dict[str, np.ndarray]] = {}
    applying = {hand.body: False for hand in human.hands}

    def add(hand: int, body: int, force: np.ndarray, moment: np.ndarray, at: np.ndarray) -> None:
        robot, link = links[body]
        wrench = np.concatenate([force, moment + frames.cross(at - d.xipos[body], force)])
        here = wrenches.setdefault(robot, {})
        here[link] = here.get(link, 0.0) + wrench
        applying[hand] = True

    if d.ncon:
        bodies = m.geom_bodyid[d.contact.geom]
        wrench = np.zeros(6)
        for number in np.flatnonzero(np.isin(bodies, list(applying)).any(1)).tolist():
            one, other = bodies[number].tolist()
            hand, body, sign = (one, other, 1.0) if one in applying else (other, one, -1.0)
            if body in links and d.contact.efc_address[number] >= 0:
                mujoco.mj_contactForce(m, d, number, wrench)
                axes = d.contact.frame[number].reshape(3, 3)
                add(hand, body, sign * wrench[:3] @ axes, sign * wrench[3:] @ axes, d.contact.pos[number])
    for hand in human.hands:
        if d.eq_active[hand.weld] and (body := int(m.eq_obj2id[hand.weld])) in links:
            pull = -d.qfrc_constraint[hand.dofs]
            turn = frames.from_wxyz(d.xquat[hand.body])
            add(hand.body, body, pull[:3], frames.rotate(turn, pull[3:]), d.xpos[hand.body])
    left, right = applying.values()
    return wrenches, (left, right)
