"""What pages draw over the picture on demand: contact forces, and who owns which tree, bunch or box."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vinesim.client.client import Client
from vinesim.scene.ids import object_name
from vinesim.scene.values import Contact

MAX_CONTACTS = 300
"""Contacts of which a page is told, those with the largest forces."""


def owners(client: Client) -> dict[str, str]:
    """Names of the actors that own something now, by the name of the object."""
    found = {}
    for replicator in client.replicators.values():
        for number in sorted(replicator.known):
            if (owner := replicator.owner(number)) is not None:
                found[object_name(number)] = owner
    return found


def contact_arrays(contacts: Sequence[Contact]) -> dict[str, np.ndarray]:
    """Places [k, 3] m of contacts with plants, and the forces [k, 3] N on the plants there."""
    force = -np.array([contact.force for contact in contacts], np.float32).reshape(-1, 3)
    place = np.array([contact.position for contact in contacts], np.float32).reshape(-1, 3)
    strongest = np.argsort(-np.linalg.norm(force, axis=1), kind="stable")[:MAX_CONTACTS]
    return {"contact_place": place[strongest], "contact_force": force[strongest]}
