"""The tick: an ordered list of stages, each named, each somebody's own business."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vinesim import frames
from vinesim.physics.contact.contact_solver import ContactSolver
from vinesim.physics.parameters import PhysicsParameters
from vinesim.physics.plants.articulation_solver import ArticulationSolver
from vinesim.physics.plants.detachment import Blade, DetachmentMonitor
from vinesim.physics.plants.fault_guard import FaultGuard
from vinesim.physics.plants.level_of_detail import LevelOfDetail
from vinesim.physics.plants.sleep import SleepMonitor
from vinesim.physics.plants.wind import Wind
from vinesim.physics.rigid.dormant_bunches import Lying
from vinesim.physics.rigid.hand_grasp import Holding
from vinesim.physics.rigid.rigid_world import Rigid
from vinesim.physics.rigid.support_tracking import Riding
from vinesim.scene.model import Model
from vinesim.scene.state import State
from vinesim.scene.values import Contact, HandSample, Haptic, HumanPose, HumanSpec, Link, Parting, RobotSpec, View


class Physics:
    """A vineyard that moves: plants, rigid bodies, and what passes between them.

    One thread owns it. What others may read leaves it as :class:`View` and other frozen values.
    """

    def __init__(
        self,
        model: Model,
        *,
        parameters: PhysicsParameters = PhysicsParameters(),
        device: str = "cpu",
        threads: int = 1,
        picking: bool = True,
    ) -> None:
        """``device``, ``threads``: see :class:`ArticulationSolver`; ``picking``: whether bunches detach when pulled too hard."""
        p = parameters
        self.model, self.parameters, self.dt = model, p, p.dt
        self.state = State.at_rest(model)
        self.plants = ArticulationSolver(
            model, self.state, dt=p.dt, phi=p.phi, device=device, threads=threads, fast_rate=p.fast_joint_rate,
            max_rate=p.max_joint_rate, fault_rate=p.fault_joint_rate,
        )  # fmt: skip
        self.rigid = Rigid(model, parameters=p)
        self.contact_solver = ContactSolver(model, self.plants, self.rigid)
        self.parting = DetachmentMonitor(self.plants, self.rigid, self.contact_solver)
        self.holding = Holding(self.plants, self.rigid, self.contact_solver)
        self.riding = Riding(self.rigid)
        self.lying = Lying(self.plants, self.rigid, self.contact_solver, self.riding)
        self._links: tuple[tuple[Link, ...], tuple[Link, ...], tuple[Link, ...]] = ((), (), ())
        self._picking = picking
        self.detail = LevelOfDetail(
            self.plants, linger=p.steps(p.detail_duration), quiet=p.detail_rate,
            patience=p.steps(p.detail_rest_duration),
        )  # fmt: skip
        self.sleep = SleepMonitor(self.plants, quiet=p.sleep_rate, patience=p.steps(p.sleep_duration))
        self.guard = FaultGuard(self.plants)
        self.wind: Wind | None = None
        """What blows, if anything does; set it as you like."""
        self.partings: tuple[Parting, ...] = ()
        """What left its plant in the last tick, or by command before it; sorted by body."""
        self.stirred = np.zeros(0, np.int32)
        """Trees that have moved without being awake [k], because others said so since the last tick."""
        self.tick = 0
        self._body_q: np.ndarray | None = None
        self._fresh = True
        self.stages: tuple[tuple[str, Callable[[], None]], ...] = (
            ("wind: blow on what somebody may see", self._blow),
            ("holding: close and open hands, pull at plants", self.holding.begin),
            ("rigid: predict without plants", self.rigid.prep),
            ("contacts: wake the trees that moving bodies are near to", self.contact_solver.wake_near_trees),
            ("detail: berries move where somebody is near", self._refine),
            ("plants: predict without contacts", self.plants.predict),
            ("contacts: solve those of plants and rigid bodies", self.contact_solver.solve),
            ("plants: move, pushed by them", self._commit),
            ("rigid: move, pushed by them", self._finish),
            ("guard: stop what went wrong", self._guard),
            ("parting: let go what was pulled, bent or cut off", self._part),
            ("holding: hands go with what they hold, and feel it", self._hold),
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
        """Who pressed on which plant in the last tick, sorted by (tree, body, shape, geom); then who held one."""
        return self.contact_solver.contacts + self.holding.contacts

    @property
    def touched(self) -> tuple[tuple[int, str], ...]:
        """(tree, actor) for every tree pressed on or held in the last tick, sorted."""
        if not self.holding.contacts:
            return self.contact_solver.touched_trees
        held = ((int(self.model.body_tree[contact.body]), contact.actor) for contact in self.holding.contacts)
        return tuple(sorted({*self.contact_solver.touched_trees, *held}))

    @property
    def haptics(self) -> tuple[Haptic, ...]:
        """What the controllers of people are to vibrate with after the last tick."""
        return self.holding.haptics

    def refresh(self) -> None:
        """Bring ``state.body_q`` from the start of the last tick to its end."""
        if not self._fresh:
            self.plants.forward_kinematics()
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
            links=self.links(),
            link_q=self.link_q(),
            moved=np.union1d(self.plants.awake, self.stirred),
        )

    def links(self) -> tuple[Link, ...]:
        """All rigid bodies that can be seen, with a body or without; the same object until one comes or goes."""
        rigid, lying = self.rigid.links(), self.lying.links()
        if self._links[0] is not rigid or self._links[1] is not lying:
            self._links = rigid, lying, rigid + lying
        return self._links[2]

    def link_q(self) -> np.ndarray:
        """Poses [link, 7] of :meth:`links`."""
        rigid = self.rigid.link_q()
        return np.concatenate([rigid, self.lying.link_q()]) if len(self.lying) else rigid

    # ------------------------------------------------------------------ who is here

    def add_robot(self, spec: RobotSpec) -> None:
        """See :meth:`Rigid.add_robot`."""
        self.rigid.add_robot(spec)

    def remove_robot(self, name: str) -> None:
        """See :meth:`Rigid.remove_robot`; its blades go with it."""
        self.rigid.remove_robot(name)
        self.parting.blades = [blade for blade in self.parting.blades if blade.actor != name]

    def add_human(self, spec: HumanSpec, *, copy: bool = False) -> None:
        """See :meth:`Rigid.add_human`; a copy touches only trees of which its own client tells."""
        self.rigid.add_human(spec, copy=copy)
        if copy:
            self.contact_solver.remote_actors.add(spec.name)

    def remove_human(self, name: str) -> None:
        """See :meth:`Rigid.remove_human`; what the hands held is let go."""
        self.rigid.remove_human(name)
        self.holding.forget(name)
        self.contact_solver.remote_actors.discard(name)

    def move_human(self, name: str, pose: HumanPose) -> None:
        """Tell where a person's tracked points are at the end of the coming tick, and which hands are closed."""
        self.rigid.move_human(name, pose)

    def hand(self, name: str, side: str) -> HandSample:
        """A person's ``"left"`` or ``"right"`` hand after the last tick."""
        return self.rigid.hand(name, side)

    def pick(self, bunch: int) -> None:
        """Take a bunch off its vine, between ticks; see :meth:`DetachmentMonitor.pick`."""
        self.parting.pick(bunch)
        self._body_q = None

    def cut(self, body: int) -> None:
        """Cut a piece of wood off its vine, between ticks; see :meth:`DetachmentMonitor.cut`."""
        self.parting.cut(body)
        self._body_q = None

    def told_pick(self, bunch: int, pose: np.ndarray, velocity: np.ndarray) -> None:
        """Another client has picked a bunch; see :meth:`DetachmentMonitor.apply_remote_pick`."""
        self.parting.apply_remote_pick(bunch, pose, velocity)
        self._body_q = None

    def told_cut(self, body: int) -> None:
        """Another client has cut a piece of wood off; see :meth:`DetachmentMonitor.apply_remote_cut`."""
        self.parting.apply_remote_cut(body)
        self._body_q = None

    def told_rest(self, trees: list[int], joint_q: list[np.ndarray]) -> None:
        """Others say in what shape trees rest ([body of the tree, 4] each): so they do here, and none wakes for it."""
        for tree, turned in zip(trees, joint_q, strict=True):
            self.state.joint_q[self.model.bodies_of(tree)] = frames.normalize(np.asarray(turned, np.float32))
        self.plants.put_to_sleep(np.array(trees, np.int32))
        self.contact_solver.update_tree_bounds(np.array(trees, np.int32))
        self.stirred = np.union1d(self.stirred, trees).astype(np.int32)
        self._body_q = None

    def watch(self, points: np.ndarray, radius: float) -> None:
        """Let berries move one cluster at a time wherever somebody looks closely; see :meth:`LevelOfDetail.set_focus`."""
        self.detail.set_focus(points, radius)

    def blade(self, actor: str, link: str, pose: np.ndarray, half: np.ndarray) -> Blade:
        """Give a robot's link a cutter: ``pose`` [7] of its mouth in the link, ``half`` [3] its half edges [m].

        x runs along the blades, y from one to the other. :meth:`Blade.close` cuts what passes through the mouth.
        """
        self.rigid.link_pose(actor, link)  # says in words if there is no such link
        blade = Blade(actor, link, np.asarray(pose, float), np.asarray(half, float))
        self.parting.blades.append(blade)
        return blade

    # ------------------------------------------------------------------ stages that only hand over

    def _blow(self) -> None:
        if self.wind is not None:
            actors = [self.rigid.stands(name) for name in self.rigid.actors]
            self.wind.update(
                self.plants, self.time, (np.array(actors), self.parameters.wind_radius) if actors else None
            )

    def _refine(self) -> None:
        self.detail.update(self.contact_solver.near_trees)

    def _commit(self) -> None:
        self.plants.integrate(self.contact_solver.bodies, self.contact_solver.wrenches)
        if len(self.plants.awake):
            self._body_q, self._fresh = None, False

    def _finish(self) -> None:
        self.rigid.finish(self.contact_solver.rigid_force)

    def _guard(self) -> None:
        self.guard.stop_faulty_trees()

    def _part(self) -> None:
        self.partings = self.parting.update(check_load=self._picking)
        if self.partings:
            self._body_q = None

    def _hold(self) -> None:
        self.holding.end(self.partings)
        self.parting.hand_contacts = self.holding.contacts

    def _sleep(self) -> None:
        if not self.parameters.sleep:
            return
        held = self.holding.trees
        self.sleep.update(
            np.union1d(self.contact_solver.near_trees, held) if len(held) else self.contact_solver.near_trees
        )
