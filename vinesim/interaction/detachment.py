"""Detachment: bunches that are pulled or bent off their peduncles, and wood that is cut by a closing blade.

A detached bunch becomes a free body of the rigid world in the same tick, with its pose, velocity and weight. Its
peduncle and a stub of one gram stay on the tree, so the numbering of the tree's bodies never changes. A cane is cut
where the blade is: what is beyond the cut falls with everything that grows on it, including its bunches, and the stump
stays (:meth:`ArticulationSolver.cut`).
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import warp as wp

from vinesim.contact.contact_solver import ContactSolver
from vinesim.core import frames
from vinesim.core.errors import checked_index
from vinesim.core.warp_arrays import share
from vinesim.interaction.stalk import cut_place, leave_stump, model_pieces, stalk_below, with_settled_stalk, with_stalk
from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.kernels.plants.tree_checks import count_overloaded_steps
from vinesim.plants.articulation_solver import ArticulationSolver, spans
from vinesim.rigid.free_bunch import FreeBunch
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene.ids import Organ
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.spare_bodies import PLACE_STEP
from vinesim.scene.values import Contact, Detachment

SAME_CUT = 2e-3
"""Wood shorter than this before or beyond a cut [m] is not cut again: a blade that closes twice cuts once."""
STUB_MASS = 1e-3
"""Mass of the stub that stays on the tree in place of a bunch [kg]."""


@dataclasses.dataclass(slots=True)
class Blade:
    """The mouth of a cutter: a box fixed to a link. When the blade closes, it cuts the wood that passes through the
    box."""

    actor: str
    link: str
    pose: np.ndarray
    """[7] pose of the mouth's centre in the link: x along the blades, y from blade to blade, z across their plane."""
    half: np.ndarray
    """[3] m, half edges of the mouth. Wood within ``half[1]`` of the centre, in the closing direction, is caught."""
    force: float = np.inf
    """[N] Largest closing force."""
    closing: bool = False
    closures: int = 0
    """Number of times the blade has closed so far."""
    detachments: tuple[Detachment, ...] = ()
    """Parts that the blade cut off when it last closed."""
    resistance: float = 0.0
    """[N] Cutting force of the strongest piece of wood in the mouth at the last closing, whether it was cut or not; 0
    for an empty mouth."""

    def close(self, force: float = np.inf) -> None:
        """Close with at most ``force`` [N] and open again. The wood in the mouth is cut at the end of the next step."""
        self.closing = True
        self.force = force


class DetachmentMonitor:
    """Monitors the peduncles of awake trees and closing blades, and detaches parts that break or are cut."""

    def __init__(
        self,
        plants: ArticulationSolver,
        rigid: RigidWorld,
        contact_solver: ContactSolver,
        parameters: PhysicsParameters = PhysicsParameters(),
    ) -> None:
        """``parameters``: ``detachment_duration`` is the time after which an overloaded peduncle breaks,
        ``cutting_strength`` the strength of wood."""
        self._overload_limit = parameters.steps(parameters.detachment_duration)
        self._cutting_strength = parameters.cutting_strength
        self.plants = plants
        self.rigid = rigid
        self.contact_solver = contact_solver
        self.blades: list[Blade] = []
        self.hand_contacts: tuple[Contact, ...] = ()
        """Forces of hands that hold plants, as contacts. They are used to find the actor who pulled off a bunch. The
        caller writes them.
        """
        model = plants.model
        self._overloaded_steps = np.zeros(len(model.bunch_body), np.int32)
        self._bunch_of = model.bunch_of_body()
        trees = model.body_tree[model.bunch_body]
        order = np.argsort(trees, kind="stable")
        self._bunches = order.astype(np.int32)
        self._first = np.searchsorted(trees[order], np.arange(len(model.tree_first) + 1))
        self._wood = np.isin(model.body_organ, (Organ.CANE, Organ.PEDUNCLE))
        self._awake: np.ndarray | None = None
        self._awake_bunches = np.zeros(len(order), np.int32)
        self._longest = np.zeros(1, np.int32)
        self._detachments: list[Detachment] = []
        self._bind()

    def _bind(self) -> None:
        model = self.plants.model
        self._peduncles = peduncles = self.plants.launches.joint_wrenches(max(len(self._bunches), 1))
        count_steps = KernelLaunch(
            count_overloaded_steps,
            [
                share(model.bunch_body, wp.int32),
                share(model.body_tree, wp.int32),
                share(model.bunch_pull, wp.float32),
                share(model.bunch_bend, wp.float32),
                share(peduncles.count, wp.int32),
                share(self._awake_bunches, wp.int32),
                share(peduncles.carried, wp.spatial_vector),
                share(self.plants.state.bunch_attached, wp.bool),
                share(self.contact_solver.remote_trees, wp.bool),
            ],
            [share(self._overloaded_steps, wp.int32), share(self._longest, wp.int32)],
        )
        if self.plants.buffers.has_copies:
            self._count_overloaded_steps = KernelGraph(count_steps)
            self._weigh = self.plants.launches.graph(peduncles.launch)
        else:
            self._count_overloaded_steps = KernelGraph(peduncles.launch, count_steps)

    # ------------------------------------------------------------------ the tick

    def update(self, *, check_load: bool = True) -> tuple[Detachment, ...]:
        """Detach bunches and canes at the end of a step. Returns all detachments since the last call, sorted by body.
        ``check_load``: whether overloaded peduncles break; if not, only cuts are made."""
        if check_load:
            self._detach_overloaded()
        if any(blade.closing for blade in self.blades):
            self._cut_with_blades()
        taken = tuple(sorted(self._detachments, key=lambda parting: parting.body))
        self._detachments = []
        return taken

    def _detach_overloaded(self) -> None:
        """Detach bunches whose peduncles were overloaded for ``detachment_duration``, on trees that this client
        controls."""
        self._list_awake_bunches()
        self._longest[0] = 0
        count = int(self._peduncles.count[0])
        if self.plants.buffers.has_copies:
            self._weigh(count)
            self.plants.buffers.synchronize()
        self._count_overloaded_steps(count)
        if self._longest[0] < self._overload_limit:
            return
        model = self.plants.model
        attached = self.plants.state.bunch_attached
        for i in np.flatnonzero(self._overloaded_steps[self._awake_bunches[:count]] >= self._overload_limit).tolist():
            bunch = int(self._awake_bunches[i])
            is_remote = self.contact_solver.remote_trees[model.body_tree[model.bunch_body[bunch]]]
            if attached[bunch] and not is_remote:
                square = np.square(self._peduncles.carried[i])
                pulled = square[:3].sum() / np.square(model.bunch_pull[bunch])
                bent = square[3:].sum() / np.square(model.bunch_bend[bunch])
                cause = "pull" if pulled >= bent else "bend"
                actor = self._hardest_pressing_actor(bunch)
                self._pick(bunch, cause, actor, self._peduncles.carried[i].copy())

    def _list_awake_bunches(self) -> None:
        """List the bunches of awake trees, including picked ones."""
        awake = self.plants.awake
        if awake is not self._awake:
            self._awake = awake
            first = self._first[awake]
            bunches = self._bunches[spans(first, self._first[awake + 1] - first)]
            self._peduncles.count[0] = len(bunches)
            self._awake_bunches[: len(bunches)] = bunches
            self._peduncles.places[: len(bunches)] = self.plants.buffers.slots[self.plants.model.bunch_body[bunches]]

    def _cut_with_blades(self) -> None:
        """Cut the wood in the mouths of closing blades."""
        self.plants.forward_kinematics()
        for blade in self.blades:
            if blade.closing:
                blade.closing = False
                blade.resistance = 0.0
                before = len(self._detachments)
                blade.closures += 1
                for body in self._bodies_in_mouth(blade).tolist():
                    resistance = self.cutting_force(body)
                    blade.resistance = max(blade.resistance, resistance)
                    if resistance > blade.force:
                        continue
                    bunch = int(self._bunch_of[body])
                    if bunch < 0:
                        place = self._place_on_cane(blade, body)
                        if place is not None:
                            self.cut(body, "blade", blade.actor, place)
                    elif self.plants.state.bunch_attached[bunch]:
                        self.pick(bunch, "blade", blade.actor, *self._cut_in_peduncle(blade, bunch))
                blade.detachments = tuple(self._detachments[before:])

    def wood_in_mouth(self, blade: Blade) -> list[tuple[int, int]]:
        """Returns the bodies in a blade's mouth after a step, which it would cut with sufficient force. Each body has
        the index of its bunch, or -1 for a cane."""
        bodies = self._bodies_in_mouth(blade).tolist()
        found = [(body, int(self._bunch_of[body])) for body in bodies]
        return [(body, bunch) for body, bunch in found if bunch < 0 or self.plants.state.bunch_attached[bunch]]

    def cutting_force(self, body: int) -> float:
        """Returns the force [N] that cuts a piece of wood: its cross-section at the root end times
        ``cutting_strength``."""
        segment = self.plants.stumps.segment_of(body)
        return self._cutting_strength * math.pi * float(self.plants.model.body_radius[segment, 0]) ** 2

    def _bodies_in_mouth(self, blade: Blade) -> np.ndarray:
        """Returns the pieces of wood [k] that a closing blade cuts: their axis passes through its mouth, and the axis
        of a cane also through the plane in which the blades close. Of each branch only the piece nearest the root."""
        body_q = self.plants.state.body_q
        mouth = frames.compose(self.rigid.link_pose(blade.actor, blade.link), blade.pose)
        far = np.linalg.norm(blade.half)
        apart = body_q[:, :3] - mouth[:3].astype(np.float32)
        reach = far + self.plants.body_end
        near = np.flatnonzero(self._wood & ((apart * apart).sum(1) < reach * reach))
        near = near[self.plants.body_end[near] > self.plants.body_start[near]]
        _, _, enter, leave = self._axes_in_mouth(blade, near)
        caught = near[enter <= leave]
        canes = caught[self._bunch_of[caught] < 0].tolist()
        missed = [body for body in canes if self._place_on_cane(blade, body) is None]
        caught = caught[~np.isin(caught, missed)]
        inside = np.zeros(len(self._wood), bool)
        inside[caught] = True
        return caught[~self._has_marked_ancestor(caught, inside)]

    def _place_on_cane(self, blade: Blade, body: int) -> float | None:
        """Returns the place [m] along a piece of cane in a blade's mouth at which the blade cuts it: where its axis
        crosses the plane in which the blades close. Wood that lies in this plane is cut at the point nearest to it.

        None if the blades close beside it, or where it is cut already and no part can be split off.
        """
        plants = self.plants
        bodies = np.array([body])
        start, along, enter, leave = (values[0] for values in self._axes_in_mouth(blade, bodies))
        share = float(np.clip(-start[2] / along[2], enter, leave))
        segment = plants.stumps.segment_of(body)
        radius = float(plants.model.body_radius[segment].mean())
        if enter > leave or abs(start[2] + share * along[2]) > radius:
            return None
        first, end = float(plants.body_start[body]), float(plants.body_end[body])
        at = first + share * (end - first)
        is_fresh = (first > 0.0 or plants.state.body_cut[body]) and at - first < SAME_CUT
        return None if is_fresh or (end < float(plants.model.body_length[segment]) and end - at < SAME_CUT) else at

    def _cut_in_peduncle(self, blade: Blade, bunch: int) -> tuple[int, float]:
        """Returns the segment of a bunch's peduncle in which a closing blade cuts it, and the place [m] along it: the
        point of the peduncle nearest to the plane in which the blades close, within the mouth."""
        model = self.plants.model
        segments = np.flatnonzero((self._bunch_of == bunch) & (model.body_organ == int(Organ.PEDUNCLE)))
        start, along, enter, leave = self._axes_in_mouth(blade, segments)
        inside = enter <= leave
        crossing = np.clip(-start[:, 2] / along[:, 2], enter, np.maximum(leave, enter))
        apart = np.where(inside, np.abs(start[:, 2] + crossing * along[:, 2]), np.inf)
        best = int(np.argmin(apart))
        return int(segments[best]), float(crossing[best] * model.body_length[segments[best]])

    def _axes_in_mouth(self, blade: Blade, bodies: np.ndarray) -> tuple[np.ndarray, ...]:
        """Returns the axes of the wood of ``bodies`` [k] in the frame of a blade's mouth: starts [k, 3] m and vectors
        to the ends [k, 3] m, and the shares [k] of these vectors between which the axes are in the mouth; no share is
        in it if the first is larger than the second."""
        body_q = self.plants.state.body_q
        mouth = frames.compose(self.rigid.link_pose(blade.actor, blade.link), blade.pose)
        start = frames.rotate(frames.conjugate(mouth[3:]), body_q[bodies, :3] - mouth[:3])
        along = frames.rotate(frames.multiply(frames.conjugate(mouth[3:]), body_q[bodies, 3:]), np.array([1.0, 0, 0]))
        first = self.plants.body_start[bodies, None]
        start = start + first * along
        along = along * (self.plants.body_end[bodies, None] - first)
        # slab test: the part of each axis inside the box
        along = np.where(np.abs(along) < 1e-12, 1e-12, along)
        one = (-blade.half - start) / along
        other = (blade.half - start) / along
        enter = np.maximum(np.minimum(one, other).max(1), 0.0)
        leave = np.minimum(np.maximum(one, other).min(1), 1.0)
        return start, along, enter, leave

    def _has_marked_ancestor(self, bodies: np.ndarray, marked: np.ndarray) -> np.ndarray:
        """Returns for each of the ``bodies`` [k] whether it descends from a body in ``marked`` [body] bool, without a
        cut in between."""
        parent = self.plants.body_parent
        cut = self.plants.state.body_cut
        below = np.zeros(len(bodies), bool)
        at = bodies.copy()
        while (at >= 0).any():
            at = np.where((at >= 0) & ~cut[at], parent[at], -1)
            below |= (at >= 0) & marked[at]
        return below

    # ------------------------------------------------------------------ one at a time

    def pick(
        self, bunch: int, cause: str = "command", actor: str = "", segment: int | None = None, at: float = 0.0
    ) -> None:
        """Detach one bunch from its vine. The bunch keeps its pose and velocity. Call this between steps.

        ``segment``: body of the segment of its peduncle that is cut ``at`` [m] from its origin; the bunch keeps the
        stalk beyond the cut. None: the bunch parts at its own joint and keeps no stalk. Raises :class:`ValueError` if
        the bunch cannot be detached there.
        """
        bunch = checked_index("bunch", bunch, len(self._overloaded_steps))
        if not self.plants.state.bunch_attached[bunch]:
            raise ValueError(f"bunch {bunch} was picked already")
        body = self.plants.model.bunch_body[bunch]
        place = None
        if segment is not None:
            stalk_below(self.plants.model, bunch, segment)
            place = segment, cut_place(self.plants.model, segment, at)
        self._pick(bunch, cause, actor, self.plants.joint_wrench(np.array([body]))[0], place)

    def _pick(
        self, bunch: int, cause: str, actor: str, carried: np.ndarray, place: tuple[int, float] | None = None
    ) -> None:
        plants = self.plants
        model = self.plants.model
        body = int(model.bunch_body[bunch])
        tree = int(model.body_tree[body])
        plants.wake(tree)
        plants.forward_kinematics(np.array([tree]))
        shapes = self.contact_solver.capsules
        state = plants.state
        # keep the present collision shapes and the poses of the clusters, so that a hand or gripper that holds the
        # bunch keeps its contacts
        here = (shapes.bunch == bunch) & (shapes.level != (1 if state.tree_fine[tree] else 2))
        of = np.flatnonzero(here & (model.body_organ[shapes.body] == int(Organ.BUNCH)))
        # cut before fusing, so that the vine gets no impulse
        velocity = plants.berry_clusters.fuse(bunch)
        local = frames.compose(frames.inverse(state.body_q[body].astype(float)), state.body_q[shapes.body[of]])
        start, end = (
            local[:, :3] + frames.rotate(local[:, 3:], at[of].astype(float)) for at in (shapes.start, shapes.end)
        )
        loose = FreeBunch(
            mass=float(plants.body_mass[body]),
            com=plants.body_com[body].astype(float),
            inertia=plants.body_inertia[body].astype(float),
            product=plants.body_product[body].astype(float),
            start=start,
            end=end,
            radius=shapes.radius[of].astype(float),
        )
        if place is not None:
            loose, velocity = self._take_stalk(bunch, loose, velocity, *place)
        self.rigid.add_bunch(bunch, loose, plants.state.body_q[body], velocity)
        self.rigid.ignore_overlaps(bunch)
        self.contact_solver.ignore_overlaps(bunch, *_box_around(loose, plants.state.body_q[body].astype(float)))
        plants.state.bunch_attached[bunch] = False
        self._overloaded_steps[bunch] = 0
        plants.set_mass(body, STUB_MASS)
        if state.tree_fine[tree]:
            plants.berry_clusters.release(bunch)
        plants.body_drag[body] = 0.0
        self._record(body, bunch, cause, actor, carried, place)

    def _take_stalk(
        self, bunch: int, loose: FreeBunch, velocity: np.ndarray, segment: int, at: float
    ) -> tuple[FreeBunch, np.ndarray]:
        """Split a peduncle at ``at`` [m] along ``segment``. Returns the bunch with the stalk beyond the cut, and its
        velocity [6] in world axes. The stump stays on the vine, where it can be touched.
        """
        plants = self.plants
        state = plants.state
        segments = stalk_below(plants.model, bunch, segment)
        pieces = model_pieces(plants.model, segments, at)
        frame, *above = _unit_poses(state.body_q[[plants.model.bunch_body[bunch], *segments]])
        back = frames.conjugate(frame[3:])
        rates = np.concatenate([velocity[None], state.body_qd[segments].astype(float)])
        rates = frames.rotate(back, rates.reshape(-1, 3)).reshape(-1, 6)
        poses = frames.compose(frames.inverse(frame), np.array(above))
        radii = plants.model.body_radius[segments].mean(1).astype(float)
        whole, own = with_stalk(loose, rates[0], segment, pieces, poses, rates[1:], radii)
        leave_stump(plants, self.contact_solver, segments, at)
        state.cut_segment[bunch] = segment
        state.cut_at[bunch] = at
        velocity = frames.rotate(frame[3:], own.reshape(2, 3)).ravel()
        return whole, velocity

    def cut(self, body: int, cause: str = "command", actor: str = "", at: float | None = None) -> None:
        """Cut a piece of wood ``at`` [m] from the origin of its body. What is beyond the cut falls, the stump stays.
        Call this between steps.

        A peduncle is cut in its middle unless ``at`` is given, and its bunch keeps the stalk beyond the cut. A cane
        parts at the joint between ``body`` and its parent if ``at`` is None or 0, or where
        :meth:`ArticulationSolver.cut` has to. Raises :class:`ValueError` if the piece cannot be cut there.
        """
        plants = self.plants
        body = checked_index("body", body, len(self._wood))
        if plants.model.body_organ[body] == int(Organ.BUNCH):
            raise ValueError(f"body {body} is no piece of wood that can be cut")
        if self._bunch_of[body] >= 0:
            at = 0.5 * float(plants.model.body_length[body]) if at is None else at
            self.pick(int(self._bunch_of[body]), cause, actor, body, at)
            return
        if plants.state.body_cut[body] and not at:
            raise ValueError(f"body {body} was cut already")
        carried = plants.joint_wrench(np.array([body]))[0]
        tree = int(plants.model.body_tree[body])
        plants.wake(tree)
        plants.forward_kinematics(np.array([tree]))
        stump = plants.cut(body, 0.0 if at is None else at)
        place = None
        if stump >= 0:
            self.contact_solver.divide_wood(plants.stumps.segment_of(body))
            place = body, float(plants.state.stump_end[stump])
        self._record(body, -1, cause, actor, carried, place)

    def apply_remote_pick(self, bunch: int, pose: np.ndarray, velocity: np.ndarray) -> None:
        """Detach a bunch that another client has detached, and set its ``pose`` [7] and ``velocity`` [6].

        The bunch is not listed in this client's detachments. It has the stalk that its record names, if that has
        arrived (``State.cut_segment``).
        """
        segment = int(self.plants.state.cut_segment[bunch])
        place = None if segment < 0 else (segment, float(self.plants.state.cut_at[bunch]))
        self._pick(bunch, "remote", "", np.zeros(6), place)
        self._detachments.pop()
        self.rigid.place_bunch(bunch, pose, velocity)

    def restore_stalk(self, bunch: int) -> None:
        """Give a free bunch the stalk that ``State.cut_segment`` names, if the bunch has a body. Its record has come
        after its motion."""
        if bunch in self.rigid.free_bunches:
            state = self.plants.state
            segment = int(state.cut_segment[bunch])
            at = float(state.cut_at[bunch])
            model = self.plants.model
            leave_stump(self.plants, self.contact_solver, stalk_below(model, bunch, segment), at)
            self.rigid.replace_bunch(bunch, with_settled_stalk(model, bunch, self.rigid.free_bunch(bunch), segment, at))

    def apply_remote_cut(self, body: int) -> None:
        """Cut off a body that another client has cut off."""
        if not self.plants.state.body_cut[body]:
            tree = int(self.plants.model.body_tree[body])
            self.plants.wake(tree)
            self.plants.cut(body)

    def apply_remote_stump(self, stump: int, segment: int, at: float, *, floats: bool) -> None:
        """Make a spare body the stump of a cut that another client has made ``at`` [m] along a segment of a cane.
        ``floats``: whether the stump has been cut off, too. The caller cuts off what is beyond.

        If the spare is a stump already, the cut of the lower segment is valid, and the lower place: all clients agree
        on this one. The other cut is then at the joint. Nothing happens if the wood cannot be split there.
        """
        plants = self.plants
        before = int(plants.state.stump_of[stump])
        if before >= 0 and (before, round(float(plants.state.stump_end[stump]) / PLACE_STEP)) <= (
            segment,
            round(at / PLACE_STEP),
        ):
            return
        plants.wake(int(plants.model.body_tree[stump]))
        if before >= 0:
            plants.withdraw_stump(stump)
            self.contact_solver.divide_wood(before)
            self.contact_solver.hide_wood(stump)
        if plants.stumps.can_leave(segment, at):
            plants.leave_stump(stump, segment, at, floats=floats)
            self.contact_solver.divide_wood(segment)

    def _record(
        self,
        body: int,
        bunch: int,
        cause: str,
        actor: str,
        carried: np.ndarray,
        place: tuple[int, float] | None = None,
    ) -> None:
        tree = int(self.plants.model.body_tree[body])
        force = carried[:3].astype(float)
        moment = carried[3:].astype(float)
        segment, at = (-1, 0.0) if place is None else place
        self._detachments.append(
            Detachment(self.plants.tick, tree, body, bunch, cause, actor, force, moment, segment, at)
        )

    def _hardest_pressing_actor(self, bunch: int) -> str:
        """Returns the name of the actor that presses hardest on a bunch; empty if no actor does."""
        pushes: dict[str, float] = {}
        for contact in self.contact_solver.contacts + self.hand_contacts:
            if self._bunch_of[contact.body] == bunch and contact.actor not in ("world", "plants"):
                pushes[contact.actor] = pushes.get(contact.actor, 0.0) + float(np.linalg.norm(contact.force))
        return max(sorted(pushes), key=lambda actor: pushes[actor], default="")


def _unit_poses(poses: np.ndarray) -> np.ndarray:
    """Returns poses [k, 7] in double precision, with rotations of length 1."""
    poses = poses.astype(float)
    return frames.pose(poses[:, :3], frames.normalize(poses[:, 3:]))


def _box_around(bunch: FreeBunch, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lower and upper corner [3] m of the world-aligned bounding box of a bunch at ``pose`` [7]."""
    ends = pose[:3] + frames.rotate(pose[3:], np.stack([bunch.start, bunch.end]))
    return (ends - bunch.radius[:, None]).min((0, 1)), (ends + bunch.radius[:, None]).max((0, 1))
