"""What happened to the fruit: forces, pressures, drops and time in the hand of every bunch, and the berries that burst
or fell off.

Nothing here acts on the physics: bunches keep their mass and their looks. Numbers of berries are expected values, so
they have fractions and are the same in every run.

A berry is a sphere filled with juice, in a skin that carries tension only. Pressed between two plates it flattens by
``x`` of its radius on each side. Its volume stays, so the skin stretches by x^2 / 2, its tension is K x^2 / 2, the
pressure inside is twice tension over radius (Laplace), and the force is pressure times contact area, 2 pi R^2 x. A
surface that presses on a bunch rests on :data:`BERRIES_PER_CONTACT` berries of a cell (:data:`CELLS`).

Forces and accelerations are means over :data:`IMPACT_TIME`, so that they depend little on the step. Of shorter impacts
only this mean is known.
"""

from __future__ import annotations

import math

import numpy as np

from vinesim.contact.contact_solver import ContactSolver
from vinesim.core import frames
from vinesim.core.errors import checked_index
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene.berries import VARIETIES
from vinesim.scene.ids import Organ
from vinesim.scene.values import BunchHistory, Contact, FruitEvent

SKIN_TENSION = 110.0, 420.0
"""[N/m] Range of the tension at which skins burst. READ: nine varieties, injected with water at 15 degrees C, Lang &
During, Vitis 29:61 (1990), abstract. The berries of a bunch are spread evenly over this range: GUESSED, since the
spread within a variety is not in the abstract."""
SKIN_MODULUS_PER_TENSION = 13.9
"""[1] Modulus of skins, 1,700 to 5,400 N/m in the same abstract, by their burst tension. DERIVED: between 15.5 (both
lowest) and 12.9 (both highest). A berry then bursts when it is flattened by 0.38 of its diameter. Berries of wild and
cultivated plants, vine grapes among them, burst at 0.35 to 0.47 between plates (Int. Agrophys. 1994 8:381,
abstract)."""
BERRIES_PER_CONTACT = 3
"""[1] Berries that carry what presses on a cell. DERIVED: a rigid surface rests on three spheres."""
CELLS = 6, 4
"""Number of cells of a bunch's surface along it and around it: 24 of about three berries."""
PULL_OFF = 1.5, 5.0
"""[N] Range of the forces at which berries leave their pedicels, spread evenly. GUESSED: it falls with sugar (AJEV
30:135, 517 berries of V. rotundifolia, abstract without forces)."""
IMPACT_TIME = 0.01
"""[s] Time over which forces and accelerations are averaged. In longer steps it is the step."""
LEAST_DROP = 0.02
"""[m] Smallest height that counts as a drop."""
LEAST_FLIGHT = 0.03
"""[s] Shortest time without contact that counts as a fall."""

_STATIC = -1
_ACTOR = -2


def burst_force(radius: float | np.ndarray, tension: float) -> float | np.ndarray:
    """Returns the force [N] between two plates at which a berry of ``radius`` [m] bursts whose skin bears ``tension``
    [N/m]: 4 pi R x T, at the flattening x = sqrt(2 / :data:`SKIN_MODULUS_PER_TENSION`)."""
    return 4.0 * math.pi * radius * math.sqrt(2.0 / SKIN_MODULUS_PER_TENSION) * tension


def berry_pressure(force: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Returns the pressure [Pa] in berries of ``radius`` [m] between plates that press with ``force`` [N], the same as
    the mean pressure on their contact areas; for a skin in the middle of :data:`SKIN_TENSION`."""
    modulus = SKIN_MODULUS_PER_TENSION * 0.5 * sum(SKIN_TENSION)
    flattening = np.cbrt(force / (2.0 * math.pi * radius * modulus))
    return modulus * flattening * flattening / radius


def share_between(value: np.ndarray, low: float | np.ndarray, high: float | np.ndarray) -> np.ndarray:
    """Returns the share of limits spread evenly from ``low`` to ``high`` that ``value`` exceeds."""
    return np.clip((value - low) / (high - low), 0.0, 1.0)


class FruitMonitor:
    """Records what happens to bunches that are touched or have left their vines, on the client that simulates them."""

    def __init__(self, plants: ArticulationSolver, rigid: RigidWorld, contact_solver: ContactSolver) -> None:
        self.plants = plants
        self.rigid = rigid
        self.contact_solver = contact_solver
        model = plants.model
        count = len(model.bunch_body)
        self.remote = np.zeros(count, bool)
        """[bunch] Whether another client moves the picked bunch, and records what happens to it. The client writes this
        array."""
        self._told = np.zeros((count, 2))
        """[bunch, 2] Numbers of burst and of lost berries that other clients have told."""
        self.events: tuple[FruitEvent, ...] = ()
        """Drops, burst and lost berries of the last step."""
        self._bunch_of = np.where(model.body_organ == int(Organ.BUNCH), model.bunch_of_body(), -1).astype(int)
        kinds = [VARIETIES[i] for i in model.bunch_variety.tolist()]
        self._radius = np.array([kind.volume_radius for kind in kinds])
        self._berry_mass = np.array([kind.mass for kind in kinds])
        self._row = np.full(count, -1)
        self._bunch = np.zeros(0, int)
        """[row] Bunch of each row of the other arrays, which are only for bunches with a history."""
        self._hand_time = np.zeros(0)
        self._impulse = np.zeros(0)
        self._berry_force = np.zeros((0, CELLS[0] * CELLS[1]))
        """[row, cell] N, largest force on a berry."""
        self._acceleration = np.zeros(0)
        self._drops = np.zeros(0, int)
        self._drop_height = np.zeros(0)
        self._top = np.full(0, -np.inf)
        """[row] m, greatest height of the bunch since something last touched it."""
        self._air_time = np.zeros(0)
        window = max(round(IMPACT_TIME / plants.dt), 1)
        self._recent = np.zeros((0, window, CELLS[0] * CELLS[1]))
        """[row, step, cell] N, forces of the last steps; the step is counted modulo their number."""
        self._velocity = np.full((0, window, 3), np.nan)
        """[row, step, 3] m/s, velocities of free bunches in the last steps; the oldest first."""
        self._hanging_velocity = np.zeros((window, count, 3))
        """[step, bunch, 3] m/s, velocities of the middles of hanging bunches in the last steps; the step is counted
        modulo their number. Zero for bunches that sleep, NaN for those that are not simulated here."""
        self._counted = np.zeros((0, 2), int)
        """[row, 2] Whole numbers of burst and lost berries that events have told."""
        self._generation = -1
        self._kind = np.zeros(0, int)
        """[MuJoCo body] Free bunch, or :data:`_ACTOR` for parts of robots and people, :data:`_STATIC` for others."""
        self._free = np.zeros((3, 0), int)
        """[3, k] Free bunches, sorted, their MuJoCo bodies, and their first degrees of freedom."""
        self._mj_body = np.full(count, -1)
        """[bunch] MuJoCo body of each free bunch, -1 for others."""
        self._is_worse = False
        """Whether a largest force or acceleration has risen in this step."""

    # ------------------------------------------------------------------ the step

    def update(self, hand_contacts: tuple[Contact, ...] = ()) -> None:
        """Record the forces of a step, after the rigid world was integrated. ``hand_contacts``: hands that hold
        plants."""
        self.events = ()
        self._find_free_bunches()
        if len(self._bunch):
            self._recent[:, self.plants.tick % self._recent.shape[1]] = 0.0
        touches = self._plant_contacts() if self.contact_solver.count else []
        free = self._free
        if free.shape[1]:
            touches += self._rigid_contacts()
            if self.remote.any():
                free = free[:, ~self.remote[free[0]]]
        if hand_contacts:
            touches.append(self._held_plants(hand_contacts))
        if len(self.plants.awake):
            self._add_shaking()
        supported = np.zeros(len(self._row), bool)
        if touches:
            supported[self._add_touches(touches)] = True
        held = self._held_bunches()
        self._hand_time[self._row[held]] += self.plants.dt
        if free.shape[1]:
            supported[held] = True
            self._add_motion(free, supported)
        if self._is_worse:
            self._is_worse = False
            self._tell()

    def _add_touches(self, touches: list[tuple[np.ndarray, ...]]) -> np.ndarray:
        """Add the contacts of a step to the bunches that this client simulates. Returns these bunches [k]."""
        bunch, force, point, by_actor = (np.concatenate(parts) for parts in zip(*touches, strict=True))
        model = self.plants.model
        hangs = self.plants.state.bunch_attached[bunch]
        tree_is_remote = self.contact_solver.remote_trees[model.body_tree[model.bunch_body[bunch]]]
        mine = ~np.where(hangs, tree_is_remote, self.remote[bunch])
        mine &= (force > 0.0) & (by_actor | ~hangs | (self._row[bunch] >= 0))
        bunch = bunch[mine]
        force = force[mine]
        point = point[mine]
        by_actor = by_actor[mine]
        if len(bunch) == 0:
            return bunch
        self._add_rows(bunch)
        rows = self._row[bunch]
        count, window, cells = self._recent.shape
        if by_actor.any():
            self._impulse += self.plants.dt * np.bincount(rows[by_actor], force[by_actor], count)
            is_in_hand = np.zeros(count, bool)
            is_in_hand[rows[by_actor]] = True
            self._hand_time[is_in_hand] += self.plants.dt
        now = np.bincount(rows * cells + self._cell(bunch, point), force, count * cells).reshape(count, cells)
        self._recent[:, self.plants.tick % window] = now
        mean = (now if window == 1 else self._recent.mean(1)) / BERRIES_PER_CONTACT
        if (mean > self._berry_force).any():
            np.maximum(self._berry_force, mean, out=self._berry_force)
            self._is_worse = True
        return bunch

    def history(self, bunch: int) -> BunchHistory:
        """Returns what has happened to a bunch so far, as far as this client simulated it. Raises :class:`ValueError`
        if there is no such bunch."""
        bunch = checked_index("bunch", bunch, len(self._row))
        berries = int(self.plants.model.bunch_berries[bunch])
        row = int(self._row[bunch])
        burst, lost = self.berries_off(bunch) or (0.0, 0.0)
        if row < 0:
            return BunchHistory(bunch, berries, berries_burst=burst, berries_lost=lost)
        worst = float(self._berry_force[row].max())
        return BunchHistory(
            bunch=bunch,
            berries=berries,
            hand_time=float(self._hand_time[row]),
            impulse=float(self._impulse[row]),
            peak_force=BERRIES_PER_CONTACT * worst,
            peak_pressure=float(berry_pressure(np.array(worst), self._radius[bunch])),
            drops=int(self._drops[row]),
            drop_height=float(self._drop_height[row]),
            acceleration=float(self._acceleration[row]),
            berries_burst=burst,
            berries_lost=lost,
        )

    def berries_off(self, bunch: int) -> tuple[float, float] | None:
        """Returns the expected numbers of berries of a bunch that burst and that were lost, here or on another client,
        of each the greater one. None if nothing happened to it."""
        burst, lost = self._told[bunch].tolist()
        row = int(self._row[bunch])
        if row >= 0:
            here = self._berries(np.array([row]))[0].tolist()
            burst, lost = max(burst, here[0]), max(lost, here[1])
        return (burst, lost) if burst > 0.0 or lost > 0.0 else None

    def learn(self, bunch: int, burst: float, lost: float) -> None:
        """Take over the numbers of burst and of lost berries of a bunch that another client has told."""
        self._told[bunch] = np.maximum(self._told[bunch], (burst, lost))

    def handled(self) -> tuple[int, ...]:
        """Returns the bunches that actors touched, that fell or that were shaken until they lost berries, sorted."""
        shaken = self._acceleration * self._berry_mass[self._bunch] > PULL_OFF[0]
        return tuple(sorted(self._bunch[(self._hand_time > 0.0) | (self._drops > 0) | shaken].tolist()))

    # ------------------------------------------------------------------ contacts of a step
    # as bunches, forces across their surfaces [N], points [3] m, and whether an actor presses

    def _find_free_bunches(self) -> None:
        rigid = self.rigid
        if self._generation == rigid.generation:
            return
        self._generation = rigid.generation
        self._kind = np.full(rigid.mj_model.nbody, _STATIC)
        for body, (actor, _) in rigid.owners.items():
            name, _, number = actor.partition("/")
            self._kind[body] = int(number) if name == "bunch" else _STATIC if name == "box" else _ACTOR
        bodies = np.flatnonzero(self._kind >= 0)
        bodies = bodies[np.argsort(self._kind[bodies])]
        self._free = np.stack([self._kind[bodies], bodies, rigid.mj_model.body_dofadr[bodies]])
        self._mj_body[:] = -1
        self._mj_body[self._free[0]] = bodies

    def _plant_contacts(self) -> list[tuple[np.ndarray, ...]]:
        """Contacts of the contact solver: hanging bunches with anything, and free bunches with plants."""
        solver = self.contact_solver
        n = solver.count
        contacts = solver.impulses.contacts
        other_body = contacts.other_body[:n]
        other = contacts.other[:n]
        one = self._bunch_of[contacts.body[:n]]
        two = np.where(other_body >= 0, self._bunch_of[other_body], -1)
        kind = np.full(n, _STATIC)
        is_geom = other >= 0
        kind[is_geom] = self._kind[solver.geom_bodies[other[is_geom]]]
        two = np.maximum(two, kind)  # an actor stays -1
        found = []
        for bunch in (one, two):
            has = np.flatnonzero(bunch >= 0)
            if len(has):
                force = abs(np.einsum("ci,ci->c", contacts.force[has], contacts.axes[has, 0]))
                found.append((bunch[has], force, contacts.point[has], kind[has] == _ACTOR))
        return found

    def _rigid_contacts(self) -> list[tuple[np.ndarray, ...]]:
        """Contacts of free bunches with robots, people, boxes, the ground and each other."""
        m = self.rigid.mj_model
        d = self.rigid.mj_data
        if d.ncon == 0:
            return []
        contact = d.contact
        kinds = self._kind[m.geom_bodyid[contact.geom]]
        row = contact.efc_address
        found = []
        for bunch, kind in ((kinds[:, 0], kinds[:, 1]), (kinds[:, 1], kinds[:, 0])):
            has = np.flatnonzero((bunch >= 0) & (row >= 0))
            if len(has):  # the first row of an elliptic cone is the normal force
                found.append((bunch[has], d.efc_force[row[has]], contact.pos[has], kind[has] == _ACTOR))
        return found

    def _held_plants(self, contacts: tuple[Contact, ...]) -> tuple[np.ndarray, ...]:
        """Hanging bunches in people's hands."""
        bunch = self._bunch_of[np.array([contact.body for contact in contacts])]
        force = np.linalg.norm([contact.force for contact in contacts], axis=1)
        point = np.array([contact.position for contact in contacts])
        has = bunch >= 0
        return bunch[has], force[has], point[has], np.ones(int(has.sum()), bool)

    def _held_bunches(self) -> np.ndarray:
        """Returns the free bunches in people's hands [k]."""
        names = {hand.held[0] for name in self.rigid.humans for hand in self.rigid.human(name).hands if hand.held}
        bunches = sorted(int(name[6:]) for name in names if name.startswith("bunch/"))
        return np.array([bunch for bunch in bunches if self._row[bunch] >= 0 and not self.remote[bunch]], int)

    # ------------------------------------------------------------------ tables

    def _add_rows(self, bunches: np.ndarray) -> None:
        is_new = self._row[bunches] < 0
        if not is_new.any():
            return
        new = np.unique(bunches[is_new])
        self._row[new] = len(self._bunch) + np.arange(len(new))
        self._bunch = np.append(self._bunch, new)
        for name in ("hand_time", "impulse", "acceleration", "drops", "drop_height", "air_time"):
            values = getattr(self, f"_{name}")
            setattr(self, f"_{name}", np.append(values, np.zeros(len(new), values.dtype)))
        self._top = np.append(self._top, np.full(len(new), -np.inf))
        for name, fill in (("berry_force", 0.0), ("recent", 0.0), ("velocity", np.nan), ("counted", 0)):
            values = getattr(self, f"_{name}")
            setattr(
                self, f"_{name}", np.append(values, np.full((len(new), *values.shape[1:]), fill, values.dtype), axis=0)
            )

    def _cell(self, bunch: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Returns the cells [k] of the surfaces of bunches [k] at points [k, 3] m of the world."""
        model = self.plants.model
        pose = self.plants.state.body_q[model.bunch_body[bunch]].astype(float)
        body = self._mj_body[bunch]
        is_free = body >= 0
        pose[is_free, :3] = self.rigid.mj_data.xpos[body[is_free]]
        pose[is_free, 3:] = self.rigid.mj_data.xquat[body[is_free]][:, [1, 2, 3, 0]]
        local = frames.rotate(frames.conjugate(pose[:, 3:]), point - pose[:, :3])
        along, around = CELLS
        length = np.maximum(model.bunch_length[bunch], 1e-6)
        angle = np.arctan2(local[:, 2], local[:, 1]) / (2.0 * math.pi) + 0.5
        i = np.minimum(np.maximum((along * local[:, 0] / length).astype(int), 0), along - 1)
        j = np.minimum((around * angle).astype(int), around - 1)  # the angle is not below 0
        return i * around + j

    def _add_motion(self, free: np.ndarray, supported: np.ndarray) -> None:
        """Add drops and accelerations of bunches ``free``, as :attr:`_free`. ``supported`` [bunch]: whether something
        touches or holds the bunch."""
        d = self.rigid.mj_data
        bunch, body, dof = free
        self._add_rows(bunch)
        rows = self._row[bunch]
        height = d.xipos[body, 2]
        velocity = d.qvel[dof[:, None] + np.arange(3)]
        touches = supported[bunch]
        fell = self._top[rows] - height
        lands = touches & (self._air_time[rows] >= LEAST_FLIGHT) & (fell >= LEAST_DROP)
        if lands.any():
            self._drops[rows[lands]] += 1
            self._drop_height[rows[lands]] = np.maximum(self._drop_height[rows[lands]], fell[lands])
            found = zip(bunch[lands].tolist(), fell[lands].tolist(), strict=True)
            self.events += tuple(FruitEvent(self.plants.tick, one, "dropped", value) for one, value in found)
        self._air_time[rows] = np.where(touches, 0.0, self._air_time[rows] + self.plants.dt)
        self._top[rows] = np.where(touches, height, np.maximum(self._top[rows], height))
        window = self._velocity.shape[1]
        change = velocity - self._velocity[rows, 0]
        change[:, 2] += self.rigid.parameters.gravity * window * self.plants.dt
        speed = np.sqrt(np.einsum("bi,bi->b", change, change))
        acceleration = np.where(touches & np.isfinite(speed), speed / (window * self.plants.dt), 0.0)
        if (acceleration > self._acceleration[rows]).any():
            self._acceleration[rows] = np.maximum(self._acceleration[rows], acceleration)
            self._is_worse = True
        self._velocity[rows] = np.concatenate([self._velocity[rows, 1:], velocity[:, None]], axis=1)

    def _add_shaking(self) -> None:
        """Add the accelerations of hanging bunches that lose berries by them."""
        plants = self.plants
        model = plants.model
        window = len(self._hanging_velocity)
        trees = model.body_tree[model.bunch_body]
        is_here = plants.state.bunch_attached & ~self.contact_solver.remote_trees[trees]
        bunch = np.flatnonzero(is_here & plants.state.tree_awake[trees])
        body = model.bunch_body[bunch]
        twist = plants.state.body_qd[body]
        lever = frames.rotate(plants.state.body_q[body, 3:], model.body_com[body])
        velocity = twist[:, :3] + frames.cross(twist[:, 3:], lever)
        oldest = self._hanging_velocity[plants.tick % window]
        change = velocity - oldest[bunch]
        change[:, 2] += self.rigid.parameters.gravity * window * plants.dt
        oldest[:] = np.where(is_here, 0.0, np.nan)[:, None]
        oldest[bunch] = velocity
        acceleration = np.sqrt(np.einsum("bi,bi->b", change, change)) / (window * plants.dt)
        loses = np.nan_to_num(acceleration) * self._berry_mass[bunch] > PULL_OFF[0]
        if not loses.any():
            return
        bunch = bunch[loses]
        acceleration = acceleration[loses]
        self._add_rows(bunch)
        rows = self._row[bunch]
        if (acceleration > self._acceleration[rows]).any():
            self._acceleration[rows] = np.maximum(self._acceleration[rows], acceleration)
            self._is_worse = True

    def _berries(self, rows: np.ndarray) -> np.ndarray:
        """Returns the expected numbers [row, 2] of burst and of lost berries."""
        bunch = self._bunch[rows]
        berries = self.plants.model.bunch_berries[bunch].astype(float)
        low, high = (burst_force(self._radius[bunch, None], tension) for tension in SKIN_TENSION)
        burst = BERRIES_PER_CONTACT * share_between(self._berry_force[rows], low, high).sum(1)
        lost = berries * share_between(self._berry_mass[bunch] * self._acceleration[rows], *PULL_OFF)
        return np.stack([np.minimum(burst, berries), lost], axis=1)

    def _tell(self) -> None:
        """Make events of berries that have burst or were lost, when their number reaches the next whole one."""
        berries = self._berries(np.arange(len(self._bunch)))
        whole = np.floor(berries + 1e-9).astype(int)
        for row, kind in np.argwhere(whole > self._counted).tolist():
            what = ("burst", "lost")[kind]
            self.events += (FruitEvent(self.plants.tick, int(self._bunch[row]), what, float(berries[row, kind])),)
        np.maximum(self._counted, whole, out=self._counted)
