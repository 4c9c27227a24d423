"""Peduncles that break under their load in a batch of worlds, by the law of :class:`vinesim.interaction.breaking.WoodMonitor`."""

import warp as wp

from vinesim.kernels.worlds.cutting import NONE, WHOLE, Cuts, Wood

wp.set_module_options({"enable_backward": False})


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
