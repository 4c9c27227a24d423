"""Equilibrium of single trees: computes how far trees are from equilibrium, and moves trees into it."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.core.warp_arrays import struct_fields
from vinesim.kernels.plants import structs
from vinesim.kernels.plants.residual_motion import REST_STEP, residual_motion
from vinesim.plants.articulation_solver import ArticulationSolver

_INPUTS = ("joint_x", "joint_xd", "joint_q", "joint_qd", "body_load", "body_wrench")


class EquilibriumFinder:
    """Computes how far trees are from their equilibrium poses, between steps; see
    :mod:`vinesim.kernels.plants.residual_motion`.
    """

    def __init__(self, plants: ArticulationSolver) -> None:
        self._plants = plants
        buffers = plants.buffers
        trees = len(plants.model.tree_first)
        slots = buffers.slot_count
        device = buffers.device
        self._speed, self._distance = (buffers.pinned(np.zeros(trees, np.float32)) for _ in range(2))
        self._is_free = buffers.pinned(np.zeros(trees, bool))
        buffers.add_body_rows("body_length", plants.body_end, float)
        for name, data, dtype in (
            ("rest_speed", self._speed, float),
            ("rest_distance", self._distance, float),
            ("is_free", self._is_free, wp.bool),
        ):
            buffers.add_shared(name, data, dtype)
        wrench: Any = wp.spatial_vector
        for name, dtype in (("no_rate", wp.vec3), ("no_wrench", wrench)):
            buffers.arrays[name] = wp.zeros(slots, dtype=dtype, device=device)
        buffers.arrays["no_turn_rate"] = wp.zeros(trees, dtype=wp.vec3, device=device)
        for name, dtype in (("rest_q", wp.transform), ("rest_qd", wrench), ("static_load", wrench)):
            buffers.add_scratch(name, dtype)
        self._upload = buffers.row_copier(_INPUTS, "subset", plants.launches.subset[0])
        self._record(plants)

    def _record(self, plants: ArticulationSolver) -> None:
        """Bind the kernel to its arguments. For scratch, factors and predicted rates it uses the arrays of a step,
        which are free between steps."""
        launches = plants.launches
        s = structs
        fill = launches.fill
        numbers = {name: getattr(launches.parameters, name) for name in struct_fields(s.SolverParameters)}
        prediction = fill(s.Prediction, body_acceleration="impact_acceleration", body_qd_free="impact_velocity")
        measure = launches.launch(
            residual_motion,
            fill(s.SolverParameters, **(numbers | {"dt": REST_STEP})),
            fill(s.ArticulationModel, joint_damping="no_rate"),
            "body_length",
            "tie_axis",
            "tie_softening",
            "root_softening",
            *launches.subset,
            fill(s.AppliedForces),
            fill(s.JointState),
            fill(s.JointState, joint_xd="no_rate", joint_qd="no_rate"),
            fill(s.AppliedForces, body_load="static_load", body_wrench="no_wrench", root_turn_rate="no_turn_rate"),
            "static_load",
            fill(s.BodyState, body_q="rest_q", body_qd="rest_qd"),
            fill(s.Factors),
            fill(s.Scratch),
            prediction,
            "rest_speed",
            "rest_distance",
            "is_free",
        )
        self._measure = launches.graph(measure)

    def residual_motion(self, trees: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute how fast trees [k] move and how far they are from their equilibrium (rest) poses. Call it after
        ``integrate()``.

        Returns three arrays [k]: speed of the tree's fastest point [m/s]; largest distance of a point of the tree from
        its rest position [m]; whether :meth:`move_to_rest` can move the tree.
        """
        plants = self._plants
        plants.list_subset(trees)
        plants.launches.upload_changed()
        self._upload(len(trees))
        self._measure(len(trees))
        plants.buffers.synchronize()
        return self._speed[trees], self._distance[trees], self._is_free[trees]

    def move_to_rest(self, trees: np.ndarray) -> None:
        """Turn the joints of trees [k] to equilibrium by one Newton step, which the last :meth:`residual_motion` has
        computed. Call it only for trees without contacts and without floating roots."""
        plants = self._plants
        plants.list_subset(trees)
        plants.launches.download_impact_rates(len(trees))
        plants.buffers.synchronize()
        bodies = plants.bodies_of(trees)
        moving = bodies - plants.model.tree_first[tree := plants.model.body_tree[bodies]] < plants.tree_moving[tree]
        bodies = bodies[moving]
        state = plants.state
        turn = frames.exp(0.25 * REST_STEP * plants.joint_qd_free[bodies])
        state.joint_q[bodies] = frames.normalize(frames.multiply(turn, state.joint_q[bodies]))
