"""What lies, rides and moves, as others tell of it."""

from __future__ import annotations

import numpy as np

from vinesim import frames
from vinesim.net.puppet import row
from vinesim.physics.step import Physics
from vinesim.world.ids import Kind, thing


def test_a_bunch_that_has_just_come_can_be_called_moving_at_once():
    """Found by the bench of two who fight for one bunch: the first loose bunch of a world without boxes, in the tick
    in which it comes, was looked for in the arrays of before."""
    physics = Physics(row(2))
    physics.riding.update()
    physics.told_pick(0, frames.pose([0.5, 0.0, 1.0]), np.zeros(6))
    number = thing(Kind.BUNCH, 0)
    physics.riding.settle(number, "", frames.pose([0.5, 0.0, 1.0]))
    physics.told_pick(1, frames.pose([1.5, 0.0, 1.0]), np.zeros(6))
    physics.riding.unsettle(thing(Kind.BUNCH, 1))
    physics.riding.unsettle(number)
    assert {number, thing(Kind.BUNCH, 1)} <= set(physics.riding.moving)
