"""Forces on buds: contacts of rigid bodies with a cane at the place of a bud.

Buds have no collision shapes of their own. A contact at the same place along the cane, on whichever side, counts as one
with the bud, because what squeezes a cane there crushes or rubs off its bud.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from vinesim.core import frames
from vinesim.scene.model import Model
from vinesim.scene.state import State
from vinesim.scene.values import Contact

BUD_MARGIN = 0.003
"""[m] Distance along the cane from the end of a bud up to which a contact counts as one with it. GUESSED."""


def bud_forces(model: Model, state: State, contacts: Iterable[Contact]) -> np.ndarray:
    """Returns the force on each bud [bud] N: the sum of the magnitudes of the contact forces at its place.

    Args:
        model: the vineyard; its :attr:`~vinesim.scene.model.Model.nodes` have the buds.
        state: poses of plant bodies, and cuts.
        contacts: contacts of rigid bodies with plants.
    """
    nodes = model.nodes
    has = np.flatnonzero(nodes.bud >= 0)
    forces = np.zeros(len(has))
    if not len(has):
        return forces
    pose = nodes.bud_pose[has].astype(float)
    way = frames.rotate(pose[:, 3:], np.array([1.0, 0.0, 0.0]))
    half = 0.5 * nodes.bud_length[has] * way[:, 0]
    middle = pose[:, 0] + half
    reach = half + BUD_MARGIN
    by_body: dict[int, list[int]] = {}
    carrier = nodes.carriers(state.stump_of, state.stump_end)[has]
    for row, body in enumerate(carrier.tolist()):
        by_body.setdefault(body, []).append(row)
    for contact in contacts:
        # a bud at the end of a segment reaches into the next one
        for body in (contact.body, int(model.body_parent[contact.body])):
            rows = by_body.get(body)
            if not rows:
                continue
            at = state.body_q[body].astype(float)
            local = frames.rotate(frames.conjugate(at[3:]), contact.position - at[:3])
            near = [row for row in rows if abs(local[0] - middle[row]) <= reach[row]]
            forces[nodes.bud[has[near]]] += float(np.linalg.norm(contact.force))
    return forces
