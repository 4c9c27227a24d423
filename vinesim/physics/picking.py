"""From vine to hand: a bunch leaves its peduncle when it is cut, or pulled harder than the peduncle holds.

What was the last body of a tree becomes a free body of the rigid world, with the same pose, velocity and weight in the
same tick; on the tree a stub of a gram stays, so its numbering never changes. The rigid world is compiled anew for it,
which takes some ten milliseconds once.
"""

from __future__ import annotations

import numpy as np

from vinesim.physics.plants import Plants
from vinesim.physics.rigid import Loose, Rigid
from vinesim.physics.touching import Touching

STUB = 1e-3
"""What stays on the tree [kg]."""
BRISK = 20.0
"""[m/s^2] Gravity, and what turning adds to the acceleration of a bunch's middle over that of its stalk."""
PATIENCE = 3
"""[tick] A peduncle parts when it has been pulled too hard for so long: one tick's peak is not a pull."""


class Picking:
    """Watches the peduncles of touched bunches, and takes bunches off their vines."""

    def __init__(self, plants: Plants, rigid: Rigid, touching: Touching) -> None:
        self.plants, self.rigid, self.touching = plants, rigid, touching
        self._strained = np.zeros(len(plants.model.bunch_body), np.int32)
        self._bunch_of = np.full(len(plants.model.body_mass), -1)
        self._bunch_of[plants.model.bunch_body] = np.arange(len(self._strained))

    def update(self) -> tuple[int, ...]:
        """After a commit: pick the bunches that were pulled off; their numbers, sorted."""
        touching, model = self.touching, self.plants.model
        bunches = self._bunch_of[touching.bodies]
        on_bunches = bunches >= 0
        bunches = bunches[on_bunches]
        if len(bunches) == 0:
            return ()
        # most are held loosely: the peduncle carries no more than the hands' force, the weight and the inertia
        bodies = touching.bodies[on_bunches]
        hands = np.abs(touching.wrenches[on_bunches, :3]).sum(1)
        moving = np.abs(self.plants.acceleration[bodies]).sum(1) + BRISK
        strained = hands + self.plants.body_mass[bodies] * moving > model.bunch_pull[bunches]
        if strained.any():
            force = self.plants.joint_wrench(bodies)[:, :3]
            strained = (force * force).sum(1) > model.bunch_pull[bunches] ** 2
        self._strained[bunches] = np.where(strained, self._strained[bunches] + 1, 0)
        parted = tuple(int(b) for b in bunches if self._strained[b] >= PATIENCE)
        for bunch in parted:
            self.pick(bunch)
        return parted

    def pick(self, bunch: int) -> None:
        """Cut one bunch off where it hangs; it keeps its pose and velocity. Call it between ticks."""
        plants, model = self.plants, self.plants.model
        if not plants.state.bunch_attached[bunch]:
            raise ValueError(f"bunch {bunch} was picked already")
        body = int(model.bunch_body[bunch])
        tree = int(model.body_tree[body])
        plants.wake(tree)
        plants.kinematics(np.array([tree]))
        shapes = self.touching.shapes
        of = shapes.bunch == bunch
        loose = Loose(
            mass=float(plants.body_mass[body]), com=model.body_com[body].astype(float),
            inertia=plants.body_inertia[body].astype(float), center=shapes.start[of].astype(float),
            radius=shapes.radius[of].astype(float),
        )  # fmt: skip
        self.rigid.add_bunch(bunch, loose, plants.state.body_q[body], plants.state.body_qd[body])
        plants.state.bunch_attached[bunch] = False
        plants.reweigh(body, STUB)
