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
PATIENCE = 3
"""[tick] A peduncle parts when it has been pulled too hard for so long: one tick's peak is not a pull."""


class Picking:
    """Watches the peduncles of touched bunches, and takes bunches off their vines."""

    def __init__(self, plants: Plants, rigid: Rigid, touching: Touching) -> None:
        self.plants, self.rigid, self.touching = plants, rigid, touching
        self.pull = np.zeros(len(plants.model.bunch_body), np.float32)
        """[bunch] N, of the last tick in which the bunch was touched."""
        self._strained = np.zeros(len(self.pull), np.int32)
        self._bunch_of = np.full(len(plants.model.body_mass), -1)
        self._bunch_of[plants.model.bunch_body] = np.arange(len(self.pull))

    def update(self) -> tuple[int, ...]:
        """After a commit: pick the bunches that were pulled off; their numbers, sorted."""
        bunches = self._bunch_of[self.touching.bodies]
        bunches = bunches[bunches >= 0]
        bunches = bunches[self.plants.state.bunch_attached[bunches]]
        if len(bunches) == 0:
            return ()
        force = self.plants.joint_wrench(self.plants.model.bunch_body[bunches])[:, :3]
        self.pull[bunches] = np.linalg.norm(force, axis=1)
        strained = self.pull[bunches] > self.plants.model.bunch_pull[bunches]
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
