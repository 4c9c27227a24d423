"""Sway: poses of trees that wind moves while they are not simulated, for cameras and lidars.

A tree is modelled as three oscillators, one for wind along each world axis. The shape of each oscillator is the static
deflection of the tree in that wind, which the solver finds with weight, ties and wires. Its frequency is the Rayleigh
quotient of the shape, its damping comes from joints and air. The response to a steady wind is the equilibrium in it;
the response to gusts is linear about that equilibrium. So the pose is a function of position and time without a state:
all clients compute the same pose, at any instant. The physics of sleeping trees is not affected.
"""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np
import warp as wp

from vinesim.core import disk_cache, frames
from vinesim.kernels.plants.forces import AIR_DENSITY
from vinesim.kernels.plants.residual_motion import REST_STEP
from vinesim.kernels.plants.sway import sway_trees
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.equilibrium import EquilibriumFinder
from vinesim.scene.model import Model
from vinesim.scene.state import State
from vinesim.scene.values import Snapshot, WindState
from vinesim.scene.wind import Wind
from vinesim.wind.shelter import TreeDrag
from vinesim.wires.elastic_supports import ElasticSupports

MAX_TREES = 120
"""Largest number of trees that get a new pose for one frame if an ``eye`` is given. TUNED: these take up to 0.5 ms."""
_LOAD_STEPS = 4
_NEWTON_STEPS = 80
_CONVERGED = 1e-4
"""[m] Distance from equilibrium below which a tree has converged; trees that do not converge do not sway."""
_ENOUGH = 0.99
"""[1] Share of the trees that must have converged before the iteration ends. Rounding errors delay a few trees far from
the origin."""
_MIN_DISTANCE = 1.0
"""[m] Trees nearer than this are treated as if they were at this distance."""


class Sway:
    """Computes the poses in which trees are drawn in wind, in snapshots of the world.

    A ``Sway`` stores the poses that it computed last, so the snapshots must be passed in order of time.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self._wind: Wind | None = None
        self._table: _Table | None = None
        self._is_drawn = np.zeros(len(model.tree_first), bool)
        """[tree] Whether the drawn pose of each tree differs from its simulated pose."""
        self._drawn_at = np.full(len(model.tree_first), -1e6)
        """[tree] World time of the last pose computed for each tree [s]."""
        self._foot = np.ascontiguousarray(model.tree_pose[:, :3].T, np.float32)
        self._body_q = np.zeros((0, 7), np.float32)

    def apply(self, snapshot: Snapshot, moved: np.ndarray | None = None, eye: np.ndarray | None = None) -> Snapshot:
        """Returns the snapshot with the poses in which trees are drawn; ``snapshot`` itself if the air is calm.

        ``moved``: trees [k] whose simulated pose may have changed since the last call; default
        ``snapshot.moved_trees``. With a viewpoint ``eye`` [3] m at most :data:`MAX_TREES` trees get new poses, first
        the trees whose picture from the eye is most out of date. The next call overwrites the poses.
        """
        state = snapshot.wind
        if state is None and self._wind is None:
            return snapshot if moved is None else dataclasses.replace(snapshot, moved_trees=moved)
        wind = None if state is None else state.wind
        if wind is not self._wind:
            self._wind = wind
            self._table = None if wind is None else _Table.load(self.model, wind)
        changed = np.zeros(len(self._is_drawn), bool)
        changed[snapshot.moved_trees if moved is None else moved] = True
        if state is None or self._table is None:
            changed |= self._is_drawn
            self._is_drawn[:] = False
            return dataclasses.replace(snapshot, moved_trees=np.flatnonzero(changed))
        if not self._is_drawn.any() or self._body_q.shape != snapshot.body_q.shape:
            self._body_q = np.array(snapshot.body_q, np.float32)
        drawn = (state.tree_drawn > 0.0) & self._table.sways
        changed |= self._is_drawn & ~drawn  # trees that return to their simulated poses
        is_limited = eye is not None and len(drawn) > MAX_TREES
        changed[self._most_urgent(drawn, state.time, np.asarray(eye, np.float32)) if is_limited else drawn] = True
        trees = np.flatnonzero(changed)
        self._table.leave_stumps(self.model, snapshot.stumps)
        self._table.pose(trees, state, np.ascontiguousarray(snapshot.body_q, np.float32), self._body_q)
        self._is_drawn[trees] = drawn[trees]
        self._drawn_at[trees] = state.time
        return dataclasses.replace(snapshot, body_q=self._body_q, moved_trees=trees)

    def _most_urgent(self, drawn: np.ndarray, time: float, eye: np.ndarray) -> np.ndarray:
        """Returns the :data:`MAX_TREES` trees among ``drawn`` [tree] bool whose picture from ``eye`` is most out of
        date.

        The measure is an angle: reach of the tree times age of its pose, divided by distance.
        """
        assert self._table is not None
        away = self._foot - eye[:, None]
        away *= away
        square = np.maximum(away[0] + away[1] + away[2], _MIN_DISTANCE**2)
        angle = self._table.tree_reach * (time - self._drawn_at)
        angle *= angle * drawn
        angle /= square
        most = np.argpartition(angle, -MAX_TREES)[-MAX_TREES:]
        return most[angle[most] > 0.0]


def windblown(model: Model, snapshot: Snapshot, wind: Wind | None, time: float) -> Snapshot:
    """Returns a snapshot of plants at rest with the poses that the wind causes at ``time`` [s]. For pictures without
    physics."""
    if wind is None:
        return snapshot
    trees = len(model.tree_first)
    blown = WindState(wind, time, 1.0, np.zeros((trees, 3), np.float32), np.ones(trees, np.float32))
    return Sway(model).apply(dataclasses.replace(snapshot, wind=blown))


@dataclasses.dataclass(slots=True)
class _Table:
    """Response of a model's trees to a wind. :mod:`vinesim.kernels.plants.sway` describes the arrays."""

    wind: Wind
    tree_reach: np.ndarray
    """[tree] m, largest displacement of any point of the tree by the mean wind; 0 for trees that do not sway."""
    sways: np.ndarray
    """[tree] bool, whether the tree sways."""
    tree_air: np.ndarray
    tree_drawn: np.ndarray
    trees: np.ndarray
    waves: np.ndarray
    arrays: dict[str, wp.array]
    stumps: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """``Snapshot.stumps`` to which the arrays belong."""
    whole: list[tuple[str, int, np.ndarray]] = dataclasses.field(default_factory=list)
    """Rows of the arrays before cuts: name, body, value."""

    @classmethod
    def load(cls, model: Model, wind: Wind) -> _Table:
        """Load the table from the disk cache or compute it, which takes 0.1 s for 200 trees and 3 s for 10,000."""
        here = pathlib.Path(__file__)
        code = [
            here,
            here.with_name("shelter.py"),
            here.parents[1] / "wires" / "elastic_supports.py",
            here.parents[1] / "kernels" / "plants",
            here.parents[1] / "kernels" / "wires",
        ]
        numbers = [wind.mean, wind.wave_number, wind.wave_phase, wind.wave_amplitude]
        blown = b"".join(x.astype(float).tobytes() for x in numbers)
        digest = disk_cache.source_digest(*code, model.digest(), blown)
        made = disk_cache.load_or_make("sway", digest, lambda: _Response(model, wind).arrays())
        trees = len(model.tree_first)
        reach = made["tree_reach"]
        table = cls(
            wind,
            reach,
            reach > 0.0,
            np.zeros((trees, 3), np.float32),
            np.zeros(trees, np.float32),
            np.zeros(trees, np.int32),
            np.zeros(2 * len(wind.wave_phase), np.float32),
            {},
        )
        table.arrays = {
            "tree_first": wp.array(model.tree_first, dtype=wp.int32, device="cpu"),
            "tree_size": wp.array(model.tree_size, dtype=wp.int32, device="cpu"),
            "body_parent": wp.array(model.body_parent, dtype=wp.int32, device="cpu"),
            "body_offset": wp.array(model.body_offset, dtype=wp.vec3, device="cpu"),
            "body_steady": wp.array(made["body_steady"], dtype=wp.vec3, device="cpu"),
            "body_gain": wp.array(made["body_gain"], dtype=wp.mat33, device="cpu"),
            "tree_steady": wp.array(made["tree_steady"], dtype=wp.vec3, device="cpu"),
            "tree_gust": wp.array(made["tree_gust"], dtype=wp.vec3, device="cpu"),
            "turned": wp.zeros(len(model.body_mass), dtype=wp.quat, device="cpu"),
        }
        for name, dtype in (("tree_air", wp.vec3), ("tree_drawn", float), ("trees", wp.int32), ("waves", float)):
            table.arrays[name] = wp.array(getattr(table, name), dtype=dtype, device="cpu", copy=False)
        return table

    def leave_stumps(self, model: Model, stumps: np.ndarray) -> None:
        """Let each stump sway as the segment did that was cut, and the part beyond not at all. ``stumps`` [k, 3]:
        ``Snapshot.stumps``."""
        if np.array_equal(stumps, self.stumps):
            return
        self.stumps = stumps.copy()
        rows = {name: self.arrays[name].numpy() for name in ("body_parent", "body_offset", "body_steady", "body_gain")}
        for name, body, value in reversed(self.whole):
            rows[name][body] = value
        self.whole = []
        for stump, segment, _ in stumps.tolist():
            for name, row in rows.items():
                self.whole += [(name, body, row[body].copy()) for body in (int(stump), int(segment))]
            for name, value in (("body_parent", model.body_parent), ("body_offset", model.body_offset)):
                rows[name][int(stump)] = value[int(segment)]
        for segment in np.unique(stumps[:, 1]).astype(int).tolist():
            first = stumps[stumps[:, 1] == segment]
            lowest = int(first[np.argmin(first[:, 2]), 0])
            for name in ("body_steady", "body_gain"):
                rows[name][lowest] = rows[name][segment]
                rows[name][segment] = 0.0
            rows["body_parent"][segment] = -1

    def pose(self, trees: np.ndarray, state: WindState, body_q: np.ndarray, body_q_out: np.ndarray) -> None:
        """Compute poses of ``trees`` [k] at the time of ``state`` from their simulated poses ``body_q`` [body, 7]."""
        if not len(trees):
            return
        self.tree_air[trees] = state.tree_air[trees]
        self.tree_drawn[trees] = state.tree_drawn[trees]
        self.tree_drawn[trees] *= self.sways[trees]
        self.trees[: len(trees)] = trees
        turned = self.wind.wave_number @ self.wind.mean * state.time
        self.waves[:] = np.concatenate([np.cos(turned), np.sin(turned)])
        a = self.arrays
        for name, poses in (("from", body_q), ("to", body_q_out)):
            if name not in a or a[name].ptr != poses.ctypes.data:
                a[name] = wp.array(poses, dtype=wp.transform, device="cpu", copy=False)
        wp.launch(
            sway_trees,
            len(trees),
            inputs=[
                *(a[name] for name in ("tree_first", "tree_size", "body_parent", "body_offset", "body_steady")),
                *(a[name] for name in ("body_gain", "tree_steady", "tree_gust", "trees", "waves")),
                float(state.strength),
                a["tree_air"],
                a["tree_drawn"],
                a["from"],
            ],
            outputs=[a["turned"], a["to"]],
            device="cpu",
        )


class _Response:
    """Computes the response of a model's trees to a wind, all trees at once."""

    def __init__(self, model: Model, wind: Wind) -> None:
        self.model = model
        self.wind = wind
        self.state = State.at_rest(model)
        drag = TreeDrag.of(model, self.state.body_q)
        self.steady = drag.air_share(wind.mean)[:, None] * wind.mean
        self.share = drag.air_share(wind.mean)
        self.plants = ArticulationSolver(model, self.state)
        self._finder, self._supports = EquilibriumFinder(self.plants), ElasticSupports(self.plants)
        self.plants.wake(np.arange(len(model.tree_first)))
        number = np.arange(len(model.body_mass))
        tree = model.body_tree
        self._core = number - model.tree_first[tree] < model.tree_core[tree]
        self._area = 0.5 * AIR_DENSITY * np.where(self._core, model.body_drag, 0.0).astype(float)
        parent = model.body_parent
        base = np.where((parent < 0)[:, None], model.tree_pose[tree], self.state.body_q[parent])[:, 3:]
        self._joint_axes = frames.multiply(base.astype(float), model.body_rest.astype(float))
        """[body, 4] orientation of each joint's axes in the world at rest."""

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns the arrays of the table, by name; :mod:`vinesim.kernels.plants.sway` describes them."""
        model = self.model
        trees = np.arange(len(self.model.tree_first), dtype=np.int32)
        at_rest = self.state.body_q.copy()
        joint_q = self.state.joint_q.astype(float).copy()
        good = self._move_to_equilibrium(trees)
        steady = frames.log(frames.multiply(self.state.joint_q.astype(float), frames.conjugate(joint_q)))
        steady = frames.rotate(self._joint_axes, steady)
        reach = np.linalg.norm(self.state.body_q[:, :3] - at_rest[:, :3], axis=1)
        gain = np.zeros((len(model.body_mass), 3, 3))
        rate = np.ones((len(trees), 3))
        ratio = np.ones((len(trees), 3))
        turn_before = self._residual_turn(trees, self.steady)
        for axis in range(3):
            turn = self._residual_turn(trees, self.steady, np.eye(3)[axis]) - turn_before
            gain[:, :, axis] = frames.rotate(self._joint_axes, turn)
            rate[:, axis], ratio[:, axis] = self._oscillator(axis, turn)
        bad = ~good[model.body_tree] | ~np.isfinite(gain).all((1, 2)) | ~np.isfinite(steady).all(1)
        good &= np.bincount(model.body_tree, bad, minlength=len(trees)) == 0
        swaying = good[model.body_tree]
        gain[~swaying] = 0.0
        steady[~swaying] = 0.0
        gusts = self.wind.gusts * np.linalg.norm(gain, axis=(1, 2))
        reach = np.maximum.reduceat(np.where(swaying, reach + 1e-3 * gusts, 0.0), model.tree_first)
        made = {
            "tree_reach": np.where(good, np.maximum(reach, 1e-6), 0.0),
            "tree_steady": self.steady,
            "tree_gust": self._filtered_gusts(rate, ratio),
            "body_steady": steady,
            "body_gain": gain,
        }
        return {name: np.ascontiguousarray(values, np.float32) for name, values in made.items()}

    def _load(self, pressure: np.ndarray) -> None:
        """Load each body with the drag of a pressure v |v| [tree, 3] m^2/s^2 in its present pose."""
        force = self._area[:, None] * pressure[self.model.body_tree]
        arm = frames.rotate(self.state.body_q[:, 3:].astype(float), self.model.body_com.astype(float))
        self.plants.body_load[:] = np.concatenate([force, np.cross(arm, force)], 1)

    def _pressure(self, velocity: np.ndarray) -> np.ndarray:
        return np.linalg.norm(velocity, axis=-1, keepdims=True) * velocity

    def _move_to_equilibrium(self, trees: np.ndarray) -> np.ndarray:
        """Move trees to their equilibrium in the steady wind. Returns whether each tree has converged [tree] bool.

        The iteration alternates two steps: Newton's method for the trees with fixed supports, and moving the supports
        into equilibrium with the forces of the trees. It approaches equilibrium from one side. Newton's method with the
        softer springs of moving supports would overshoot.
        """
        good = np.ones(len(trees), bool)
        for step in range(_LOAD_STEPS + _NEWTON_STEPS):
            self._load(min((step + 1) / _LOAD_STEPS, 1.0) * self._pressure(self.steady))
            self.plants.ties.softening[:] = 0.0
            self.plants.root_rests.softening[:] = 0.0
            _, distance, _ = self._finder.residual_motion(trees)
            good &= distance < 1e6
            self._finder.move_to_rest(trees[good])
            self.plants.forward_kinematics(trees)
            self._supports.update()
            if step >= _LOAD_STEPS and np.mean(distance[good] < 0.45 * _CONVERGED) > _ENOUGH:
                break
        return good & (distance < _CONVERGED)

    def _residual_turn(self, trees: np.ndarray, velocity: np.ndarray, extra: np.ndarray | None = None) -> np.ndarray:
        """Returns the rotation [body, 3] rad by which each joint is away from its equilibrium under the drag of a wind
        ``velocity``, in the joint's own axes.

        ``extra``: pressure v |v| that is added to the pressure of this wind [m^2/s^2].
        """
        pressure = self._pressure(velocity)
        self._load(pressure if extra is None else pressure + extra)
        self._finder.residual_motion(trees)
        self.plants.launches.download_impact_rates(len(trees))
        self.plants.buffers.synchronize()
        return 0.25 * REST_STEP * np.where(self._core[:, None], self.plants.joint_qd_free, 0.0).astype(float)

    def _oscillator(self, axis: int, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the angular frequency [tree] rad/s and damping ratio [tree] of the oscillator for wind along a world
        ``axis``.

        ``turn`` [body, 3] rad: rotations of the joints by that wind, which define the oscillator's shape.
        """
        model = self.model
        first = self.model.tree_first
        body_q = self.state.body_q.astype(float)
        bend = frames.rotate(self._joint_axes, turn)
        angle = np.zeros_like(bend)
        shift = np.zeros_like(bend)
        depth = model.depth()
        for level in range(int(depth.max(initial=-1)) + 1):
            here = np.flatnonzero(depth == level)
            parent = model.body_parent[here]
            has = (parent >= 0)[:, None]
            lever = np.where(has, body_q[here, :3] - body_q[parent, :3], 0.0)
            angle[here] = np.where(has, angle[parent], 0.0) + bend[here]
            shift[here] = np.where(has, shift[parent] + np.cross(angle[parent], lever), 0.0)
        at_com = shift + np.cross(angle, frames.rotate(body_q[:, 3:], model.body_com.astype(float)))
        inner = frames.rotate(frames.conjugate(body_q[:, 3:]), angle)
        mass = np.where(self._core, model.body_mass, 0.0)
        inertia = np.where(self._core[:, None], model.body_inertia, 0.0)
        modal_mass = np.add.reduceat(mass * (at_com**2).sum(1) + (inertia * inner**2).sum(1), first)
        work = np.add.reduceat(self._area * at_com[:, axis], first)
        speed = np.linalg.norm(self.steady, axis=1)
        along = (at_com * (self.steady / np.maximum(speed, 1e-9)[:, None])[model.body_tree]).sum(1)
        air = self._area * speed[model.body_tree] * ((at_com**2).sum(1) + along**2)
        damping = np.add.reduceat((model.joint_damping * turn**2).sum(1) + air, first)
        ok = (work > 0.0) & (modal_mass > 0.0)
        rate = np.sqrt(np.where(ok, work, 1.0) / np.where(ok, modal_mass, 1.0))
        return rate, np.where(ok, damping / (2.0 * rate * np.where(ok, modal_mass, 1.0)), 1.0)

    def _filtered_gusts(self, rate: np.ndarray, ratio: np.ndarray) -> np.ndarray:
        """Returns the responses to the gusts: factors [tree, 2 waves, 3] m/s of the cosines and sines of the waves.

        The oscillators have angular frequencies ``rate`` [tree, 3] rad/s and damping ratios ``ratio`` [tree, 3].
        """
        wind = self.wind
        turning = wind.wave_number @ wind.mean
        place = self.model.tree_pose[:, :3].astype(float) @ wind.wave_number.T + wind.wave_phase
        share = (turning / rate[..., None]).transpose(0, 2, 1)  # [tree, wave, 3]
        answer = 1.0 / (1.0 - share**2 + 2j * ratio[:, None] * share)
        shifted = answer * np.exp(-1j * place)[..., None]  # factor of exp(i turning t)
        size = self.share[:, None, None] * wind.wave_amplitude
        return np.concatenate([shifted.real * size, -shifted.imag * size], 1)
