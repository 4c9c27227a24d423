"""Faults of a client so far: what was stopped, left out or refused, so that nothing goes wrong in silence."""

from __future__ import annotations

import collections
import logging
from collections.abc import Mapping

from vinesim.client.client import Client

log = logging.getLogger(__name__)

DESCRIPTIONS = {
    "trees_stopped": "trees moved too fast, or by a number that is not finite, and were put to rest",
    "trees_slowed": "trees turned faster than max_joint_rate and were slowed below it, which takes energy from them",
    "robots_stopped": "robots or boxes moved by a number that is not finite, or too fast, and were put back",
    "contacts_dropped": "contacts were left out, as there were more than there is room for",
    "geoms_skipped": "static geoms near a tree were left out, as there are more than max_static_geoms_per_tree",
    "grasps_refused": "hands closed on plants in vain, as too many bodies of plants were held",
    "couplings_refused": "forces of other actors on plants were refused, as too many bodies of plants were held",
    "messages_refused": "messages of other actors were refused, as they were malformed or cannot be true",
    "messages_lost": "messages of other actors were lost here, as they were too many to be read, or too large",
    "messages_foreign": "messages were dropped, as their session does not hold the name that they came under",
    "network_failures": "messages could not be sent, as the network refused them or too many waited already",
    "wrenches_refused": "wrenches of other actors were refused, as their hands are elsewhere",
    "meshes_refused": "meshes of other clients were refused, as they were corrupt or too many: they stay boxes",
    "meshes_not_taken": "meshes of robots here were not taken by the server: others see boxes in their place",
    "commands_refused": "commands from ROS were refused, as they contradict themselves or what the robot has",
    "page_messages_refused": "messages of pages were refused, as they were malformed or cannot be true",
    "steps_skipped": "steps were skipped after the process had stood still",
}
"""What each fault is, for a person."""


def count_faults(client: Client, steps_skipped: int = 0) -> dict[str, int]:
    """How often each fault of :data:`DESCRIPTIONS` occurred; faults that did not are left out."""
    counters = [replicator.counters for replicator in client.replicators.values()]
    physics = client.physics.faults | {"couplings_refused": client.couplings.refused}
    counts = client.earlier_faults + collections.Counter(physics)
    counts.update(
        {
            "messages_refused": sum(one.malformed for one in counters),
            "messages_lost": sum(one.lost for one in counters),
            "messages_foreign": sum(one.foreign for one in counters),
            "network_failures": sum(one.network_failures for one in counters),
            "wrenches_refused": sum(one.wrenches_refused for one in counters),
            "meshes_refused": client.meshes.refused_count,
            "meshes_not_taken": client.meshes.refused_offers,
            "steps_skipped": steps_skipped,
        }
    )
    for others in client.faults_elsewhere:
        counts.update(others())
    return {name: count for name, count in counts.items() if count}


RECENT_TIME = 60.0
"""A fault is recent for this long after its last occurrence [s]."""


class RecentCounts:
    """Which of several counts rose lately."""

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}
        """The newest."""
        self._risen: dict[str, float] = {}
        """Time at which each was last seen to have risen [s]."""

    def update(self, counts: Mapping[str, int], time: float) -> list[str]:
        """Take the ``counts`` at ``time`` [s]; the names of those that rose within the last :data:`RECENT_TIME`."""
        self._risen |= {name: time for name, count in counts.items() if count > self.counts.get(name, 0)}
        self.counts = dict(counts)
        return [name for name, risen in self._risen.items() if time - risen < RECENT_TIME]


class FaultLog:
    """Logs the first fault of each kind, later ones are only counted; knows which kinds occurred lately."""

    def __init__(self) -> None:
        self._recent = RecentCounts()

    def update(self, counts: Mapping[str, int], time: float) -> list[str]:
        """Log what is new in ``counts`` at ``time`` [s]; the kinds that are recent. Call it outside the step."""
        for name, count in counts.items():
            if name not in self._recent.counts:
                log.warning("%d %s (further ones are only counted: %s)", count, DESCRIPTIONS[name], name)
        return self._recent.update(counts, time)
