"""What lies, rides and moves, as others tell of it."""

from __future__ import annotations

import numpy as np

from vinesim import frames
from vinesim.physics.step import Physics
from vinesim.world.grow import Tree, Wood, assemble
from vinesim.world.ids import Kind, thing


def test_a_bunch_that_has_just_come_can_be_called_moving_at_once():
    """Found by the bench of two who fight for one bunch: the first loose bunch of a world without boxes, in the tick
    in which it comes, was looked for in the arrays of before."""
    tree = Tree(frames.pose(np.array([0.5, 0.0, 1.5])))
    tree.bunch(tree.rod(-1, 0.6, (0.006, 0.004), Wood(2e9, 900.0), 6)[-1], 0.4, clusters=False)
    physics = Physics(assemble([tree]))
    physics.riding.update()
    physics.told_pick(0, frames.pose([0.5, 0.0, 1.0]), np.zeros(6))
    physics.riding.unsettle(thing(Kind.BUNCH, 0))
    physics.riding.update()
    assert thing(Kind.BUNCH, 0) in physics.riding.moving
