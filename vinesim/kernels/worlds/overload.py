"""Wood that gives under its load in a batch of worlds, by the laws of :class:`vinesim.interaction.breaking.WoodMonitor`."""

import warp as wp

from vinesim.kernels.plants.structs import ArticulationModel, JointState
from vinesim.kernels.plants.wood_stress import CANE
from vinesim.kernels.worlds.cane_cuts import Topology, double_quat, turn_by, turn_rest
from vinesim.kernels.worlds.cutting import NONE, WHOLE, Cuts, Wood

wp.set_module_options({"enable_backward": False})


@wp.struct
class CaneLaw:
    """How the joints of canes bear moments [body]: see :class:`vinesim.scene.strength.BendingLaw`."""

    kind: wp.array(dtype=wp.int32)
    """Kind of the joint, see :mod:`vinesim.kernels.plants.wood_stress`."""
    yields: wp.array(dtype=wp.float64)
    breaks: wp.array(dtype=wp.float64)
    hardening: wp.array(dtype=wp.float64)
    cracking: wp.array(dtype=wp.float64)


@wp.struct
class GivenWood:
    """How far the joints of canes have given [body]."""

    flow: wp.array(dtype=float)
    """rad, sum of all rotations by which the set has changed."""
    capacity: wp.array(dtype=float)
    """N m, moment that a joint bears now."""
    stress: wp.array(dtype=wp.vec2)
    """Result of :func:`vinesim.kernels.plants.wood_stress.find_stress`."""
    breaks: wp.array(dtype=wp.bool)
    """Whether the joint has broken in this step."""


@wp.func
def capacity_at(k: int, flow: wp.float64, law: CaneLaw):
    """Returns the moment [N m] that a joint bears after a ``flow`` [rad]."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    hardening = law.hardening[k]
    risen = one
    if hardening > zero:
        risen = wp.clamp(flow / wp.max(hardening, wp.float64(1.0e-12)), zero, one)
    bears = law.yields[k] + (law.breaks[k] - law.yields[k]) * risen
    if flow >= hardening:
        bears = law.breaks[k] * wp.clamp(one - (flow - hardening) / law.cracking[k], zero, one)
    return bears


@wp.func
def give(k: int, flow: wp.float64, moment: wp.float64, stiffness: wp.float64, law: CaneLaw):
    """Returns the flow [rad] after a joint has given way to an elastic moment [N m] at an unchanged pose; see
    :meth:`vinesim.scene.strength.BendingLaw.give`. ``stiffness``: N m/rad."""
    zero = wp.float64(0.0)
    tiny = wp.float64(1.0e-12)
    hardening = law.hardening[k]
    slope = (law.breaks[k] - law.yields[k]) / wp.max(hardening, tiny)
    over = wp.max(moment - capacity_at(k, flow, law), zero)
    first = wp.min(over / (stiffness + slope), wp.max(hardening - flow, zero))
    left = moment - stiffness * first
    after = flow + first
    over = zero
    if after >= hardening * (wp.float64(1.0) - wp.float64(1.0e-9)):
        over = wp.max(left - capacity_at(k, after, law), zero)
    fall = law.breaks[k] / law.cracking[k]
    if over > zero:
        end = hardening + law.cracking[k]
        if stiffness > fall:
            end = wp.min(after + over / wp.max(stiffness - fall, tiny), end)
        after = end
    return after


@wp.kernel
def bend_canes(
    # model
    law: CaneLaw,
    # in
    watch: wp.array(dtype=wp.int32),
    phi_used: wp.array(dtype=float),
    # out
    given_out: GivenWood,
    topology_out: Topology,
    model_out: ArticulationModel,
    joints_out: JointState,
):
    """One thread per tree. Let canes give whose moment passes their capacity, or will pass it in the next step, and list
    the joints that break.

    watch: result of :func:`vinesim.kernels.plants.wood_stress.find_stress`. phi_used: [tree] implicitness of the
    integrator in the last step.
    """
    tree = wp.tid()
    zero = wp.float64(0.0)
    tiny = wp.float64(1.0e-9)
    first = model_out.tree_first[tree]
    phi = wp.float64(phi_used[tree])
    for k in range(first, first + topology_out.moving[tree] * model_out.pitch, model_out.pitch):
        given_out.breaks[k] = False
        stress = given_out.stress[k]
        is_live = law.kind[k] == CANE and watch[tree] > 0 and not topology_out.is_cut[k]
        if is_live and wp.max(stress[0], stress[1]) >= given_out.capacity[k]:
            moment = wp.float64(stress[0])
            further = wp.max(wp.float64(stress[1]) - moment, zero)
            whole = double_quat(joints_out.joint_q[k])
            axis, size = wp.quat_to_axis_angle(whole)
            angle = wp.max(size, tiny)
            stiffness = wp.max(moment / angle, tiny)
            flow = wp.float64(given_out.flow[k])
            end = (law.hardening[k] + law.cracking[k]) * (wp.float64(1.0) - tiny)
            after = give(k, flow, moment, stiffness, law)
            # the share of the next step's flow at which its equations have the moment that the law allows
            expected = give(k, after, moment - stiffness * (after - flow) + further, stiffness, law)
            room = wp.float64(2.0) * (capacity_at(k, after, law) - moment)
            if expected < end:
                after = after + phi * (expected - after)
            elif after < end and room < phi * further:
                after = expected
            turned = wp.min(after - flow, angle)
            given_out.flow[k] = wp.float32(after)
            given_out.stress[k] = wp.vec2(wp.float32(moment - stiffness * turned), stress[1])
            given_out.capacity[k] = wp.float32(wp.max(capacity_at(k, after, law), wp.float64(1.0e-6)))
            given_out.breaks[k] = after >= end
            part = turn_by(turned * axis)
            kept = wp.normalize(double_quat(topology_out.kept[k]) * part)
            turn_rest(k, double_quat(topology_out.grown[k]), kept, topology_out, model_out, joints_out)


@wp.kernel
def count_loads(
    # model
    dt: float,
    duration: float,
    worlds: int,
    trees: int,
    wood: Wood,
    ends: wp.array(dtype=wp.vec2i),
    shortest: wp.float64,
    # in
    is_free: wp.array(dtype=wp.int32),
    watch: wp.array(dtype=wp.int32),
    stress: wp.array(dtype=wp.vec2),
    # out
    load_time_out: wp.array(dtype=float),
    used_out: wp.array(dtype=float),
    cuts_out: Cuts,
):
    """One thread per world. Count the time for which peduncles are overloaded, and list those that break.

    ends: [bunch] bodies beyond the two joints at which its peduncle ends. duration: [s] time after which an overloaded
    peduncle breaks. watch, stress: results of :func:`vinesim.kernels.plants.wood_stress.find_stress`. load_time: [bunch] s.
    used: [bunch] share of its strength that was used in the last step.
    """
    world = wp.tid()
    for tree in range(world, trees, worlds):
        for i in range(wood.tree_start[tree], wood.tree_start[tree + 1]):
            bunch = wood.of_tree[i]
            base = stress[ends[bunch][0]][0]
            end = stress[ends[bunch][1]][0]
            used = wp.max(base, end)
            if watch[tree] <= 0 or is_free[bunch] != 0:
                used = 0.0
            before = used_out[bunch]
            share = float(1.0)
            if before < 1.0:
                share = (used - 1.0) / wp.max(used - before, 1.0e-9)
            time = float(0.0)
            if used > 1.0:
                time = load_time_out[bunch] + share * dt
            load_time_out[bunch] = time
            used_out[bunch] = used
            cuts_out.segment[bunch] = NONE
            if time > 0.0 and time >= duration * (1.0 - 1.0e-6):
                cuts_out.segment[bunch] = wp.where(end > base, WHOLE, ends[bunch][0])
                cuts_out.at[bunch] = shortest
