"""Faults: everything that was stopped, left out or refused. Each kind is counted, so that no fault remains unnoticed.

A client logs the first fault of each kind; :class:`vinesim.api.simulation.Simulation` warns of it.
"""

from __future__ import annotations

import collections
import logging
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vinesim.client.client import Client

log = logging.getLogger(__name__)

DESCRIPTIONS = {
    "trees_stopped": "trees moved too fast, or their state was not finite; they were reset to rest",
    "trees_slowed": "joints of trees turned faster than max_joint_rate and were slowed down, which removes energy",
    "robots_stopped": "robots or boxes moved too fast, or their state was not finite; they were put back",
    "objects_in_heaps": "objects passed through everything for a step, because many had been put into each other",
    "contacts_dropped": "contacts were left out, because there were more than the capacity",
    "geoms_skipped": "static geoms near a tree were left out, because there are more than max_static_geoms_per_tree",
    "grasps_refused": "hands could not grasp plants, because too many bodies of plants were held already",
    "cuts_moved": "cuts of canes were made at the joint before them, because their trees had no spare body for a stump",
    "couplings_refused": "forces of other actors on plants were refused, because too many bodies were held already",
    "messages_refused": "messages of other actors were refused, because they were malformed or impossible",
    "messages_lost": "messages of other actors were lost on this client, because they were too many or too large",
    "messages_foreign": "messages were dropped, because their session does not own the name that they were sent under",
    "network_failures": "messages could not be sent, because the network refused them or too many waited already",
    "wrenches_refused": "wrenches of other actors were refused, because their hands are elsewhere",
    "meshes_refused": "meshes of other clients were refused, because they were corrupt or too many; boxes replace them",
    "meshes_not_taken": "meshes of this client's robots were refused by the server; other clients show boxes instead",
    "commands_refused": "commands from ROS were refused, because they were contradictory or did not fit the robot",
    "page_messages_refused": "messages of pages were refused, because they were malformed or impossible",
    "steps_skipped": "steps were skipped after a stall of the process",
}
"""Description of each kind of fault, for people."""


def occurred(counts: Mapping[str, int]) -> dict[str, int]:
    """Returns the ``counts`` of faults, by kind, without the kinds that did not occur."""
    return {name: count for name, count in counts.items() if count}


def count_faults(client: Client, steps_skipped: int = 0) -> dict[str, int]:
    """Returns how often each fault of :data:`DESCRIPTIONS` occurred. Faults that did not occur are left out."""
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
    for others in client.other_faults:
        counts.update(others())
    return occurred(counts)


RECENT_TIME = 60.0
"""A fault is recent for this long after its last occurrence [s]."""


class RecentCounts:
    """Tells which of several counters rose within the last :data:`RECENT_TIME`."""

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}
        """The newest value of each counter, by name."""
        self._risen: dict[str, float] = {}
        """Time at which the last rise of each counter was noticed [s]."""

    def update(self, counts: Mapping[str, int], time: float) -> list[str]:
        """Compare the present ``counts``, by name, with earlier ones. Returns the names of the counters that rose
        within the :data:`RECENT_TIME` before ``time`` [s]."""
        self._risen |= {name: time for name, count in counts.items() if count > self.counts.get(name, 0)}
        self.counts = dict(counts)
        return [name for name, risen in self._risen.items() if time - risen < RECENT_TIME]


class FaultLog:
    """Tells of the first fault of each kind, only counts later ones, and knows which kinds occurred recently."""

    def __init__(self, tell: Callable[[str], object] = log.warning) -> None:
        """``tell(text)`` shows one line to a person; the text is logged as a warning unless another function is
        given."""
        self._tell = tell
        self._recent = RecentCounts()

    def update(self, counts: Mapping[str, int], time: float) -> list[str]:
        """Tell of the kinds of faults that are new in ``counts`` at ``time`` [s]. Returns the kinds that occurred
        recently.

        Call it outside the step.
        """
        for name, count in counts.items():
            if name not in self._recent.counts:
                self._tell(f"{count} {DESCRIPTIONS[name]} (further ones are only counted: {name})")
        return self._recent.update(counts, time)
