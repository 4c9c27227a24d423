"""Nonlinear conjugate gradients over sweeps: for islands whose Newton steps would cost too much or do not settle.

Sweeps alone converge slowly where many contacts share a body. The change that a sweep makes serves as the gradient:
Silcowitz-Hansen, Niebe, Erleben, A nonsmooth nonlinear conjugate gradient method for interactive contact force problems,
The Visual Computer 26, 2010.
"""

import warp as wp

from vinesim.kernels.contact.row_velocity import add_impulse
from vinesim.kernels.contact.structs import Contacts, Islands, Rows, SolverScratch

wp.set_module_options({"enable_backward": False})


@wp.func
def follow_conjugate_direction(
    island: int, gradient_before: wp.float64, contacts: Contacts, islands: Islands, scratch_out: SolverScratch,
    rows_out: Rows,
):  # fmt: skip
    """Go on in the conjugate direction after a sweep; returns the square of the gradient [N^2 s^2].

    ``gradient_before``: that of the sweep before; 0 after none. A gradient that grows begins the search anew. The next
    sweep projects the impulses back into their friction cones.
    """
    zero = wp.float64(0.0)
    gradient = wp.float64(0.0)
    for m in range(islands.start[island], islands.start[island + 1]):
        for row in range(3 * islands.contact[m], 3 * islands.contact[m] + 3):
            change = rows_out.impulse[row] - scratch_out.impulse_before[row]
            gradient = gradient + change * change
    share = wp.float64(0.0)
    if gradient_before > zero and gradient <= gradient_before:
        share = gradient / gradient_before
    for m in range(islands.start[island], islands.start[island + 1]):
        for row in range(3 * islands.contact[m], 3 * islands.contact[m] + 3):
            change = rows_out.impulse[row] - scratch_out.impulse_before[row]
            further = zero
            if share > zero:
                further = share * scratch_out.direction[row]
                add_impulse(row, further, island, contacts, islands, rows_out)
            scratch_out.direction[row] = further + change
    return gradient
