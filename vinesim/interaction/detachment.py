"""Detachment: bunches that are pulled or bent off their peduncles, and wood that is cut by a closing blade.

A detached bunch becomes a free body of the rigid world in the same tick, with its pose, velocity and weight. Its
peduncle and a stub of one gram stay on the tree, so the numbering of the tree's bodies never changes. A cane is cut
where the blade is: what is beyond the cut falls with everything that grows on it, including its bunches, and the stump
stays (:meth:`ArticulationSolver.cut`).
"""

from __future__ import annotations

import logging

import numpy as np

from vinesim.contact.contact_solver import ContactSolver
from vinesim.core import frames
from vinesim.core.errors import checked_index
from vinesim.interaction.blades import Blade, BladeGrips, WoodPiece
from vinesim.interaction.breaking import (
    CRACK,
    NOTCH,
    UNTIE,
    Overload,
    WoodMonitor,
    distance_from_base,
)
from vinesim.interaction.cutting_force import KERF, remaining_strength, shear_force
from vinesim.interaction.stalk import cut_place, leave_stump, model_pieces, stalk_below, with_settled_stalk, with_stalk
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.rigid.free_bunch import FreeBunch
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene.ids import Organ
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.spare_bodies import PLACE_STEP
from vinesim.scene.values import BladeClosing, Breakage, Contact, Detachment, WireBreak
from vinesim.wires.elastic_supports import ElasticSupports

log = logging.getLogger(__name__)

SAME_CUT = 2e-3
"""Wood shorter than this before or beyond a cut [m] is not cut again: a blade that closes twice cuts once."""
STUB_MASS = 1e-3
"""Mass of the stub that stays on the tree in place of a bunch [kg]."""


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
        self._parameters = parameters
        self.plants = plants
        self.rigid = rigid
        self.contact_solver = contact_solver
        self.blades: list[Blade] = []
        self.grips = BladeGrips(plants, rigid)
        """Holds the wood between the edges of closing blades."""
        self.closings: tuple[BladeClosing, ...] = ()
        """Closings of blades that ended in the last step."""
        self.hand_contacts: tuple[Contact, ...] = ()
        """Forces of hands that hold plants, as contacts. They are used to find the actor who pulled off a bunch. The
        caller writes them.
        """
        model = plants.model
        self._bunch_of = model.bunch_of_body()
        self._wood = np.isin(model.body_organ, (Organ.CANE, Organ.PEDUNCLE)) | model.is_spare()
        self.wood = WoodMonitor(plants, contact_solver.remote_trees, parameters)
        """Finds the wood that breaks under its load."""
        self.breakages: tuple[Breakage, ...] = ()
        """What has given without parting in the last step."""
        self.wire_breaks: tuple[WireBreak, ...] = ()
        """Wires that broke in the last step, sorted by piece."""
        self._breakages: list[Breakage] = []
        self._detachments: list[Detachment] = []

    # ------------------------------------------------------------------ the tick

    def update(self, *, check_load: bool = True) -> tuple[Detachment, ...]:
        """Detach bunches and canes at the end of a step. Returns all detachments since the last call, sorted by body.
        ``check_load``: whether overloaded peduncles break; if not, only cuts are made."""
        if check_load:
            self._detach_overloaded()
        else:
            self.wood.given = set()
        self.closings = ()
        if any(blade.closing for blade in self.blades):
            self._cut_with_blades()
        for blade in self.blades:
            if blade.pieces and not blade.closing:  # it was opened early
                self._leave_notches(blade, blade.pieces)
                blade.pieces = []
        self.breakages, self._breakages = tuple(self._breakages), []
        taken = tuple(sorted(self._detachments, key=lambda parting: parting.body))
        self._detachments = []
        return taken

    def _detach_overloaded(self) -> None:
        """Detach what has broken under its load, on trees that this client controls."""
        for broken in self.wood.update():
            if broken.bunch < 0:
                self._part_cane(broken)
                continue
            actor = self._hardest_pressing_actor(self._bunch_of == broken.bunch)
            at_bunch = broken.body == self.plants.model.bunch_body[broken.bunch]
            place = None if at_bunch else (broken.body, cut_place(self.plants.model, broken.body, 0.0))
            self._pick(broken.bunch, broken.cause, actor, broken.wrench, place, broken.late)
        for kind, tie, pull in self.wood.give_ties():
            model = self.plants.model
            body = int(model.tie_body[tie])
            self._record_breakage(kind, "pull", body, np.append(pull, np.zeros(3)), 0.0, tie)

    def break_wires(self, supports: ElasticSupports) -> None:
        """Let wires break whose tension has passed their strength, and free the ties on them. Call it before
        :meth:`update`, after the wires have got the tension of the step."""
        if self.wire_breaks:
            self.wire_breaks = ()
        for piece in supports.overloaded().tolist():
            plants = self.plants
            tension = float(supports.tension[piece])
            ties = supports.break_wire(piece)
            self.wire_breaks += (WireBreak(plants.tick, piece, tension, tuple(ties.tolist())),)
            for tie in ties.tolist():
                plants.break_tie(tie)
                body = int(plants.ties.tie_body[tie])
                plants.wake(int(plants.model.body_tree[body]))
                self._record_breakage(UNTIE, "pull", body, np.zeros(6), 0.0, tie)

    def _part_cane(self, broken: Overload) -> None:
        """Let a broken cane part at its joint, or at the cut in part that has weakened it, or report a crack."""
        plants = self.plants
        model = plants.model
        body = broken.body
        if not broken.is_crack:
            actor = self._hardest_pressing_actor(model.body_tree == model.body_tree[body])
            if not plants.state.body_cut[body]:
                notched = self._notch_at_joint(body)
                if notched >= 0:
                    at = float(plants.state.notch_at[notched])
                    if plants.stumps.spare_for(notched, at) >= 0:
                        self._cut_cane(notched, broken.cause, actor, broken.wrench, at)
                        return
                self._cut_cane(body, broken.cause, actor, broken.wrench)
            return
        self._record_breakage(CRACK, broken.cause, body, broken.wrench, broken.late)

    def report_work(self, kind: str, cause: str, body: int, at: float, actor: str, tie: int = -1) -> None:
        """Record that an actor changed a plant for good without parting it: ``kind`` ``"notch"``, ``"tied"``,
        ``"untied"`` or ``"leaves"``, ``at`` [m] along ``body``."""
        self._record_breakage(kind, cause, body, np.zeros(6), 0.0, tie, actor, at)

    def _record_breakage(
        self,
        kind: str,
        cause: str,
        body: int,
        wrench: np.ndarray,
        late: float,
        tie: int = -1,
        actor: str | None = None,
        at: float = 0.0,
    ) -> None:
        """Record that the wood at the joint of ``body`` or a ``tie`` of it gave without parting, or what ``actor`` did
        to it ``at`` [m] along ``body``."""
        plants = self.plants
        model = plants.model
        along = np.array([at, 0.0, 0.0]) if tie < 0 else model.tie_point[tie].astype(float)
        pose = plants.state.body_q[body].astype(float)
        if actor is None:
            actor = self._hardest_pressing_actor(model.body_tree == model.body_tree[body])
        self._breakages.append(
            Breakage(
                kind,
                cause,
                plants.tick,
                plants.tick * plants.dt - late,
                int(model.body_tree[body]),
                body,
                tie,
                actor,
                wrench[:3],
                wrench[3:],
                distance_from_base(model, body) + float(along[0]),
                tuple((pose[:3] + frames.rotate(pose[3:], along)).tolist()),
            )
        )

    def _cut_with_blades(self) -> None:
        """Move the edges of closing blades, and cut the wood between edges that have met."""
        self.plants.forward_kinematics()
        for blade in self.blades:
            if blade.closing:
                before = len(self._detachments)
                for piece in self._close(blade):
                    if piece.bunch < 0:
                        if not piece.floats or self.plants.stumps.spare_for(piece.body, piece.at) >= 0:
                            self.cut(piece.body, "blade", blade.actor, piece.at)
                    elif self.plants.state.bunch_attached[piece.bunch]:
                        self.pick(piece.bunch, "blade", blade.actor, piece.segment, piece.at)
                if not blade.closing:
                    blade.detachments = tuple(self._detachments[before:])

    def _close(self, blade: Blade) -> list[WoodPiece]:
        """Move the edges of a closing blade by one step. Returns the wood to cut off, if the edges have met."""
        self._find_pieces(blade)
        obstacle, thickness = self._obstacle(blade)
        goal = max(blade.gap - blade.speed * self.plants.dt, min(thickness, blade.gap), 0.0)
        stalled = blade.advance(goal, self.plants.dt, self._parameters.cutting_energy_share)
        for piece in blade.pieces:
            if piece.bunch >= 0 and piece.depth > piece.kept:
                self.wood.weaken(piece.bunch, *remaining_strength(piece.depth))
        is_blocked = not stalled and thickness >= blade.gap > 0.0
        if blade.gap > 0.0 and not stalled and not is_blocked:
            return []
        blade.closing = False
        blade.closures += 1
        blade.stalled = stalled or is_blocked
        pieces, blade.pieces = blade.pieces, []
        self.grips.release_all(blade)
        mouth = frames.compose(self.rigid.link_pose(blade.actor, blade.link), blade.pose)
        thickest = max(pieces, key=lambda one: (one.diameter, -one.segment), default=None)
        event = BladeClosing(
            tick=self.plants.tick,
            actor=blade.actor,
            link=blade.link,
            outcome="blocked" if is_blocked else "stalled" if stalled else "cut" if pieces else "missed",
            sentence=blade.describe(obstacle if is_blocked else "", thickest),
            force=blade.peak,
            needed=blade.resistance,
            energy=blade.energy,
            body=-1 if thickest is None else thickest.segment,
            at=0.0 if thickest is None else thickest.at,
            diameter=0.0 if thickest is None else thickest.diameter,
            depth=0.0 if thickest is None else thickest.diameter * max(thickest.depth, thickest.kept),
            position=mouth[:3] if thickest is None else self._position(thickest.segment, thickest.at),
        )
        blade.outcome = event.sentence
        self.closings += (event,)
        if blade.stalled:
            log.warning("%s of %s %s", blade.link, blade.actor, blade.outcome)
            self._leave_notches(blade, pieces)
            return []
        return [one for one in pieces if one.bunch >= 0 or self.plants.state.body_cut[one.body] == one.floats]

    def _find_pieces(self, blade: Blade) -> None:
        """List the wood between the edges of a closing blade: what they have bitten into, and what is in the mouth and
        not thicker than the gap."""
        state = self.plants.state
        parent = self.plants.body_parent
        kept = [
            piece
            for piece in blade.pieces
            if piece.diameter > blade.gap
            and state.body_cut[piece.segment] == piece.floats
            and (piece.bunch < 0 or state.bunch_attached[piece.bunch])
        ]
        self._leave_notches(blade, [piece for piece in blade.pieces if piece not in kept])
        known = {piece.body for piece in kept} | {int(parent[piece.body]) for piece in kept}
        for body in self._bodies_in_mouth(blade).tolist():
            bunch = int(self._bunch_of[body])
            if body in known or int(parent[body]) in known or any(one.bunch == bunch >= 0 for one in kept):
                continue
            piece = self._piece(blade, body, bunch)
            if piece.diameter <= blade.gap:
                kept.append(piece)
        blade.pieces = kept

    def _piece(self, blade: Blade, body: int, bunch: int) -> WoodPiece:
        """Returns the wood of the branch with ``body`` in a blade's mouth, where the edges would cut it."""
        model = self.plants.model
        segment, at = (
            self._cut_in_peduncle(blade, bunch) if bunch >= 0 else (body, self._place_on_cane(blade, body) or 0.0)
        )
        whole = self.plants.stumps.segment_of(segment)
        radius = model.body_radius[whole].astype(float)
        length = float(model.body_length[whole])
        diameter = 2.0 * float(radius[0] + (radius[1] - radius[0]) * at / max(length, 1e-9))
        depth = float(self.plants.state.notch_depth[whole])
        apart = abs(float(self.plants.state.notch_at[whole]) - at)
        return WoodPiece(
            body=body,
            bunch=bunch,
            segment=segment,
            at=at,
            diameter=diameter,
            force=shear_force(diameter, self._strength(segment)),
            kept=depth if apart <= KERF else 0.0,
            depth=0.0,
            floats=bool(self.plants.state.body_cut[segment]),
            point=self._in_mouth(blade, self._position(segment, at)),
        )

    def _leave_notches(self, blade: Blade, pieces: list[WoodPiece]) -> None:
        """Record the cuts that a blade has left in ``pieces`` of wood without going through."""
        for piece in pieces:
            segment = self.plants.stumps.segment_of(piece.segment)
            if piece.depth > piece.kept and self.notch(segment, piece.at, piece.depth):
                self.report_work(NOTCH, "blade", piece.segment, piece.at, blade.actor)

    def notch(self, segment: int, at: float, depth: float) -> bool:
        """Leave a cut ``at`` [m] along a segment of wood, as deep as the share ``depth`` of its diameter. It weakens
        the peduncle or the nearest joint of the cane. A segment has one such cut, the deepest. Returns whether it is
        this one."""
        state = self.plants.state
        held = float(state.notch_depth[segment]), float(state.notch_at[segment])
        if (float(np.float32(depth)), float(np.float32(at))) <= held:
            return False
        state.notch_depth[segment] = depth
        state.notch_at[segment] = at
        self._weaken(segment)
        return True

    def _weaken(self, segment: int) -> None:
        """Give the wood near a segment the strength that the cuts in part have left."""
        depth = self.plants.state.notch_depth
        bunch = int(self._bunch_of[segment])
        if bunch >= 0:
            self.wood.weaken(bunch, *remaining_strength(float(depth[self._bunch_of == bunch].max())))
            return
        for joint in (segment, self._continuation(segment)):
            if joint >= 0:
                notched = self._notch_at_joint(joint)
                self.wood.notch_cane(joint, *remaining_strength(float(depth[notched]) if notched >= 0 else 0.0))

    def _continuation(self, segment: int) -> int:
        """Returns the body that continues a segment of a cane at its tip, the thickest one; -1 at the end of a cane."""
        model = self.plants.model
        is_cane = (model.body_organ == int(Organ.CANE)) & (model.body_offset[:, 0] > 0.5 * model.body_length[segment])
        beyond = np.flatnonzero((model.body_parent == segment) & is_cane)
        return int(beyond[np.argmax(model.body_radius[beyond, 0])]) if len(beyond) else -1

    def _weak_joint(self, segment: int) -> int:
        """Returns the body at whose joint the cut in part of a segment of cane weakens the wood: the nearer of both
        ends of the segment. -1 if the segment has no such cut, or was parted there."""
        plants = self.plants
        at = float(plants.state.notch_at[segment])
        length = float(plants.model.body_length[segment])
        if plants.state.notch_depth[segment] <= 0.0:
            return -1
        ends = [start for body, start, _ in plants.stumps.parts_of(segment) if start > 0.0]
        if any(abs(end - at) <= KERF for end in ends):
            return -1
        beyond = self._continuation(segment)
        is_at_tip = at >= 0.5 * length and beyond >= 0
        parted = [end for end in ends if (end > at if is_at_tip else end < at)]
        return -1 if parted else beyond if is_at_tip else segment

    def _notch_at_joint(self, joint: int) -> int:
        """Returns the segment whose cut in part weakens the cane most at the joint of a body; -1 if none does."""
        plants = self.plants
        near = [int(body) for body in (joint, plants.model.body_parent[joint]) if body >= 0]
        found = [body for body in near if self._weak_joint(body) == joint]
        return max(found, key=lambda body: float(plants.state.notch_depth[body]), default=-1)

    def _obstacle(self, blade: Blade) -> tuple[str, float]:
        """Returns what the edges of a blade cannot cut, and its thickness [m] between them: a wire, post or old wood in
        the mouth, or wood that does not fit into it. No obstacle has the thickness 0."""
        model = self.plants.model
        mouth = frames.compose(self.rigid.link_pose(blade.actor, blade.link), blade.pose)
        found = "", 0.0
        if len(model.fixed_start):
            reach = float(np.linalg.norm(blade.half)) + model.fixed_radius.max(1)
            axis = (model.fixed_end - model.fixed_start).astype(float)
            apart = mouth[:3] - model.fixed_start
            square = np.maximum(np.einsum("fi,fi->f", axis, axis), 1e-12)
            share = np.clip(np.einsum("fi,fi->f", apart, axis) / square, 0.0, 1.0)
            near = np.flatnonzero(np.linalg.norm(apart - share[:, None] * axis, axis=1) < reach)
            for i in near.tolist():
                start, end = (
                    self._in_mouth(blade, one[i].astype(float)) for one in (model.fixed_start, model.fixed_end)
                )
                thickness = 2.0 * float(model.fixed_radius[i].max())
                if thickness > found[1] and _passes_mouth(start, end, 0.5 * thickness, blade.half):
                    organ = Organ(int(model.fixed_organ[i])).name.lower()
                    found = f"{organ} {int(model.fixed_index[i])}", thickness
        if blade.gap == blade.opening:
            for body in self._bodies_in_mouth(blade).tolist():
                piece = self._piece(blade, body, int(self._bunch_of[body]))
                if piece.diameter > max(blade.opening, found[1]):
                    found = (
                        f"wood of {1e3 * piece.diameter:.0f} mm, in a mouth of {1e3 * blade.opening:.0f} mm",
                        piece.diameter,
                    )
        return found

    def _position(self, body: int, at: float) -> np.ndarray:
        """Returns the position [3] m in the world of a place ``at`` [m] along a body."""
        pose = self.plants.state.body_q[body].astype(float)
        return pose[:3] + frames.rotate(pose[3:], np.array([at, 0.0, 0.0]))

    def _in_mouth(self, blade: Blade, point: np.ndarray) -> np.ndarray:
        """Returns a ``point`` [3] m of the world in the frame of a blade's mouth."""
        mouth = frames.compose(self.rigid.link_pose(blade.actor, blade.link), blade.pose)
        return frames.rotate(frames.conjugate(mouth[3:]), point - mouth[:3])

    def wood_in_mouth(self, blade: Blade) -> list[tuple[int, int]]:
        """Returns the bodies in a blade's mouth after a step, which it would cut with sufficient force. Each body has
        the index of its bunch, or -1 for a cane."""
        bodies = self._bodies_in_mouth(blade).tolist()
        found = [(body, int(self._bunch_of[body])) for body in bodies]
        return [(body, bunch) for body, bunch in found if bunch < 0 or self.plants.state.bunch_attached[bunch]]

    def cutting_force(self, body: int) -> float:
        """Returns the largest force [N] of a cut through a piece of wood at its root end, where it is thickest; see
        :func:`~vinesim.interaction.cutting_force.shear_force`."""
        segment = self.plants.stumps.segment_of(body)
        return shear_force(2.0 * float(self.plants.model.body_radius[segment, 0]), self._strength(segment))

    def _strength(self, body: int) -> float:
        """Returns the largest cutting force per cross-section [Pa] of a piece of wood."""
        parameters = self._parameters
        is_peduncle = self.plants.model.body_organ[body] == int(Organ.PEDUNCLE)
        return parameters.peduncle_cutting_strength if is_peduncle else parameters.cutting_strength

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
        bunch = checked_index("bunch", bunch, len(self.plants.model.bunch_body))
        if not self.plants.state.bunch_attached[bunch]:
            raise ValueError(f"bunch {bunch} was picked already")
        body = self.plants.model.bunch_body[bunch]
        place = None
        if segment is not None:
            stalk_below(self.plants.model, bunch, segment)
            place = segment, cut_place(self.plants.model, segment, at)
        self._pick(bunch, cause, actor, self.plants.joint_wrench(np.array([body]))[0], place)

    def _pick(
        self,
        bunch: int,
        cause: str,
        actor: str,
        carried: np.ndarray,
        place: tuple[int, float] | None = None,
        late: float = 0.0,
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
        self.contact_solver.ignore_overlaps(bunch, *_box_around(loose, plants.state.body_q[body].astype(float)))
        plants.state.bunch_attached[bunch] = False
        self.wood.forget(bunch)
        plants.set_mass(body, STUB_MASS)
        if state.tree_fine[tree]:
            plants.berry_clusters.release(bunch)
        plants.body_drag[body] = 0.0
        self._record(body, bunch, cause, actor, carried, place, late)

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
        self._cut_cane(body, cause, actor, plants.joint_wrench(np.array([body]))[0], at)

    def _cut_cane(self, body: int, cause: str, actor: str, carried: np.ndarray, at: float | None = None) -> None:
        """Part a cane ``at`` [m] from the origin of ``body``, or at the joint between ``body`` and its parent."""
        plants = self.plants
        tree = int(plants.model.body_tree[body])
        plants.wake(tree)
        plants.forward_kinematics(np.array([tree]))
        stump = plants.cut(body, 0.0 if at is None else at)
        place = None
        if stump >= 0:
            segment = plants.stumps.segment_of(body)
            self.contact_solver.divide_wood(segment)
            self._forget_notch(segment)
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
        """Cut off a body that another client has cut off. Nothing happens to a spare body, which has no wood."""
        if not self.plants.state.body_cut[body] and self.plants.body_end[body] > self.plants.body_start[body]:
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
            self._forget_notch(segment)

    def _forget_notch(self, segment: int) -> None:
        """After a cut through a segment: the wood that a cut in part has weakened may be gone."""
        if self.plants.state.notch_depth[segment] > 0.0:
            self._weaken(segment)

    def _record(
        self,
        body: int,
        bunch: int,
        cause: str,
        actor: str,
        carried: np.ndarray,
        place: tuple[int, float] | None = None,
        late: float = 0.0,
    ) -> None:
        """Record a detachment at ``place`` (a segment and the distance from its origin) or at the joint of ``body``;
        ``late`` [s]: time from the detachment to the end of the step."""
        plants = self.plants
        tree = int(plants.model.body_tree[body])
        segment, at = (-1, 0.0) if place is None else place
        parted = body if place is None else segment
        pose = plants.state.body_q[parted].astype(float)
        self._detachments.append(
            Detachment(
                plants.tick,
                tree,
                body,
                bunch,
                cause,
                actor,
                carried[:3].astype(float),
                carried[3:].astype(float),
                segment,
                at,
                time=plants.tick * plants.dt - late,
                place=distance_from_base(plants.model, parted) + at,
                point=tuple((pose[:3] + frames.rotate(pose[3:], np.array([at, 0.0, 0.0]))).tolist()),
            )
        )

    def _hardest_pressing_actor(self, bodies: np.ndarray) -> str:
        """Returns the name of the actor that presses hardest on ``bodies`` [body] bool; empty if no actor does."""
        pushes: dict[str, float] = {}
        for contact in self.contact_solver.contacts + self.hand_contacts:
            if bodies[contact.body] and contact.actor not in ("world", "plants"):
                pushes[contact.actor] = pushes.get(contact.actor, 0.0) + float(np.linalg.norm(contact.force))
        return max(sorted(pushes), key=lambda actor: pushes[actor], default="")


def _unit_poses(poses: np.ndarray) -> np.ndarray:
    """Returns poses [k, 7] in double precision, with rotations of length 1."""
    poses = poses.astype(float)
    return frames.pose(poses[:, :3], frames.normalize(poses[:, 3:]))


def _passes_mouth(start: np.ndarray, end: np.ndarray, radius: float, half: np.ndarray) -> bool:
    """Returns whether a round bar from ``start`` to ``end`` [3] m, in the frame of a mouth, is between the edges: its
    axis passes through the box with the half edges ``half`` [3] m, or the middle line of the mouth passes through the
    bar."""
    along = end - start
    along = np.where(np.abs(along) < 1e-12, 1e-12, along)
    one, other = (-half - start) / along, (half - start) / along
    if max(np.minimum(one, other).max(), 0.0) <= min(np.maximum(one, other).min(), 1.0):
        return True
    line = np.linspace(-half[0], half[0], 9)[:, None] * np.array([1.0, 0.0, 0.0])
    share = np.clip((line - start) @ along / (along @ along), 0.0, 1.0)
    return bool(np.linalg.norm(line - start - share[:, None] * along, axis=1).min() < radius)


def _box_around(bunch: FreeBunch, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lower and upper corner [3] m of the world-aligned bounding box of a bunch at ``pose`` [7]."""
    ends = pose[:3] + frames.rotate(pose[3:], np.stack([bunch.start, bunch.end]))
    return (ends - bunch.radius[:, None]).min((0, 1)), (ends + bunch.radius[:, None]).max((0, 1))
