"""Slots (columns) of the table of bodies [shoot, slot]: one for each segment, bunch or berry cluster.

Every shoot has the same slots: main axis, lateral, and for each of two bunches the peduncle, the bunch and its
clusters.
"""

from __future__ import annotations

from vinesim.scene.builder import MAX_CLUSTERS

AXIS_SEGMENTS = 14
"""Number of bodies of a shoot's main axis."""
LATERAL_SEGMENTS = 4
"""Number of bodies of a lateral (side shoot)."""
PEDUNCLE_SEGMENTS = 2
"""Number of bodies of a peduncle."""
MAX_BUNCHES = 2
"""Largest number of bunches on a shoot."""
MAX_NODES = 25
"""Largest number of leaves on a shoot's main axis."""
LATERAL_NODES = 6
"""Number of leaves of a lateral."""
ARM_SEGMENTS = 5
TRUNK_SEGMENTS = 7

LATERAL_SLOTS = slice(AXIS_SEGMENTS, AXIS_SEGMENTS + LATERAL_SEGMENTS)
CORE_SLOTS = AXIS_SEGMENTS + LATERAL_SEGMENTS + MAX_BUNCHES * (PEDUNCLE_SEGMENTS + 1)
SLOT_COUNT = CORE_SLOTS + MAX_BUNCHES * MAX_CLUSTERS


def peduncle_slots(which: int) -> slice:
    """Returns the slots (columns of the table of bodies) of the segments of peduncle ``which`` (0 or 1), followed by
    the slot of its bunch.
    """
    first = AXIS_SEGMENTS + LATERAL_SEGMENTS + which * (PEDUNCLE_SEGMENTS + 1)
    return slice(first, first + PEDUNCLE_SEGMENTS + 1)


def cluster_slots(which: int) -> slice:
    """Returns the slots (columns of the table of bodies) of the berry clusters of bunch ``which`` (0 or 1)."""
    first = CORE_SLOTS + which * MAX_CLUSTERS
    return slice(first, first + MAX_CLUSTERS)
