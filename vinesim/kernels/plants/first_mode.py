"""Slowest mode of each tree, and the number of substeps that a step needs to reproduce its frequency.

The trapezoidal rule reduces the frequency w of a mode by the share (w dt)^2 / 12, with a similar error in its damping.
"""

import math

import warp as wp

from vinesim.kernels.plants.spatial import world_inertia
from vinesim.kernels.plants.structs import ArticulationModel, Scratch, WrenchScratch

wp.set_module_options({"enable_backward": False})

MAX_ANGLE = 0.3
"""[rad] Largest phase angle w dt of the first mode in a substep.

DERIVED: the frequency is then 0.75 % too low, and 1 % with a damping ratio of 0.12. At 10 ms, modes above 4.8 Hz take
substeps.
"""

MAX_SUBSTEPS = 4
"""Largest number of substeps.

DERIVED: enough for 19 Hz at 10 ms, above the 16 Hz for which the frequency is promised.
"""

ITERATIONS = wp.constant(4)
"""Number of inverse iterations. Each reduces the error by the factor (w1 / w2)^4. For a cane (w2 / w1 = 6.3) one
iteration is enough."""


def substeps_for(frequency: float, dt: float) -> int:
    """Returns the number of substeps in a step of dt [s] for a tree with this first frequency [Hz]."""
    return min(max(math.ceil(2.0 * math.pi * frequency * dt / MAX_ANGLE), 1), MAX_SUBSTEPS)


@wp.func
def compliance(stiffness: wp.vec3, torque: wp.vec3):
    """Returns the angle [rad] by which a torque [N m] turns a spring, in each axis; 0 in an axis without stiffness."""
    angle = wp.vec3()
    for i in range(3):
        if stiffness[i] > 0.0:
            angle[i] = torque[i] / stiffness[i]
    return angle


@wp.func
def place_relaxed(model: ArticulationModel, k: int, scratch_out: Scratch):
    """Compute the axes of body k in the frame of its tree (stored in ``scratch_out.J``) and the lever to the body
    (stored in ``scratch_out.tension``), with all springs relaxed.
    """
    parent = model.body_parent[k]
    axes = wp.quat_to_matrix(model.body_rest[k])
    lever = wp.vec3()
    if parent >= 0:
        lever = scratch_out.J[parent] * model.body_offset[k]
        axes = scratch_out.J[parent] * axes
    scratch_out.J[k] = axes
    scratch_out.tension[k] = lever


@wp.func
def inertial_wrench(model: ArticulationModel, k: int, axes: wp.mat33, acceleration: wp.spatial_vector):
    """Returns the wrench at body k's origin that accelerates the body from rest."""
    com = axes * model.body_com[k]
    alpha = wp.spatial_bottom(acceleration)
    force = model.body_mass[k] * (wp.spatial_top(acceleration) + wp.cross(alpha, com))
    inertia = world_inertia(axes, model.body_inertia[k], model.body_product[k])
    return wp.spatial_vector(force, inertia * alpha + wp.cross(com, force))


@wp.kernel
def count_substeps(
    # model
    dt: float,
    max_angle: float,
    max_substeps: int,
    model: ArticulationModel,
    # in
    count: wp.array(dtype=wp.int32),
    trees: wp.array(dtype=wp.int32),
    # out
    scratch_out: Scratch,
    work_out: WrenchScratch,
    tree_substeps_out: wp.array(dtype=wp.int32),
):
    """One thread per tree. Estimate the frequency of the tree's slowest mode, and choose the number of substeps of its
    steps.

    Inverse iteration x -> K^-1 M x in joint coordinates about the relaxed shape, where K is diagonal. The result
    depends on the model and on which bodies have been cut off or refined, but not on the pose. It ignores weight and
    ties, which also stiffen a tree, and the free motion of a floating root. x^T M x / x^T M K^-1 M x bounds w^2 from
    above.

    trees: [thread] index of the tree. tree_substeps_out: [tree] 1 to ``max_substeps``, such that the phase of the mode
    advances by at most ``max_angle`` [rad] in a substep. All other arrays are scratch; the factors of the last
    prediction are kept.
    """
    if wp.tid() >= count[0]:
        return
    tree = trees[wp.tid()]
    first = model.tree_first[tree]
    size = model.tree_moving[tree]
    for k in range(first, first + size * model.pitch, model.pitch):
        place_relaxed(model, k, scratch_out)
        scratch_out.Du[k] = compliance(model.joint_stiffness[k], wp.vec3(0.6, 1.0, 0.8))
    square = float(0.0)
    for _ in range(ITERATIONS):
        for k in range(first, first + size * model.pitch, model.pitch):
            parent = model.body_parent[k]
            above = wp.spatial_vector()
            if parent >= 0:
                above = work_out.added_acceleration[parent]
            alpha = wp.spatial_bottom(above)
            acceleration = wp.spatial_vector(
                wp.spatial_top(above) + wp.cross(alpha, scratch_out.tension[k]),
                alpha + scratch_out.J[k] * scratch_out.Du[k],
            )
            work_out.added_acceleration[k] = acceleration
            work_out.subtree_wrench[k] = inertial_wrench(model, k, scratch_out.J[k], acceleration)
        kinetic = float(0.0)
        elastic = float(0.0)
        largest = float(0.0)
        for i in range(size):
            k = first + (size - 1 - i) * model.pitch
            parent = model.body_parent[k]
            wrench = work_out.subtree_wrench[k]
            torque = wp.transpose(scratch_out.J[k]) * wp.spatial_bottom(wrench)
            angle = compliance(model.joint_stiffness[k], torque)
            kinetic += wp.dot(scratch_out.Du[k], torque)
            elastic += wp.dot(angle, torque)
            largest = wp.max(largest, wp.length(angle))
            scratch_out.Du[k] = angle
            if parent >= 0:
                force = wp.spatial_top(wrench)
                moment = wp.spatial_bottom(wrench) + wp.cross(scratch_out.tension[k], force)
                work_out.subtree_wrench[parent] = work_out.subtree_wrench[parent] + wp.spatial_vector(force, moment)
        if elastic > 0.0 and largest > 0.0:
            square = kinetic / elastic
            for k in range(first, first + size * model.pitch, model.pitch):
                scratch_out.Du[k] = scratch_out.Du[k] / largest
    substeps = float(1.0)
    if square > 0.0:
        substeps = wp.clamp(wp.ceil(wp.sqrt(square) * dt / max_angle), 1.0, float(max_substeps))
    tree_substeps_out[tree] = int(substeps)


@wp.kernel
def begin_substep(
    # in
    level_count: wp.array(dtype=wp.int32),
    levels: wp.array2d(dtype=wp.int32),
    # out
    level_out: wp.array(dtype=wp.int32),
    tree_count_out: wp.array(dtype=wp.int32),
    root_count_out: wp.array(dtype=wp.int32),
):
    """One thread in all. Set the number of trees and of floating roots that take part in the next substep.

    levels: [substep, 2] numbers of trees and of floating roots. level_count: [1] number of substeps. level_out: [1]
    index of the next substep; 0 again after the last substep.
    """
    level = level_out[0]
    tree_count_out[0] = levels[level, 0]
    root_count_out[0] = levels[level, 1]
    level_out[0] = (level + 1) % level_count[0]
