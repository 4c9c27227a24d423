"""Arrays of the plants and of the rigid world that detection and solve share, as the contact kernels see them."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim import frames
from vinesim.kernels.contact import structs
from vinesim.physics.contact.collision_geoms import RigidGeoms, concatenate, persistent_names
from vinesim.physics.contact.plant_capsules import PlantCapsules
from vinesim.physics.contact.warp_arrays import SharedArrays
from vinesim.physics.parameters import PhysicsParameters
from vinesim.physics.plants.articulation_solver import ArticulationSolver
from vinesim.physics.rigid.rigid_world import RigidWorld
from vinesim.scene.model import Model


def kernel_parameters(p: PhysicsParameters) -> structs.Parameters:
    """The numbers of the contact model as a Warp struct."""
    made = structs.Parameters()
    stiffness, damping = p.contact_stiffness, p.contact_damping_time * p.contact_stiffness
    made.dt, made.stiffness, made.damping = p.dt, stiffness, damping
    made.compliance = 1.0 / (p.dt * (stiffness * p.dt + damping))
    made.margin, made.static_margin = p.contact_margin, p.static_contact_margin
    made.max_separation_speed, made.impact_speed = p.max_separation_speed, p.impact_speed
    made.plant_friction = p.friction
    return made


class PlantArrays:
    """Bodies, trees and capsules of all plants."""

    def __init__(self, model: Model, plants: ArticulationSolver, capsules: PlantCapsules) -> None:
        state, count = plants.state, len(model.tree_first)
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
            parent=model.body_parent,
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
        self.capsules = SharedArrays(
            structs.Capsules,
            tree_start=capsules.tree_start,
            tree_last_bunch=last_bunch,
            body=capsules.body,
            bunch=capsules.bunch,
            level=capsules.level,
            local_start=capsules.start,
            local_end=capsules.end,
            radius=capsules.radius,
            extent=(ends + capsules.radius).astype(np.float32),
            rest_start=rest_start,
            rest_end=rest_end,
        )
        self.capsule_states = SharedArrays.zeros(structs.CapsuleStates, len(capsules.body))


class RigidArrays:
    """Geoms and degrees of freedom of the rigid world, from one recompilation or listing of it to the next."""

    def __init__(self, rigid: RigidWorld, remote_actors: set[str], previous: RigidArrays | None) -> None:
        """``previous``: where the velocities of the last step are taken from, by the names of degrees of freedom."""
        world, data = rigid.mj_model, rigid.mj_data
        listed = self.listed = concatenate(rigid.geoms, rigid.static_geoms)
        self.count, self.movable = len(listed.id), len(rigid.geoms.id)
        self.names = persistent_names(listed)
        fields = {f.name: getattr(listed, f.name) for f in dataclasses.fields(RigidGeoms)}
        actor, _ = fields.pop("actor"), fields.pop("link")
        is_remote = np.array([name in remote_actors for name in actor], np.bool_)
        self.geoms = SharedArrays(structs.Geoms, is_remote=is_remote, **fields)
        self.geom_states = SharedArrays.zeros(structs.GeomStates, self.count)
        first = [i for i in range(self.movable) if i == 0 or actor[i] != actor[i - 1]]
        self.actor_count = len(first)
        self.actors = SharedArrays(
            structs.Actors,
            start=np.array([*first, self.movable], np.int32),
            is_remote=is_remote[first],
            may_sleep=np.array([actor[i] not in rigid.actors for i in first], np.bool_),
        )
        self.dof_names = rigid.dof_names
        velocity, correction, before = rigid.velocity_free, np.zeros(world.nv), np.zeros(world.nv)
        if previous is not None:
            at = {name: i for i, name in enumerate(previous.dof_names)}
            same = np.array([at.get(name, -1) for name in self.dof_names], int)
            new, old = same >= 0, same[same >= 0]
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

    def begin_step(self, rigid: RigidWorld) -> None:
        """Take over the free velocities of the coming step, and what plants changed in the last one."""
        bodies = self.bodies
        bodies.correction_before[:] = bodies.correction
        np.subtract(rigid.mj_data.qvel, bodies.velocity_free, out=bodies.correction)
        bodies.velocity_free[:] = rigid.velocity_free
