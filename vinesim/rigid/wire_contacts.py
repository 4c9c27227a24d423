"""Contacts of rigid bodies with wires: MuJoCo's constraints, made as soft as the wires are.

MuJoCo's step ``discrete`` treats a contact as an implicit spring and damper with a mass m of its own: impedance d and
reference (k, b) of a contact with an effective mass 1 / A at rest mean m = d / ((1 - d) A), stiffness m k and damping
m b. Here m is that of the piece of wire, so that the force is that of the wire's spring.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from vinesim.core import frames
from vinesim.rigid.static_world import FIRST_FIXED_GEOM
from vinesim.wires.deflected_wires import MAX_DEFLECTION, NO_TREE, DeflectedWires, WireContacts
from vinesim.wires.elastic_supports import WIRE_DAMPING_TIME

WIRE_MASS = 0.02
"""[kg] of a piece of wire where it moves most. DERIVED: a third of 2 m of steel, 2.8 mm thick, weigh 0.03 kg."""
MARGIN_LEVELS = (0.005, 0.02, 0.05, 0.1)
"""[m] by which contacts with wires are found early; that which is enough for the fastest body is taken."""
# MuJoCo's mjMINIMP, mjMAXIMP
_LEAST_IMPEDANCE = 1e-4
_MOST_IMPEDANCE = 0.9999
# of an impedance that is the same at all depths
_WIDTH = 1.0
_MIDPOINT = 0.5
_POWER = 2.0


class SoftWires:
    """What a MuJoCo world needs so that wires give."""

    def __init__(self, wires: DeflectedWires) -> None:
        self._wires = wires
        self._geoms = np.append(np.zeros(FIRST_FIXED_GEOM, bool), wires.gives)
        """[MuJoCo geom, up to the last fixed piece] whether it is a wire that gives."""
        self._numbers = np.flatnonzero(self._geoms)
        self._contacts = WireContacts(wires)
        self._at = self._row = np.zeros(0, int)
        self._gap = self._damping_time = self._mobility = self._impedance = self._rate = np.zeros(0)
        self._measured: dict[int, float] = {}
        self._moved = np.zeros(0, int)
        self._world: mujoco.MjModel | None = None

    def use_world(self, m: mujoco.MjModel) -> None:
        """Take over a world that was compiled anew, in which all wires are straight."""
        self._margin = m.geom_margin[: len(self._geoms)].copy()
        self._body_margin = float(m.body_margin[0])
        self._level = 0.0
        self._pos, self._quat = (values[: len(self._geoms)].copy() for values in (m.geom_pos, m.geom_quat))
        self._at = self._at[:0]
        self._moved = np.zeros(0, int)
        before = self._world
        self._world = m
        self._wires.renumber_rigid(lambda key: self._renumber(key, before), m.ntree)
        measured = [(self._renumber(key, before), value) for key, value in self._measured.items()]
        self._measured = {key: value for (key, tree), value in measured if tree != NO_TREE}
        _widen_boxes(m, self._geoms)

    def _renumber(self, key: int, before: mujoco.MjModel | None) -> tuple[int, int]:
        """The key that a pair of a wire and a geom of the world ``before`` has in this one, and its tree."""
        m = self._world
        if before is None or m is None or key >= 0:
            return 0, NO_TREE
        wire, other = divmod(-1 - key, before.ngeom)
        body = before.geom_bodyid[other]
        now = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, before.body(body).name)
        if now < 0:
            return 0, NO_TREE
        geom = m.body_geomadr[now] + other - before.body_geomadr[body]
        return -1 - int(wire * m.ngeom + geom), -1 - int(m.body_treeid[now])

    def place_geoms(self, m: mujoco.MjModel, d: mujoco.MjData) -> None:
        """Before ``mj_step1``: put the geoms of wires where they are. MuJoCo computes static poses only once."""
        wires = self._wires
        for piece in {*self._moved.tolist(), *wires.deflected.tolist()}:
            geom = FIRST_FIXED_GEOM + piece
            offset = wires.offset[piece]
            way = wires.end[piece] - wires.start[piece]
            mujoco.mju_mulQuat(m.geom_quat[geom], _turn(way, way + offset[1] - offset[0]), self._quat[geom])
            m.geom_pos[geom] = d.geom_xpos[geom] = self._pos[geom] + 0.5 * (offset[0] + offset[1])
            mujoco.mju_quat2Mat(d.geom_xmat[geom], m.geom_quat[geom])
        self._moved = wires.deflected.copy()
        self._set_margins(m, d)

    def _set_margins(self, m: mujoco.MjModel, d: mujoco.MjData) -> None:
        """Find contacts with wires as early as anything may come to them, or a deflected one spring back, in the step:
        with the axis of a wire inside a box, MuJoCo would push the box along the wire."""
        rates = d.cvel
        reach = m.opt.timestep * max(float(rates.max()), -float(rates.min()))
        level = next((level for level in MARGIN_LEVELS if reach <= level), MARGIN_LEVELS[-1])
        if len(self._wires.deflected):
            offset = self._wires.offset[self._wires.deflected]
            level = max(level, math.sqrt((offset * offset).sum(2).max()))
        if level != self._level:
            self._level = level
            m.geom_margin[self._numbers] = np.maximum(self._margin[self._numbers], level)
            m.body_margin[0] = max(self._body_margin, level)

    def soften(self, m: mujoco.MjModel, d: mujoco.MjData) -> None:
        """After the constraints are made: contacts with wires end at the wires' springs."""
        self._at = self._at[:0]
        if d.ncon == 0:
            return
        geom = d.contact.geom
        is_wire = (geom < len(self._geoms)) & self._geoms[np.minimum(geom, len(self._geoms) - 1)]
        at = np.flatnonzero(is_wire.any(1) & (d.contact.efc_address >= 0))
        if len(at) == 0:
            return
        contact = d.contact
        first = is_wire[at, 0]
        wire = np.where(first, *geom[at].T)
        other = np.where(first, *geom[at].T[::-1])
        body = m.geom_bodyid[other]
        row = contact.efc_address[at]
        normal = np.where(first, 1.0, -1.0)[:, None] * contact.frame[at, :3]
        gap = contact.dist[at] - self._margin[wire]
        key = -1 - (wire * np.int64(m.ngeom) + other)
        self._contacts.find_springs(
            wire - FIRST_FIXED_GEOM, contact.pos[at], normal, gap, -d.efc_vel[row], key, -1 - m.body_treeid[body]
        )
        self._at = at
        self._row = row
        self._gap = gap + self._contacts.shift
        self._damping_time = np.where(self._gap > 0.0, 0.0, WIRE_DAMPING_TIME)  # nor does it damp before it is touched
        self._mobility = np.array([self._measured.get(k, 0.0) for k in key.tolist()])
        is_new = self._mobility == 0.0
        self._mobility[is_new] = np.maximum(m.body_invweight0[body[is_new], 0], 1e-9)
        self._write(d)
        d.efc_margin[row] = d.efc_pos[row] - self._gap
        if is_new.any():
            mujoco.mj_forwardSkip(m, d, mujoco.mjtStage.mjSTAGE_VEL, 1)
            self._measure(d, m.opt.timestep)
            self._write(d)

    def _write(self, d: mujoco.MjData) -> None:
        """Write impedance and reference of the contacts."""
        share = self._mobility * WIRE_MASS
        self._impedance = impedance = np.clip(share / (1.0 + share), _LEAST_IMPEDANCE, _MOST_IMPEDANCE)
        mass = impedance / ((1.0 - impedance) * self._mobility)
        self._rate = self._contacts.stiffness / mass
        d.contact.solimp[self._at, 0] = d.contact.solimp[self._at, 1] = impedance
        d.contact.solimp[self._at, 2:] = _WIDTH, _MIDPOINT, _POWER
        d.contact.solref[self._at, 0] = -impedance * self._rate
        d.contact.solref[self._at, 1] = -impedance * self._damping_time * self._rate

    def _measure(self, d: mujoco.MjData, dt: float) -> None:
        """Find by which effective masses MuJoCo has scaled the contacts: those of its implicit step, which it does not
        tell. They change little from step to step."""
        implicit = 1.0 + (self._damping_time + dt) * dt * self._rate
        self._mobility = d.efc_R[self._row] * implicit * self._impedance / (1.0 - self._impedance)
        self._measured = dict(zip(self._contacts.key.tolist(), self._mobility.tolist(), strict=True))

    def report(self, d: mujoco.MjData, dt: float) -> None:
        """After the second half of a step: tell the wires what has pressed on them."""
        if len(self._at):
            self._measure(d, dt)
            force = d.efc_force[self._row]
            stiffness = self._contacts.stiffness
            # of the spring and damper: force = -stiffness (gap + dt v) - damping v
            velocity = -(force + stiffness * self._gap) / (stiffness * (dt + self._damping_time))
            self._contacts.add_presses(force, velocity)


def _turn(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """The shortest rotation [4], MuJoCo's order, from the direction of ``before`` [3] to that of ``after`` [3]."""
    size = math.sqrt((before @ before) * (after @ after))
    return frames.to_wxyz(frames.normalize(np.append(frames.cross(before, after), size + before @ after)))


def _widen_boxes(m: mujoco.MjModel, is_wire: np.ndarray) -> None:
    """Let MuJoCo's tree of boxes around static geoms hold wires wherever they may be."""
    first = int(m.body_bvhadr[0])
    count = int(m.body_bvhnum[0])
    if count == 0:
        return
    child = m.bvh_child[first : first + count]
    geom = m.bvh_nodeid[first : first + count]
    holds = np.zeros(count, bool)
    leaf = (geom >= 0) & (geom < len(is_wire))
    holds[leaf] = is_wire[geom[leaf]]
    for depth in range(int(m.bvh_depth[:count].max()) - 1, -1, -1):
        inner = np.flatnonzero((m.bvh_depth[first : first + count] == depth) & (child[:, 0] >= 0))
        holds[inner] = holds[child[inner]].any(1)
    m.bvh_aabb[first : first + count][holds, 3:] += MAX_DEFLECTION
