"""Nonlinear conjugate gradients over Gauss-Seidel sweeps, for islands whose Newton steps are too slow or do not
converge.

Sweeps alone converge slowly where many contacts share a body. The change that a sweep makes serves as the gradient:
Silcowitz-Hansen, Niebe, Erleben, A nonsmooth nonlinear conjugate gradient method for interactive contact force problems,
The Visual Computer 26, 2010.
"""

import warp as wp

from vinesim.kernels.contact.island_system import IslandSystem, update_rigid_velocity
from vinesim.kernels.contact.structs import Islands

wp.set_module_options({"enable_backward": False})


@wp.func
def follow_conjugate_direction(
    island: int, first: int, last: int, gradient_before: wp.float64, islands: Islands, system_out: IslandSystem
):
    """Move the impulses of an island along the conjugate direction after a Gauss-Seidel sweep. Returns the square of
    the gradient, which is the change of the impulses by the sweep [N^2 s^2].

    ``first``, ``last``: rows of the island. ``gradient_before``: return value after the previous sweep; 0 for the first
    sweep. If the gradient grows, the search starts again. The next sweep projects the impulses back into their friction
    cones.
    """
    zero = wp.float64(0.0)
    gradient = wp.float64(0.0)
    for row in range(first, last):
        change = system_out.impulse[row] - system_out.impulse_before[row]
        gradient = gradient + change * change
    share = wp.float64(0.0)
    if gradient_before > zero and gradient <= gradient_before:
        share = gradient / gradient_before
    for row in range(first, last):
        change = system_out.impulse[row] - system_out.impulse_before[row]
        further = zero
        if share > zero:
            further = share * system_out.direction[row]
        system_out.impulse[row] = system_out.impulse[row] + further
        system_out.direction[row] = further + change
    if share > zero:
        update_rigid_velocity(island, islands, system_out)
    return gradient
