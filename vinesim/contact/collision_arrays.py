"""Arrays of the plants and of the rigid world that collision detection, the impulse solver and their kernels share."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import warp as wp

from vinesim.contact.plant_capsules import PlantCapsules
from vinesim.core import frames
from vinesim.core.warp_arrays import SharedArrays, share, struct_fields, zeros
from vinesim.kernels.contact import broadphase, structs
from vinesim.kernels.contact.friction_law import Surface
from vinesim.kernels.graph import KernelLaunch
from vinesim.plants.articulation_solver import ArticulationSolver, spans
from vinesim.rigid.collision_geoms import RigidGeoms, concatenate, persistent_names
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.rigid.static_world import FIRST_FIXED_GEOM
from vinesim.scene.materials import pair_tables
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.wires.elastic_supports import WIRE_DAMPING_TIME


def kernel_parameters(p: PhysicsParameters) -> structs.Parameters:
    """Returns the numbers of the contact model as a Warp struct."""
    made = structs.Parameters()
    made.dt = p.dt
    made.margin = p.contact_margin
    made.static_margin = p.static_contact_margin
    made.max_separation_speed = p.max_separation_speed
    made.impact_speed = p.impact_speed
    made.wire_damping_time = WIRE_DAMPING_TIME
    return made


def material_pairs(p: PhysicsParameters) -> np.ndarray:
    """Returns the contact properties of each pair of materials: records of :class:`Surface` [material, material]."""
    tables = pair_tables(p)
    stiffness = tables["stiffness"]
    tables["damping"] = p.contact_damping_time * stiffness
    tables["compliance"] = 1.0 / (p.dt * (stiffness * p.dt + tables["damping"]))
    pairs = zeros(Surface, stiffness.shape)
    for name in struct_fields(Surface):
        pairs[name] = tables[name]
    return pairs


class PlantArrays:
    """Arrays of the bodies, trees and capsules of all plants, as the contact kernels read them."""

    def __init__(self, model: Model, plants: ArticulationSolver, capsules: PlantCapsules) -> None:
        state = plants.state
        count = len(model.tree_first)
        self.trees = SharedArrays(
            structs.Trees,
            awake=np.zeros(count, np.int32),
            is_awake=state.tree_awake,
            is_fine=state.tree_fine,
            is_remote=np.zeros(count, np.bool_),
            bunch_attached=state.bunch_attached,
        )
        self.bodies = SharedArrays(
            structs.PlantBodies,
            parent=plants.body_parent,
            tree=model.body_tree,
            is_cut=state.body_cut,
            q=state.body_q,
            qd=state.body_qd,
            qd_free=plants.velocity_free,
        )
        last_bunch = np.full(count, -1, np.int32)
        np.maximum.at(last_bunch, model.body_tree[capsules.body], capsules.bunch)
        ends = np.maximum(np.linalg.norm(capsules.start, axis=1), np.linalg.norm(capsules.end, axis=1))
        rest = model.forward_kinematics(model.joint_settled)[capsules.body]
        rest_start, rest_end = (
            (rest[:, :3] + frames.rotate(rest[:, 3:], end.astype(float))).astype(np.float32)
            for end in (capsules.start, capsules.end)
        )
        tied_geom, tied_joint = _tied_geoms(model)
        self.capsules = SharedArrays(
            structs.Capsules,
            tree_start=capsules.tree_start,
            tree_last_bunch=last_bunch,
            body=capsules.body,
            bunch=capsules.bunch,
            branch=capsules.branch,
            level=capsules.level,
            local_start=capsules.start,
            local_end=capsules.end,
            radius=capsules.radius,
            stiffness=capsules.stiffness,
            material=capsules.material,
            extent=(ends + capsules.radius).astype(np.float32),
            rest_start=rest_start,
            rest_end=rest_end,
            tied_geom=tied_geom[capsules.body],
            tied_joint=tied_joint[capsules.body],
        )
        self.capsule_states = SharedArrays.zeros(structs.CapsuleStates, len(capsules.body))
        self.leaves: structs.Leaves | None = None
        """Leaves that can be touched; None without any."""
        if len(capsules.body) > capsules.tree_start[-1]:
            self.leaves = leaves = structs.Leaves()
            leaves.tree_start = share(capsules.leaf_start, wp.int32)
            leaves.reach = share(capsules.leaf_reach, wp.float32)
            leaves.most_reach = float(capsules.leaf_reach.max())


def _tied_geoms(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Returns the wires that each body does not collide with [body, k], as MuJoCo geom indices; -1 for no wire.

    A body does not collide with the wires to which it, its parent or one of its children is tied. Such a tie is a
    spring that acts in both directions, and the geom of the wire has the position of the straight wire.

    Also returns the body [body, k] whose joint connects the body with that parent or child; -1 where the body itself is
    tied.
    """
    bound = model.tie_wire >= 0
    body = model.tie_body[bound]
    geom = model.tie_wire[bound] + FIRST_FIXED_GEOM
    parent = model.body_parent
    first = np.searchsorted(body, parent)
    end = np.searchsorted(body, parent, side="right")
    count = np.where(parent >= 0, end - first, 0)
    of_parent = spans(first, count)
    above = parent[body] >= 0
    child = np.repeat(np.arange(len(parent)), count)
    bodies = np.concatenate([body, parent[body][above], child])
    joints = np.concatenate([np.full(len(body), -1), body[above], child])
    rows = np.stack([bodies, np.concatenate([geom, geom[above], geom[of_parent]]), joints], -1)
    rows = np.unique(rows, axis=0)
    place = np.arange(len(rows)) - np.searchsorted(rows[:, 0], rows[:, 0])
    tables = np.full((2, len(parent), place.max(initial=-1) + 1), -1, np.int32)
    tables[:, rows[:, 0], place] = rows[:, 1:].T
    return tables[0], tables[1]


_GEOM_FIELDS = tuple(field.name for field in dataclasses.fields(RigidGeoms) if field.name not in ("actor", "link"))


class RigidArrays:
    """Geoms and degrees of freedom of the rigid world. A new object is made each time the world is compiled.

    A geom is *listed* while it can collide with plants; a hand that holds something has no listed geoms, for example.
    The arrays have room for all geoms of the world. So their memory stays the same when hands open and close and when
    dormant bunches get bodies. :meth:`update` writes the geoms that are listed at the time of the call.
    """

    def __init__(
        self,
        rigid: RigidWorld,
        remote_actors: set[str],
        kernel_parameters: structs.Parameters,
        previous: RigidArrays | None,
    ) -> None:
        """``previous``: arrays from which the velocities of the last step are taken, by names of degrees of freedom."""
        self.world = rigid.mj_model
        data = rigid.mj_data
        world = self.world
        self.static = len(rigid.static_geoms.id)
        # uneven ground is one geom for MuJoCo, and a list of tiles here
        self.capacity = world.ngeom + self.static - len(np.unique(rigid.static_geoms.id))
        self.geoms = SharedArrays.zeros(structs.Geoms, self.capacity, count=np.zeros(2, np.int32))
        self.geom_states = SharedArrays.zeros(structs.GeomStates, self.capacity)
        self.bunch_of_geom = np.full(self.capacity, -1, np.int32)
        """[geom] Index of the free bunch that the geom belongs to; -1 for geoms of no bunch."""
        self.actors = SharedArrays.zeros(
            structs.Actors, self.capacity, start=np.zeros(self.capacity + 1, np.int32), count=np.zeros(1, np.int32)
        )
        self.hulls = rigid.hulls
        self._is_wire = rigid.model.fixed_tension > 0.0
        self.wire_of_geom = np.full(self.capacity + 1, -1)
        """[geom] Index of the fixed piece if the geom is a wire that deflects, else -1.

        The last entry, -1, is used for contacts between plants, which have no geom.
        """
        self.geom_of_wire = np.full(len(self._is_wire), -1)
        """[fixed piece] Index of the geom if the piece is a wire that deflects, else -1."""
        self._list(rigid, remote_actors)
        self.dof_names = rigid.dof_names
        velocity = rigid.velocity_free
        correction = np.zeros(world.nv)
        before = np.zeros(world.nv)
        if previous is not None:
            at = {name: i for i, name in enumerate(previous.dof_names)}
            same = np.array([at.get(name, -1) for name in self.dof_names], int)
            new = same >= 0
            old = same[same >= 0]
            velocity[new] = previous.bodies.velocity_free[old]
            correction[new] = previous.bodies.correction[old]
            before[new] = previous.bodies.correction_before[old]
        self.bodies = SharedArrays(
            structs.RigidBodies,
            xpos=data.geom_xpos,
            xmat=data.geom_xmat.reshape(-1, 3, 3),
            cvel=data.cvel,
            cdof=data.cdof,
            subtree_com=data.subtree_com,
            dof_parent=world.dof_parentid,
            dof_tree=world.dof_treeid,
            tree_asleep=data.tree_asleep,
            velocity_free=velocity,
            correction=correction,
            correction_before=before,
            tree_island=np.zeros(world.ntree, np.int32),
        )
        qvel, qacc = (share(values, wp.float64) for values in (data.qvel, data.qacc))
        self._free_velocities = [kernel_parameters, qvel, qacc]
        self.factors = SharedArrays(
            structs.RigidFactors,
            tree_dof=world.tree_dofadr,
            tree_dof_count=world.tree_dofnum,
            row_start=world.M_rowadr,
            row_count=world.M_rownnz,
            column=world.M_colind,
            implicit=data.qH,
            implicit_inverse=data.qHDiagInv,
            plain=data.qLD,
            plain_inverse=data.qLDiagInv,
        )

    def _list(self, rigid: RigidWorld, remote_actors: set[str]) -> None:
        """Write the geoms that can collide with plants at present to the first entries of the geom arrays, movable
        geoms before static ones. Also write the actors to which the movable geoms belong.

        ``remote_actors``: names of the actors that other clients control.
        """
        listed = self.listed = concatenate(rigid.geoms, rigid.static_geoms)
        count, movable = self.count, self.movable = len(listed.id), len(rigid.geoms.id)
        for name in _GEOM_FIELDS:
            getattr(self.geoms, name)[:count] = getattr(listed, name)
        actor = listed.actor
        is_remote = self.geoms.is_remote
        is_remote[:count] = [name in remote_actors for name in actor]
        self.geoms.touches_leaves[:count] = [name in rigid.actors for name in actor]
        self.bunch_of_geom[:count] = [int(name[6:]) if name.startswith("bunch/") else -1 for name in actor]
        self.geoms.count[:] = movable, count
        fixed = np.flatnonzero(self._is_wire) + FIRST_FIXED_GEOM
        of_fixed = movable + np.searchsorted(rigid.static_geoms.id, fixed)
        self.wire_of_geom[:] = self.geom_of_wire[:] = -1
        self.wire_of_geom[of_fixed] = fixed - FIRST_FIXED_GEOM
        self.geom_of_wire[fixed - FIRST_FIXED_GEOM] = of_fixed
        first = [i for i in range(movable) if i == 0 or actor[i] != actor[i - 1]]
        self.actor_count = self.actors.count[0] = len(first)
        self.actors.start[: len(first) + 1] = [*first, movable]
        self.actors.is_remote[: len(first)] = is_remote[first]
        self.actors.may_sleep[: len(first)] = [actor[i] not in rigid.actors for i in first]

    @functools.cached_property
    def names(self) -> list[tuple[str, str, int]]:
        """[geom] Names of the listed geoms, which stay valid when the rigid world is recompiled."""
        return persistent_names(self.listed)

    def update(self, rigid: RigidWorld, remote_actors: set[str]) -> np.ndarray:
        """Write the arrays again after the rigid world has renumbered its geoms without a recompilation.

        Returns the new index [geom] of each previously listed geom; -1 if it is no longer listed.
        """
        former = self.geoms.id[: self.count].copy()
        self._list(rigid, remote_actors)
        self.__dict__.pop("names", None)
        number = np.full(self.capacity, -1)
        number[self.geoms.id[: self.count]] = np.arange(self.count)
        before = self.dof_names
        self.dof_names = rigid.dof_names
        if before != self.dof_names:
            other = [i for i, (old, new) in enumerate(zip(before, self.dof_names, strict=True)) if old != new]
            self.bodies.velocity_free[other] = rigid.velocity_free[other]
            self.bodies.correction[other] = self.bodies.correction_before[other] = 0.0
        return number[former]

    @functools.cached_property
    def take_free_velocities(self) -> KernelLaunch:
        """Launch of the kernel that computes for each degree of freedom the velocity at the end of the step if no plant
        touches a rigid body, and the velocity change that plants caused in the last step.
        """
        return KernelLaunch(
            broadphase.take_free_velocities, self._free_velocities, [self.bodies.struct], threads=self.world.nv
        )
