"""All plants of a vineyard, stepped at 100 Hz: free motion, response, commitment. Asleep trees cost nothing.

One tick of the plants alone is ``free()`` then ``commit()``. Whoever solves contacts stands in between: it reads
``state.body_q`` and ``velocity_free``, asks ``response()`` of the bodies it touches, and commits the wrenches it found.

The scheme (:mod:`vinesim.kernels.plant`) damps as if every joint's beta (damping / stiffness) were larger by
``(2 phi - 1) dt``, so the solver takes that off what the model asks, down to nothing: what is asked is what is seen.
"""

from __future__ import annotations

import functools
import math
import weakref
from collections.abc import Callable

import numpy as np
import warp as wp

from vinesim import frames
from vinesim.kernels import plant
from vinesim.kernels.launch import Crew, bind
from vinesim.physics.memory import Memory
from vinesim.world.grow import GRAVITY
from vinesim.world.model import Model
from vinesim.world.state import State

BRISK = 5.0
"""[rad/s] A tree with a joint faster than this is stepped with phi = 1; a body turning faster feels drag."""

ONSET = 3
"""[tick] How long a tree is stepped with phi = 1 after something began to touch it."""

LIMIT = 50.0
"""[rad/s] No joint is integrated faster than this: half a radian in a tick of 10 ms."""

BOUND = 5000.0
"""[rad/s] A tree of which a joint would turn faster than this is not integrated: see :mod:`vinesim.physics.guard`."""

FEW = 100
"""[tree] For fewer awake trees a thread, handing ``free()`` to other threads costs more than it saves."""

FEW_MOVES = 1000
"""[tree] The same for the move at the end of ``commit()``, which is twelve times as short."""


class Plants:
    """The trees of one model and their state, in memory shared by NumPy and Warp.

    ``free()`` chooses each tree's phi: 1 while a joint turns faster than ``brisk`` or for ``ONSET`` ticks after a touch
    began, ``phi`` otherwise. ``response()`` and ``commit()`` belong to the ``free()`` before them.

    Args:
        model: constants; :class:`ValueError` in words if a tree cannot be simulated.
        state: its arrays are read and written in place.
        dt: tick [s].
        phi: 1/2 (trapezoidal, adds no damping) to 1 (backward Euler).
        device: ``"cpu"`` or ``"cuda"``. With a GPU the arrays of ``state`` are replaced by ones that it can reach: take
            them from ``state`` after this. Results agree with the CPU's to rounding, not to the bit.
        threads: on a CPU, so many threads share the awake trees (the result is the same to the bit).
        brisk: [rad/s] see :data:`BRISK`.
        limit: [rad/s] see :data:`LIMIT`.
        bound: [rad/s] see :data:`BOUND`.
        tension: take the stiffness that weight and pull lend to what hangs into the implicit solve. Without it a heavy
            bunch on a soft peduncle gains energy every tick; off only to compare with solvers that do without.
        memory: where arrays live, instead of what ``device`` says.
    """

    def __init__(
        self,
        model: Model,
        state: State,
        *,
        dt: float = 0.01,
        phi: float = 0.55,
        device: str = "cpu",
        threads: int = 1,
        brisk: float = BRISK,
        limit: float = LIMIT,
        bound: float = BOUND,
        tension: bool = True,
        memory: Memory | None = None,
    ) -> None:
        memory = Memory(device) if memory is None else memory
        if threads < 1 or (threads > 1 and not memory.device.is_cpu):
            raise ValueError(f"{threads} threads on {device}: 1 or more on cpu; a GPU needs none, leave threads at 1")
        if not dt > 0.0 or not 0.5 <= phi <= 1.0:
            raise ValueError(f"dt {dt} s, phi {phi}: need dt above 0 and phi from 0.5 to 1")
        check(model, state)
        self.model, self.state = model, state
        self.dt, self.brisk, self.limit, self.bound = dt, brisk, limit, bound
        trees, bodies = len(model.tree_first), len(model.body_mass)
        self.phi = np.full(trees, phi, np.float32)
        """phi asked for each tree [tree]; set it as you like."""
        self.tree_rate = np.zeros(trees, np.float32)
        """Fastest joint that the last commit found [tree] rad/s; NaN or above ``bound`` for a tree that it stopped."""
        self.body_load = np.zeros((bodies, 6), np.float32)
        """Wrenches that last until changed (wind, a rope): force [N], moment about the body's origin [N m], world."""
        self.velocity_free = np.zeros((bodies, 6), np.float32)
        """Velocity of each body of an awake tree at the end of the tick if nothing touches it [body, 6]."""
        self.acceleration = np.zeros((bodies, 6), np.float32)
        """Acceleration over the last tick [body, 6] m/s^2, rad/s^2, world axes."""
        self.body_mass = model.body_mass.copy()
        self.body_inertia = model.body_inertia.copy()
        self.phi_used = np.zeros(trees, np.float32)
        """phi of each tree's last ``free()`` [tree]."""
        self._onset = np.zeros(trees, np.int32)
        self._touched = np.full(trees, -2, np.int64)  # tick of the last touch
        self.tick = 0
        """Commits so far."""
        self._wrench = np.zeros((bodies, 6), np.float32)
        self._pushed = np.zeros(0, np.int32)
        self._stepping = np.zeros(trees, np.int32)
        self._subset = np.zeros(trees, np.int32)
        self._stepped = np.zeros(0, np.int32)
        self._capacity = 0
        self._memory, self.threads = memory, threads
        for owner in (self, state):
            for name, value in vars(owner).items():
                if isinstance(value, np.ndarray):
                    setattr(owner, name, memory.within_reach(value))
        self._crew = Crew(threads) if threads > 1 else None
        if self._crew is not None:
            weakref.finalize(self, self._crew.close)
        self._share_ends = [0] * (threads + 1)
        self._graph: wp.Graph | None = None
        self._graph_count = -1
        self._record(tension)
        self._pack()

    # who is awake

    @property
    def awake(self) -> np.ndarray:
        """Ids of the awake trees, sorted [k] int32."""
        return self._list

    def wake(self, trees: np.ndarray | int) -> None:
        """Let trees move from the next ``free()`` on."""
        trees = np.atleast_1d(trees)
        if not self.state.tree_awake[trees].all():
            self.state.tree_awake[trees] = True
            self._pack()

    def rest(self, trees: np.ndarray | int) -> None:
        """Put trees to sleep where they are, with zero rates; their poses are brought up to date."""
        trees = np.atleast_1d(trees)
        if len(trees) == 0:
            return
        bodies = self.bodies_of(trees)
        self.state.joint_qd[bodies] = 0.0
        self.velocity_free[bodies] = 0.0
        self.acceleration[bodies] = 0.0
        self.tree_rate[trees] = 0.0
        self._onset[trees] = 0
        self.kinematics(trees)
        self.state.tree_awake[trees] = False
        self._pack()

    def bodies_of(self, trees: np.ndarray) -> np.ndarray:
        """All bodies of some trees, tree by tree [k]."""
        first, size = self.model.tree_first[trees], self.model.tree_size[trees]
        end = np.cumsum(size)
        return np.repeat(first - (end - size), size) + np.arange(end[-1] if len(end) else 0)

    # one tick

    def free(self) -> None:
        """Bring ``body_q`` and ``body_qd`` to the start of the tick and solve the motion without contacts."""
        self._choose()
        self._carry_in(len(self._stepped))
        self._all(self._free, FEW)
        self._carry_out_free(len(self._stepped))
        self._memory.wait()

    def response(self, bodies: np.ndarray) -> np.ndarray:
        """How a unit impulse wrench on one body moves another: [n, 6, n, 6] in 1/kg, 1/(kg m), 1/(kg m^2).

        ``response[u, :, t, :] @ impulse`` is the velocity that an impulse wrench (N s, N m s, at the origin of body
        ``t``) adds to body ``u`` of ``bodies`` [n]. Symmetric; zero between different trees.
        """
        n = len(bodies)
        if n == 0:
            return np.zeros((0, 6, 0, 6), np.float32)
        self._must_be_stepping(np.asarray(bodies))
        if n > self._capacity:
            self._record_response(max(2 * self._capacity, n, 16))
        self._asked[:n] = bodies
        self._asked[n] = -1
        self._respond(n)
        self._memory.wait()
        y = self._response[:n, :, :n].reshape(6 * n, 6 * n)
        return (0.5 * (y + y.T)).reshape(n, 6, n, 6)

    def commit(self, bodies: np.ndarray | None = None, wrenches: np.ndarray | None = None) -> None:
        """End the tick: wrenches (N, N m, world, at the bodies' origins) act over it, joints move.

        ``bodies`` [n] may name one body several times; ``wrenches`` is [n, 6].
        """
        changed = len(self._pushed) > 0
        self._wrench[self._pushed] = 0.0
        self._pushed = np.zeros(0, np.int32)
        if bodies is not None and len(bodies):
            bodies = np.asarray(bodies)
            self._must_be_stepping(bodies)
            np.add.at(self._wrench, bodies, np.asarray(wrenches, np.float32))
            self._pushed = bodies.astype(np.int32)
            touched = np.unique(self.model.body_tree[bodies])
            self._subset[: len(touched)] = touched
            self._carry_wrench(len(self._stepped))
            self._push(len(touched))
            begun = touched[self._touched[touched] < self.tick - 1]
            self._onset[begun] = ONSET + 1  # integrating counts this tick
            self._touched[touched] = self.tick
        elif changed:
            self._carry_wrench(len(self._stepped))
        self._all(self._integrate, FEW_MOVES)
        self._carry_out_commit(len(self._stepped))
        self._memory.wait()
        self.tick += 1

    def advance(self, ticks: int) -> None:
        """Many ticks of the awake trees with nothing in between: no contacts, no sleep, no guard.

        Threads part once for all of them. A GPU works on its own copies meanwhile: :meth:`upload` before and
        :meth:`download` after, and between two of those nothing crosses the bus. ``velocity_free`` and
        ``acceleration`` are of the last tick; a tree that went wrong stays where it was (``tree_rate`` is NaN or above
        ``bound``).
        """
        self._choose()
        if len(self._pushed) and ticks > 0:  # the next prediction still knows the last contacts
            self._together(1)
            self._wrench[self._pushed] = 0.0
            self._pushed = np.zeros(0, np.int32)
            self._carry_wrench(len(self._stepped))
            self._together(ticks - 1)
        else:
            self._together(ticks)
        self.tick += ticks

    def upload(self) -> None:
        """Bring the device's copies of the awake trees up to the host's arrays; on a CPU there is nothing to bring."""
        self._choose()
        self._carry_in(len(self._stepped))
        self._memory.wait()

    def download(self) -> None:
        """Bring the host's arrays of the awake trees up to the device's copies, as ``free()`` and ``commit()`` do."""
        self._carry_out_free(len(self._stepped))
        self._carry_out_commit(len(self._stepped))
        self._memory.wait()

    def brace(self, trees: np.ndarray) -> None:
        """Use phi = 1 in the next ``ONSET`` ticks of trees about to be touched (``commit()`` sees to new touches)."""
        self._onset[trees] = ONSET

    def kinematics(self, trees: np.ndarray | None = None) -> None:
        """Bring ``body_q`` and ``body_qd`` of trees (the awake ones unless given) up to their joints; no step."""
        trees = self._list if trees is None else np.atleast_1d(trees)
        self._subset[: len(trees)] = trees
        self._carry_in_place(len(trees))
        self._place(len(trees))
        self._carry_out_place(len(trees))
        self._memory.wait()

    def pull(self, tree: int, joint_q: np.ndarray, joint_qd: np.ndarray, blend: float) -> None:
        """Move one tree towards a state elsewhere: rotations [k, 4] by ``blend`` of the way, rates [k, 3] fully."""
        bodies = self.model.bodies_of(tree)
        there, rates = np.asarray(joint_q, np.float32), np.asarray(joint_qd, np.float32)
        here = self.state.joint_q[bodies]
        if there.shape != here.shape or rates.shape != (len(here), 3):
            raise ValueError(f"tree {tree}: pulled by joints {there.shape}, {rates.shape}; it has {len(here)} bodies")
        there = frames.normalize(there)
        if not np.isfinite(there).all() or not np.isfinite(rates).all() or not (there != 0.0).any(-1).all():
            raise ValueError(
                f"tree {tree}: pulled to a pose that is not finite or has zero quaternions; drop the update"
            )
        turn = frames.log(frames.multiply(frames.conjugate(here), there))
        self.state.joint_q[bodies] = frames.normalize(frames.multiply(here, frames.exp(blend * turn)))
        self.state.joint_qd[bodies] = rates

    # what one may ask

    def joint_wrench(self, bodies: np.ndarray) -> np.ndarray:
        """Force [N] and moment [N m, about the body's origin, world axes] on bodies from their parents [n, 6].

        Of the last tick, and only for bodies of trees that were awake in it. At rest it carries what hangs below.
        """
        n, device = len(bodies), self._memory.device
        out = wp.zeros(n, dtype=wp.spatial_vector, device=device)
        asked = wp.array(np.asarray(bodies, np.int32), dtype=wp.int32, device=device)
        if n:
            m = self._memory.arrays
            wp.launch(
                plant.joint_wrench,
                n,
                inputs=[
                    wp.vec3(GRAVITY), m["tree_first"], m["tree_size"], m["body_tree"], m["body_parent"], m["body_mass"],
                    m["body_com"], m["body_inertia"], asked, m["body_q"], m["body_qd"], m["acceleration"],
                    m["body_load"], m["wrench"],
                ],
                outputs=[out],
                device=device,
            )  # fmt: skip
        return out.numpy()

    def damping_floor(self, frequency: float, phi: float | None = None) -> float:
        """Least damping ratio that a spring mode of this frequency [Hz] can show: pi f (2 phi - 1) dt."""
        phi = float(self.phi.max(initial=0.5)) if phi is None else phi
        return math.pi * frequency * (2.0 * phi - 1.0) * self.dt

    def reweigh(self, body: int, mass: float) -> None:
        """Give one body another mass [kg] (a picked bunch, a pruned leaf); its inertia scales along."""
        if not mass > 0.0:
            raise ValueError(f"body {body}: mass {mass} kg; leave a stub of a gram")
        self.body_inertia[body] *= mass / self.body_mass[body]
        self.body_mass[body] = mass

    # memory and launches

    def _pack(self) -> None:
        self._list = np.flatnonzero(self.state.tree_awake).astype(np.int32)

    def _must_be_stepping(self, bodies: np.ndarray) -> None:
        trees = self.model.body_tree[bodies]
        at = np.searchsorted(self._stepped, trees)
        if len(self._stepped) == 0 or (self._stepped[np.minimum(at, len(self._stepped) - 1)] != trees).any():
            late = next(i for i, tree in enumerate(trees) if tree not in self._stepped)
            raise ValueError(f"body {bodies[late]} is touched, but tree {trees[late]} slept: wake it before free()")

    def _choose(self) -> None:
        """The awake trees are the ones that this tick steps; deal them out to the threads."""
        if self._stepped is self._list:
            return
        self._stepped = trees = self._list
        self._stepping[: len(trees)] = trees
        bodies = np.cumsum(self.model.tree_size[trees])
        parts = np.arange(self.threads + 1) * (int(bodies[-1]) if len(trees) else 0) // self.threads
        self._share_ends[:] = np.searchsorted(bodies, parts, side="right").tolist()

    def _all(self, launch: Callable[..., None], few: int) -> None:
        """Launch over the trees that this tick steps, on all threads if there are ``few`` for each."""
        if self._crew is None or len(self._stepped) < few * self.threads:
            launch(len(self._stepped))
        else:
            self._crew.share(self._shares[launch])

    def _together(self, ticks: int) -> None:
        """Predict and move, so many times, without coming back in between."""
        count, ends = len(self._stepped), self._share_ends
        if count == 0:
            return
        if not self._memory.device.is_cpu:
            if count != self._graph_count:
                with wp.ScopedCapture(self._memory.device) as capture:
                    self._free(count)
                    self._integrate(count)
                self._graph, self._graph_count = capture.graph, count
            for _ in range(ticks):
                wp.capture_launch(self._graph)
            self._memory.wait()
        elif self._crew is None or count < self.threads:
            _run(self._free, self._integrate, ticks, count)
        else:
            self._crew.share(
                [
                    functools.partial(_run, self._free, self._integrate, ticks, ends[i + 1] - ends[i], ends[i], i)
                    for i in range(self.threads)
                ]
            )

    def _record(self, tension: bool) -> None:
        """Bind every kernel to the arrays once.

        Arrays of the model are constants. Of the others, floats with a row for each body are what a GPU keeps a copy
        of (see :mod:`vinesim.physics.memory`); they are carried to it before every ``free()`` unless ``made`` there.
        """
        model, state, memory = self.model, self.state, self._memory
        kinds = {
            wp.int32: {"tree_first": model.tree_first, "tree_size": model.tree_size, "body_tree": model.body_tree,
                       "body_parent": model.body_parent, "stepping": self._stepping, "subset": self._subset,
                       "onset": self._onset},
            float: {"body_mass": self.body_mass, "tree_phi": self.phi, "phi_used": self.phi_used,
                    "tree_rate": self.tree_rate},
            wp.bool: {"tree_awake": state.tree_awake},
            wp.vec3: {"body_offset": model.body_offset, "body_com": model.body_com, "body_inertia": self.body_inertia,
                      "joint_stiffness": model.joint_stiffness,
                      "joint_damping": model.joint_damping, "joint_qd": state.joint_qd},
            wp.quat: {"body_rest": model.body_rest, "joint_q": state.joint_q},
            wp.transform: {"tree_pose": model.tree_pose, "body_q": state.body_q},
            wp.spatial_vector: {"body_qd": state.body_qd, "body_load": self.body_load, "wrench": self._wrench,
                                "acceleration": self.acceleration, "velocity_free": self.velocity_free},
        }  # fmt: skip
        made = ("body_q", "body_qd", "velocity_free", "acceleration", "wrench")
        given = []
        constants = {id(value) for value in vars(model).values()}
        bodies = len(model.body_mass)
        for dtype, arrays in kinds.items():
            for name, data in arrays.items():
                if id(data) in constants:
                    memory.constant(name, data, dtype)
                elif data.dtype == np.float32 and len(data) == bodies and not name.startswith("tree"):
                    memory.rows(name, data, dtype)
                    given += [name] if name not in made else []
                else:
                    memory.reach(name, data, dtype)
        scratch = {
            wp.vec3: ("lever", "drawn", "Du", "joint_qd_free"),
            wp.quat: ("axes",),
            wp.mat33: ("J", "H", "M", "D", "DJ", "DH"),
            wp.spatial_vector: ("bias", "spread"),
        }
        for dtype, names in scratch.items():
            for name in names:
                memory.scratch(name, bodies, dtype)
        a, largest = memory.arrays, int(model.tree_size.max(initial=1))

        def record(kernel: wp.Kernel, *inputs: object, **options: object) -> Callable[..., None]:
            given = [a[value] if isinstance(value, str) else value for value in inputs]
            return bind(kernel, given, [], device=str(memory.device), **options)

        def carrier(trees: str, *names: str, back: bool = False) -> Callable[[int], None]:
            return memory.carrier(names, trees, largest, back=back)

        self._carry_in = carrier("stepping", *given)
        self._carry_out_free = carrier("stepping", "body_q", "body_qd", "velocity_free", back=True)
        self._carry_wrench = carrier("stepping", "wrench")
        self._carry_out_commit = carrier("stepping", "joint_q", "joint_qd", "acceleration", back=True)
        self._carry_in_place = carrier("subset", "joint_q", "joint_qd")
        self._carry_out_place = carrier("subset", "body_q", "body_qd", back=True)

        gravity, dt = wp.vec3(GRAVITY), self.dt
        tree, joint = ("tree_first", "tree_size"), ("body_parent", "body_offset", "body_rest")
        factors = ("axes", "lever", "D", "DJ", "DH")
        dealt = {"over": "trees", "shares": self.threads}
        self._place = record(
            plant.place, *tree, "tree_pose", *joint, "subset", "joint_q", "joint_qd", "body_q", "body_qd"
        )
        self._free = record(
            plant.free, dt, self.brisk, float(tension), gravity, *tree, "tree_pose", *joint, "body_mass", "body_com",
            "body_inertia", "joint_stiffness", "joint_damping", "stepping", "tree_phi", "onset", "body_load", "wrench",
            "joint_q", "joint_qd", "body_q", "body_qd", "phi_used", "axes", "lever", "J", "H", "M", "bias", "drawn",
            "D", "DJ", "DH", "Du", "acceleration", "joint_qd_free", "velocity_free", **dealt,
        )  # fmt: skip
        self._push = record(
            plant.push, dt, *tree, "body_parent", "subset", "wrench", *factors, "spread", "Du", "acceleration",
            "joint_qd_free",
        )  # fmt: skip
        self._integrate = record(
            plant.integrate, dt, self.limit, self.bound, *tree, "stepping", "tree_awake", "phi_used", "joint_qd_free",
            "joint_q", "joint_qd", "tree_rate", "onset", "joint_q", "joint_qd", **dealt,
        )  # fmt: skip
        self._bind = record
        ends = self._share_ends

        def part(launch: Callable[..., None], i: int) -> Callable[[], None]:
            return lambda: launch(ends[i + 1] - ends[i], ends[i], i)

        self._shares = {
            launch: [part(launch, i) for i in range(self.threads)] for launch in (self._free, self._integrate)
        }

    def _record_response(self, capacity: int) -> None:
        """Room for the responses of ``capacity`` bodies at once."""
        self._capacity, memory = capacity, self._memory
        self._asked = memory.within_reach(np.full(capacity + 1, -1, np.int32))
        self._response = memory.within_reach(np.zeros((capacity, 6, capacity, 6), np.float32))
        stride = int(self.model.tree_size.max())
        columns = [wp.empty(capacity * stride, dtype=wp.mat33, device=memory.device) for _ in range(4)]
        memory.reach("asked", self._asked, wp.int32)
        memory.reach("response", self._response, float)
        self._respond = self._bind(
            plant.response, "tree_first", "body_tree", "body_parent", stride, "asked", "lever", "D", "DJ", "DH",
            *columns, "response",
        )  # fmt: skip


def _run(
    free: Callable[..., None], integrate: Callable[..., None], ticks: int, count: int, first: int = 0, share: int = 0
) -> None:
    """Many ticks of some of the listed trees, on one thread."""
    for _ in range(ticks):
        free(count, first, share)
        integrate(count, first, share)


def check(model: Model, state: State) -> None:
    """Raise :class:`ValueError` naming the first tree or body that cannot be simulated, and the remedy."""
    model.check()
    state.check()
    if len(state.joint_q) != len(model.body_mass) or len(state.tree_awake) != len(model.tree_first):
        raise ValueError(
            f"state of {len(state.joint_q)} bodies for a model of {len(model.body_mass)}; use State.at_rest"
        )

    def refuse(bad: np.ndarray, what: str, value: np.ndarray, remedy: str) -> None:
        if bad.any():
            body = int(np.argmax(bad.reshape(len(bad), -1).any(-1)))
            tree = int(model.body_tree[body])
            raise ValueError(f"body {body} of tree {tree}: {what} {np.asarray(value[body]).tolist()}; {remedy}")

    count = len(model.body_mass)
    owner = np.repeat(np.arange(len(model.tree_first)), model.tree_size)
    start = np.cumsum(model.tree_size) - model.tree_size
    if len(owner) != count or (model.tree_first != start).any() or (model.tree_size < 1).any():
        raise ValueError("tree_first and tree_size do not tile the bodies; build the model with grow.assemble")
    refuse(model.body_tree != owner, "is listed in tree", model.body_tree, "body_tree must agree with tree_first")
    parent = model.body_parent
    refuse(parent >= np.arange(count), "parent", parent, "a parent stands before its children (no cycles); reorder")
    refuse((parent < -1) | ((parent >= 0) & (parent < start[owner])), "parent", parent, "name a body of the same tree")
    refuse(~(model.body_length > 0.0), "length [m]", model.body_length, "give a positive length or leave the body out")
    refuse(~(model.body_mass > 0.0), "mass [kg]", model.body_mass, "give a positive mass or leave the body out")
    refuse(~(model.body_inertia > 0.0), "inertia [kg m^2]", model.body_inertia, "give positive principal moments")
    refuse(
        model.joint_stiffness < 0.0, "stiffness [N m/rad]", model.joint_stiffness, "a spring pulls back: use 0 or more"
    )
    refuse(
        model.joint_damping < 0.0, "damping [N m s/rad]", model.joint_damping, "a damper takes energy: use 0 or more"
    )
    for what, q in (("rest rotation", model.body_rest), ("joint rotation", state.joint_q)):
        refuse(abs(np.linalg.norm(q, axis=-1) - 1.0) > 1e-3, what, q, "give a unit quaternion xyzw")
