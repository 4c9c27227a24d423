"""The tick: an ordered list of stages, each named, each somebody's own business."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vinesim.physics.guard import Guard
from vinesim.physics.picking import Picking
from vinesim.physics.plants import Plants
from vinesim.physics.rigid import Rigid
from vinesim.physics.sleep import Sleep
from vinesim.physics.touching import Touching
from vinesim.world.model import Model
from vinesim.world.state import State
from vinesim.world.values import Contact, RobotSpec, View


class Physics:
    """A vineyard that moves: plants, rigid bodies, and what passes between them.

    One thread owns it. What others may read leaves it as :class:`View` and other frozen values.
    """

    def __init__(
        self, model: Model, *, dt: float = 0.01, device: str = "cpu", threads: int = 1, picking: bool = True
    ) -> None:
        """``dt`` [s]; ``device`` and ``threads``: see :class:`Plants`; ``picking``: bunches part when pulled too hard."""
        self.model, self.dt = model, dt
        self.state = State.at_rest(model)
        self.plants = Plants(model, self.state, dt=dt, device=device, threads=threads)
        self.rigid = Rigid(model, dt=dt)
        self.touching = Touching(model, self.plants, self.rigid)
        self.picking = Picking(self.plants, self.rigid, self.touching)
        self.sleep = Sleep(self.plants)
        self.guard = Guard(self.plants)
        self.picked: tuple[int, ...] = ()
        """Bunches that were pulled off their vines in the last tick."""
        self.tick = 0
        self._body_q: np.ndarray | None = None
        self._fresh = True
        self.stages: tuple[tuple[str, Callable[[], None]], ...] = (
            ("rigid: predict without plants", self.rigid.prep),
            ("touching: wake what is near", self.touching.find),
            ("plants: predict without contacts", self.plants.free),
            ("touching: solve the contacts of both", self.touching.solve),
            ("plants: move, pushed by them", self._commit),
            ("rigid: move, pushed by them", self._finish),
            ("guard: stop what went wrong", self._guard),
            *([("picking: part what was pulled too hard", self._pick)] if picking else []),
            ("sleep: rest what nobody touches or reaches", self._sleep),
        )

    def step(self) -> None:
        """Advance everything by ``dt``; commands received until now count, later ones do not."""
        for _, stage in self.stages:
            stage()
        self.tick += 1

    @property
    def time(self) -> float:
        """[s] since the start."""
        return self.tick * self.dt

    # ------------------------------------------------------------------ what others see

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """Who pressed on which plant in the last tick, sorted by (tree, body, shape, geom)."""
        return self.touching.contacts

    @property
    def touched(self) -> tuple[tuple[int, str], ...]:
        """(tree, actor) for every tree pressed on in the last tick, sorted."""
        return self.touching.touched

    def refresh(self) -> None:
        """Bring ``state.body_q`` from the start of the last tick to its end."""
        if not self._fresh:
            self.plants.kinematics()
            self._fresh = True

    def view(self) -> View:
        """The world after the last tick. While no tree is awake, views share one array of plant poses."""
        if self._body_q is None:
            self.refresh()
            self._body_q = self.state.body_q.copy()
        return View(
            time=self.time,
            tick=self.tick,
            body_q=self._body_q,
            bunch_attached=self.state.bunch_attached.copy(),
            links=self.rigid.links(),
            link_q=self.rigid.link_q(),
            moved=self.plants.awake.copy(),
        )

    # ------------------------------------------------------------------ who is here

    def add_robot(self, spec: RobotSpec) -> None:
        """See :meth:`Rigid.add_robot`."""
        self.rigid.add_robot(spec)

    def remove_robot(self, name: str) -> None:
        """See :meth:`Rigid.remove_robot`."""
        self.rigid.remove_robot(name)

    def pick(self, bunch: int) -> None:
        """Cut a bunch off its vine; see :meth:`Picking.pick`."""
        self.picking.pick(bunch)
        self._body_q = None

    # ------------------------------------------------------------------ stages that only hand over

    def _commit(self) -> None:
        self.plants.commit(self.touching.bodies, self.touching.wrenches)
        if len(self.plants.awake):
            self._body_q, self._fresh = None, False

    def _finish(self) -> None:
        self.rigid.finish(self.touching.force)

    def _guard(self) -> None:
        self.guard.check()

    def _pick(self) -> None:
        self.picked = self.picking.update()

    def _sleep(self) -> None:
        self.sleep.update(self.touching.near)
