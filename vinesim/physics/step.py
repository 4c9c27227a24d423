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
from vinesim.physics.rigid.dormant_bunches import DormantBunches
from vinesim.physics.rigid.hand_grasp import GraspManager
from vinesim.physics.rigid.rigid_world import RigidWorld
from vinesim.physics.rigid.support_tracking import SupportTracker
from vinesim.scene.model import Model
from vinesim.scene.state import State
from vinesim.scene.values import (
    Contact,
    Detachment,
    HandSample,
    HumanPose,
    HumanSpec,
    RigidVisual,
    RobotSpec,
    Snapshot,
)


class Physics:
    """A vineyard that moves: plants, rigid bodies, and what passes between them.

    One thread owns it. What others may read leaves it as :class:`Snapshot` and other frozen values.
    """

    def __init__(
        self,
        model: Model,
        *,
        parameters: PhysicsParameters = PhysicsParameters(),
        device: str = "cpu",
        threads: int = 1,
        detachment: bool = True,
    ) -> None:
        """``device``, ``threads``: see :class:`ArticulationSolver`; ``detachment``: whether bunches detach when pulled too hard."""
        p = parameters
        self.model, self.parameters, self.dt = model, p, p.dt
        self.state = State.at_rest(model)
        self.plants = ArticulationSolver(model, self.state, p, device=device, threads=threads)
        self.rigid = RigidWorld(model, parameters=p)
        self.contact_solver = ContactSolver(model, self.plants, self.rigid)
        self.detachment_monitor = DetachmentMonitor(self.plants, self.rigid, self.contact_solver, p)
        self.grasp_manager = GraspManager(self.plants, self.rigid, self.contact_solver)
        self.support_tracker = SupportTracker(self.rigid)
        self.dormant_bunches = DormantBunches(self.plants, self.rigid, self.contact_solver, self.support_tracker)
        self._visuals: tuple[tuple[RigidVisual, ...], tuple[RigidVisual, ...], tuple[RigidVisual, ...]] = ((), (), ())
        self._detachment = detachment
        self.level_of_detail = LevelOfDetail(self.plants, p)
        self.sleep_monitor = SleepMonitor(self.plants, p)
        self.fault_guard = FaultGuard(self.plants)
        self.wind: Wind | None = None
        """What blows, if anything does; set it as you like."""
        self.detachments: tuple[Detachment, ...] = ()
        """What left its plant in the last tick, or by command before it; sorted by body."""
        self.remotely_posed = np.zeros(0, np.int32)
        """Trees that have moved without being awake [k], because others said so since the last tick."""
        self.tick = 0
        self._body_q: np.ndarray | None = None
        self._fresh = True
        self.stages: tuple[tuple[str, Callable[[], None]], ...] = (
            ("wind: set the air velocity at trees near actors", self._blow),
            ("grasps: close and open hands, pull held plants", self.grasp_manager.begin_step),
            ("rigid: predict velocities without plant contacts", self.rigid.predict),
            ("contacts: wake trees near moving geoms", self.contact_solver.wake_near_trees),
            ("detail: refine bunches near actors", self._refine),
            ("plants: predict velocities without contacts", self.plants.predict),
            ("contacts: solve for plants and rigid bodies together", self.contact_solver.solve),
            ("plants: integrate with contact wrenches", self._commit),
            ("rigid: integrate with contact forces", self._finish),
            ("faults: stop trees with invalid rates", self._guard),
            ("detachment: detach what broke or was cut", self._part),
            ("grasps: move hands with what they hold, measure forces", self._hold),
            ("sleep: put quiet trees to sleep", self._sleep),
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
        return self.contact_solver.contacts + self.grasp_manager.contacts

    @property
    def touched(self) -> tuple[tuple[int, str], ...]:
        """(tree, actor) for every tree pressed on or held in the last tick, sorted."""
        if not self.grasp_manager.contacts:
            return self.contact_solver.touched_trees
        held = ((int(self.model.body_tree[contact.body]), contact.actor) for contact in self.grasp_manager.contacts)
        return tuple(sorted({*self.contact_solver.touched_trees, *held}))

    def update_kinematics(self) -> None:
        """Bring ``state.body_q`` from the start of the last tick to its end."""
        if not self._fresh:
            self.plants.forward_kinematics()
            self._fresh = True

    def wake(self, trees: np.ndarray) -> None:
        """Wake trees [k] whose joints were written from outside, between steps, and bring their poses up to date."""
        self.sleep_monitor.wake(trees)
        self.plants.forward_kinematics(trees)
        self._body_q = None

    def snapshot(self) -> Snapshot:
        """The world after the last tick. While no tree is awake, views share one array of plant poses."""
        if self._body_q is None:
            self.update_kinematics()
            self._body_q = self.state.body_q.copy()
        return Snapshot(
            time=self.time,
            tick=self.tick,
            body_q=self._body_q,
            bunch_attached=self.state.bunch_attached.copy(),
            visuals=self.visuals(),
            visual_q=self.visual_q(),
            moved_trees=np.union1d(self.plants.awake, self.remotely_posed),
        )

    def visuals(self) -> tuple[RigidVisual, ...]:
        """All rigid bodies that can be seen, with a body or without; the same object until one comes or goes."""
        rigid, lying = self.rigid.visuals(), self.dormant_bunches.visuals()
        if self._visuals[0] is not rigid or self._visuals[1] is not lying:
            self._visuals = rigid, lying, rigid + lying
        return self._visuals[2]

    def visual_q(self) -> np.ndarray:
        """Poses [visual, 7] of :meth:`visuals`."""
        rigid = self.rigid.visual_q()
        return np.concatenate([rigid, self.dormant_bunches.visual_q()]) if len(self.dormant_bunches) else rigid

    # ------------------------------------------------------------------ who is here

    def add_robot(self, spec: RobotSpec) -> None:
        """See :meth:`RigidWorld.add_robot`."""
        self.rigid.add_robot(spec)

    def remove_robot(self, name: str) -> None:
        """See :meth:`RigidWorld.remove_robot`; its blades go with it."""
        self.rigid.remove_robot(name)
        self.detachment_monitor.blades = [blade for blade in self.detachment_monitor.blades if blade.actor != name]

    def add_human(self, spec: HumanSpec, *, is_remote: bool = False) -> None:
        """See :meth:`RigidWorld.add_human`; a remote one touches only trees whose state its own client sends."""
        self.rigid.add_human(spec, is_remote=is_remote)
        if is_remote:
            self.contact_solver.remote_actors.add(spec.name)

    def remove_human(self, name: str) -> None:
        """See :meth:`RigidWorld.remove_human`; what the hands held is let go."""
        self.rigid.remove_human(name)
        self.grasp_manager.remove_ties_of(name)
        self.contact_solver.remote_actors.discard(name)

    def move_human(self, name: str, pose: HumanPose) -> None:
        """Tell where a person's tracked points are at the end of the coming tick, and which hands are closed."""
        self.rigid.move_human(name, pose)

    def hand(self, name: str, side: str) -> HandSample:
        """A person's ``"left"`` or ``"right"`` hand after the last tick."""
        return self.rigid.hand_sample(name, side)

    def pick(self, bunch: int) -> None:
        """Take a bunch off its vine, between ticks; see :meth:`DetachmentMonitor.pick`."""
        self.detachment_monitor.pick(bunch)
        self._body_q = None

    def cut(self, body: int) -> None:
        """Cut a piece of wood off its vine, between ticks; see :meth:`DetachmentMonitor.cut`."""
        self.detachment_monitor.cut(body)
        self._body_q = None

    def apply_remote_pick(self, bunch: int, pose: np.ndarray, velocity: np.ndarray) -> None:
        """Another client has picked a bunch; see :meth:`DetachmentMonitor.apply_remote_pick`."""
        self.detachment_monitor.apply_remote_pick(bunch, pose, velocity)
        self._body_q = None

    def apply_remote_cut(self, body: int) -> None:
        """Another client has cut a piece of wood off; see :meth:`DetachmentMonitor.apply_remote_cut`."""
        self.detachment_monitor.apply_remote_cut(body)
        self._body_q = None

    def apply_remote_rest(self, trees: list[int], joint_q: list[np.ndarray]) -> None:
        """Others say in what shape trees rest ([body of the tree, 4] each): so they do here, and none wakes for it."""
        for tree, turned in zip(trees, joint_q, strict=True):
            self.state.joint_q[self.model.bodies_of(tree)] = frames.normalize(np.asarray(turned, np.float32))
        self.plants.put_to_sleep(np.array(trees, np.int32))
        self.contact_solver.update_tree_bounds(np.array(trees, np.int32))
        self.remotely_posed = np.union1d(self.remotely_posed, trees).astype(np.int32)
        self._body_q = None

    def set_detail_focus(self, points: np.ndarray, radius: float) -> None:
        """Let berries move one cluster at a time wherever somebody looks closely; see :meth:`LevelOfDetail.set_focus`."""
        self.level_of_detail.set_focus(points, radius)

    def add_blade(self, actor: str, link: str, pose: np.ndarray, half: np.ndarray) -> Blade:
        """Give a robot's link a cutter: ``pose`` [7] of its mouth in the link, ``half`` [3] its half edges [m].

        x runs along the blades, y from one to the other. :meth:`Blade.close` cuts what passes through the mouth.
        """
        self.rigid.link_pose(actor, link)  # says in words if there is no such link
        blade = Blade(actor, link, np.asarray(pose, float), np.asarray(half, float))
        self.detachment_monitor.blades.append(blade)
        return blade

    # ------------------------------------------------------------------ stages that only hand over

    def _blow(self) -> None:
        if self.wind is not None:
            actors = [self.rigid.actor_position(name) for name in self.rigid.actors]
            self.wind.update(
                self.plants,
                self.time,
                (np.array(actors), self.parameters.wind_radius) if actors else None,
                self.parameters,
            )

    def _refine(self) -> None:
        self.level_of_detail.update(self.contact_solver.near_trees)

    def _commit(self) -> None:
        self.plants.integrate(self.contact_solver.bodies, self.contact_solver.wrenches)
        if len(self.plants.awake):
            self._body_q, self._fresh = None, False

    def _finish(self) -> None:
        self.rigid.integrate(self.contact_solver.rigid_force)

    def _guard(self) -> None:
        self.fault_guard.stop_faulty_trees()

    def _part(self) -> None:
        self.detachments = self.detachment_monitor.update(check_load=self._detachment)
        if self.detachments:
            self._body_q = None

    def _hold(self) -> None:
        self.grasp_manager.end_step(self.detachments)
        self.detachment_monitor.hand_contacts = self.grasp_manager.contacts

    def _sleep(self) -> None:
        if not self.parameters.sleep:
            return
        held = self.grasp_manager.held_trees
        self.sleep_monitor.update(
            np.union1d(self.contact_solver.near_trees, held) if len(held) else self.contact_solver.near_trees
        )
