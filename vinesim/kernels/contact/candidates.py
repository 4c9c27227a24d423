"""The result of the narrowphase for one contact, and functions that both narrowphases use."""

import warp as wp

from vinesim.kernels.contact.structs import Candidates

wp.set_module_options({"enable_backward": False})

MIN_NORMAL_COSINE = wp.constant(wp.float64(0.5))
"""[1] Least cosine between the normals before and after a step for which the contact moves smoothly. TUNED."""


@wp.struct
class Candidate:
    """A contact between a capsule and another shape that may touch in the step."""

    exists: wp.bool
    """Whether capsule and shape may touch before the step ends."""
    is_impact: wp.bool
    gap: wp.float64
    end_gap: wp.float64
    normal: wp.vec3d
    point: wp.vec3d


@wp.func
def is_smooth(normal: wp.vec3d, end_normal: wp.vec3d):
    """Returns whether the normal of a contact turns so little in the step that the contact stays on the same side of
    the other shape.
    """
    return wp.dot(normal, end_normal) > MIN_NORMAL_COSINE


@wp.func
def curvature_gap(distance: wp.float64, end_distance: wp.float64, approach: wp.float64, motion: wp.float64):
    """Returns the change of distance [m] in a step minus the change at constant velocity.

    The result is limited to the relative ``motion`` [m] of the two sides. ``approach`` [m]: change of distance at
    constant velocity; negative if the sides approach each other.
    """
    return wp.clamp(end_distance - distance - approach, -motion, motion)


@wp.func
def store_candidate(row: int, slot: int, feature: int, other: int, candidate: Candidate, candidates_out: Candidates):
    """Write a candidate contact to the entry ``row``, ``slot`` of the table of candidates [awake tree, slot], unless
    the table has no such slot.
    """
    if slot < candidates_out.feature.shape[1]:
        candidates_out.feature[row, slot] = feature
        candidates_out.other[row, slot] = other
        candidates_out.gap[row, slot] = candidate.gap
        candidates_out.end_gap[row, slot] = candidate.end_gap
        candidates_out.normal[row, slot] = candidate.normal
        candidates_out.point[row, slot] = candidate.point
