"""Events of the vineyard as rows for JSON: what left its plant, and how blades closed.

Rows come from the client that simulated the event. Other clients learn of its result by the network.
"""

from __future__ import annotations

from typing import Any

from vinesim.scene.values import BladeClosing, Detachment
from vinesim.world import Physics


def events_of(physics: Physics) -> list[dict[str, Any]]:
    """Returns the events of the last step: closings of blades first, then detachments."""
    return [*map(_closing, physics.closings), *map(_detachment, physics.detachments)]


def _closing(event: BladeClosing) -> dict[str, Any]:
    return {
        "event": "blade",
        "actor": event.actor,
        "link": event.link,
        "outcome": event.outcome,
        "text": event.sentence,
        "force_n": float(event.force),
        "needed_n": float(event.needed),
        "energy_j": float(event.energy),
        "body": event.body,
        "at_m": float(event.at),
        "diameter_m": float(event.diameter),
        "depth_m": float(event.depth),
        "position": [float(part) for part in event.position],
    }


def _detachment(event: Detachment) -> dict[str, Any]:
    return {
        "event": "detached",
        "cause": event.cause,
        "actor": event.actor,
        "tree": event.tree,
        "body": event.body,
        "bunch": event.bunch,
        "force": [float(part) for part in event.force],
        "moment": [float(part) for part in event.moment],
        "segment": event.segment,
        "at_m": float(event.at),
    }
