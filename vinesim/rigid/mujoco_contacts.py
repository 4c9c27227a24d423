"""Contacts between rigid bodies in MuJoCo: collision pairs, friction, fast crates with thin walls, compliant wires."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable

import mujoco
import numpy as np

from vinesim.core import frames
from vinesim.rigid.recompile import compile_without_contacts
from vinesim.rigid.static_world import CRATE_WALL, FIRST_FIXED_GEOM, GROUND
from vinesim.scene.materials import Material, pair_table
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.values import RobotSpec
from vinesim.wires.deflected_wires import MAX_DEFLECTION, NO_TREE, DeflectedWires, WireContacts
from vinesim.wires.elastic_supports import WIRE_DAMPING_TIME

# Friction between two rigid bodies depends on both materials; MuJoCo alone would use the coefficient of one geom.


class PairFriction:
    """Sets the friction of MuJoCo's contacts from the pairs of materials in ``data/materials``, within each step."""

    def __init__(self, parameters: PhysicsParameters) -> None:
        self._table = pair_table("friction", parameters.friction)
        self._is_listed = self._table != parameters.friction
        self._material = np.zeros(0, np.int32)
        """[geom] Material of each geom; UNKNOWN for a geom with its own friction coefficient, which MuJoCo then uses.
        """

    def find_materials(self, m: mujoco.MjModel) -> None:
        """Look up the materials of all geoms of a recompiled world."""
        material = m.geom_user[:, 0]
        has_own = m.geom_user[:, 1] > 0.0
        self._material = np.where(has_own, int(Material.UNKNOWN), material).astype(np.int32)

    def apply(self, m: mujoco.MjModel, d: mujoco.MjData) -> None:
        """After ``mj_step1``: write the friction coefficients of contacts between listed pairs of materials.

        If there are such contacts, MuJoCo's constraints are rebuilt.
        """
        if d.ncon == 0:
            return
        first, second = self._material[d.contact.geom].T
        listed = np.flatnonzero(self._is_listed[first, second])
        if len(listed) == 0:
            return
        d.contact.friction[listed, :2] = self._table[first[listed], second[listed], None]
        mujoco.mj_makeConstraint(m, d)
        mujoco.mj_island(m, d)
        mujoco.mj_projectConstraint(m, d)
        mujoco.mj_fwdVelocity(m, d)


# Collisions between links of a robot, and of links with the ground.
#
# Links on both sides of a joint never collide; MuJoCo excludes these pairs by itself. Links that overlap in the home
# pose do so because of their collision hulls, not because of motion. Such pairs are excluded, as by MoveIt's Setup
# Assistant. The pairs in the ``disable_collisions`` elements of an SRDF file are excluded too.


FAR = 100.0
"""[m] Depth below a robot of the plane to which the distance of its lowest point is measured."""
HOME_CLEARANCE = 1e-3
"""Distance [m] between two links, or a link and the ground, below which they count as overlapping in the home pose.

GUESSED: the accuracy of collision shapes and of servos that hold the pose."""


def let_links_collide(parsed: mujoco.MjSpec, given: RobotSpec, code: int, clearance: float) -> None:
    """Enable collisions of a ``parsed`` robot's links with each other and with the ground.

    ``given``: the robot's settings; ``code``: its collision code; ``clearance``: height of the base above the ground
    [m]. Shapes that are fixed to a driven base do not collide with the ground, because the base moves in a plane at
    constant height, or follows uneven ground.
    """
    alone = parsed.copy()
    for number, geom in enumerate(alone.geoms):
        geom.name = str(number)
        geom.contype = geom.conaffinity = 1
        geom.margin = HOME_CLEARANCE
    ground = alone.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], pos=[0.0, 0.0, -clearance])
    ground.contype = ground.conaffinity = 1
    m = compile_without_contacts(alone)
    geoms = _touching_at_home(m, given)
    bodies = m.geom_bodyid[geoms]
    on_ground = m.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_PLANE
    for row in np.unique(np.sort(bodies[~on_ground.any(1)], axis=1), axis=0).tolist():
        parsed.add_exclude(bodyname1=m.body(row[0]).name, bodyname2=m.body(row[1]).name)
    links = {link.name for link in parsed.bodies}
    for pair in disabled_pairs(given.urdf):
        if links.issuperset(pair):
            parsed.add_exclude(bodyname1=pair[0], bodyname2=pair[1])
    standing = set() if given.has_free_base else set(geoms[on_ground.any(1)].ravel().tolist())
    for number, geom in enumerate(parsed.geoms):
        geom.conaffinity |= code
        compiled = m.geom(str(number))
        moves = given.has_free_base or m.body_weldid[compiled.bodyid[0]] != 0
        if moves and compiled.id not in standing:
            geom.conaffinity |= GROUND


def disabled_pairs(urdf: str) -> list[tuple[str, str]]:
    """Returns the pairs of link names between which the robot's description disables collisions.

    The pairs are the elements ``disable_collisions`` of the URDF. Loading a robot copies these elements from the SRDF
    into the URDF.
    """
    root = ElementTree.fromstring(urdf)
    return [(pair.get("link1", ""), pair.get("link2", "")) for pair in root.findall("disable_collisions")]


def _touching_at_home(m: mujoco.MjModel, given: RobotSpec) -> np.ndarray:
    """Returns the pairs of geoms [pair, 2] that touch in the home pose; ``m``: the robot alone, with its base fixed."""
    return _collide_at_home(m, given).contact.geom.reshape(-1, 2).copy()


def _collide_at_home(m: mujoco.MjModel, given: RobotSpec, prefix: str = "") -> mujoco.MjData:
    """Returns the contacts of a robot that is alone in its home pose. ``prefix``: before the names of its joints."""
    d = mujoco.MjData(m)
    for drive, position in zip(given.drives, given.home, strict=True):
        d.joint(prefix + drive.joint).qpos[0] = position
    for e in np.flatnonzero(m.eq_type == mujoco.mjtEq.mjEQ_JOINT).tolist():
        polynomial = np.polynomial.Polynomial(m.eq_data[e, :5])
        d.qpos[m.jnt_qposadr[m.eq_obj1id[e]]] = polynomial(d.qpos[m.jnt_qposadr[m.eq_obj2id[e]]])
    mujoco.mj_kinematics(m, d)
    mujoco.mj_comPos(m, d)
    mujoco.mj_collision(m, d)
    return d


def lowest_point(parsed: mujoco.MjSpec, given: RobotSpec) -> float | None:
    """Returns the height [m] of the lowest point of a ``parsed`` robot's shapes at home, above the origin of its root
    link; None if nothing of it collides. ``given``: the robot's settings."""
    world = mujoco.MjSpec()
    base = world.worldbody.add_body()
    base.add_freejoint()  # MuJoCo finds no contacts between two fixed bodies
    world.attach(parsed.copy(), prefix="robot/", frame=base.add_frame())
    for geom in world.geoms:
        geom.contype = 1
        geom.conaffinity = 0
    plane = world.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], pos=[0.0, 0.0, -FAR])
    plane.contype = 0
    plane.conaffinity = 1
    plane.margin = 2.0 * FAR
    distance = _collide_at_home(compile_without_contacts(world), given, "robot/").contact.dist
    return float(distance.min()) - FAR if len(distance) else None


# Speculative contacts of fast crates, so that thin walls do not end up inside each other.
#
# A crate that has fallen half a metre moves 31 mm in a step, but its walls are 12 mm thick. If contacts were found only
# after overlap, crates would be pushed apart sideways or not at all. So a fast crate that approaches another one gets a
# contact margin as large as its motion in a step. A contact within the margin allows the gap to close, but prevents
# overlap (a *speculative contact*).


MAX_STEP = CRATE_WALL / 4.0
"""Motion of a crate in a step [m] below which the crate has no contact margin. TUNED."""
MAX_MARGIN = 0.1
"""Largest contact margin of a crate [m]: its motion in a step at 10 m/s."""

PASSING = 0.1
"""Cosine between the relative velocity of two crates and the line between them, below which the crates are taken to
pass each other. TUNED."""
STIFFNESS = 100.0
"""Stiffness of a speculative contact [effective mass / dt^2]. An overlap of about 1 / STIFFNESS of the motion beyond
the gap remains."""
NEVER_REACHED = 1e4
"""Gap [m] that is larger than any motion in a step, to disable a contact."""


class SpeculativeContacts:
    """Contact margins of fast crates, and contact parameters that stop the crates where their gap closes."""

    def __init__(self) -> None:
        self._bodies = self._geoms = self._crate_of_geom = np.zeros(0, int)
        self._dof = np.zeros((0, 6), int)
        self._radius = np.zeros(0)
        self._has_margins = False

    def find_crates(self, m: mujoco.MjModel, numbers: Iterable[int]) -> None:
        """Look up the bodies and geoms of the crates (boxes) with these ``numbers`` in a recompiled world."""
        self._bodies = bodies = np.array(sorted(m.body(f"box/{number}").id for number in numbers), int)
        self._dof = m.body_dofadr[bodies][:, None] + np.arange(6)
        self._geoms = np.flatnonzero(np.isin(m.geom_bodyid, bodies))
        self._crate_of_geom = np.searchsorted(bodies, m.geom_bodyid[self._geoms])
        corner = np.linalg.norm(m.geom_pos[self._geoms], axis=1) + m.geom_rbound[self._geoms]
        self._radius = np.zeros(len(bodies))
        np.maximum.at(self._radius, self._crate_of_geom, corner)

    def set_margins(self, m: mujoco.MjModel, d: mujoco.MjData) -> bool:
        """Before ``mj_step1``: set the contact margin of each crate. Returns whether any margin is not zero."""
        if len(self._bodies) == 0:
            return False
        velocity = d.qvel[self._dof]
        if not self._has_margins and not velocity.any():
            return False
        linear = velocity[:, :3]
        angular = velocity[:, 3:]
        step = m.opt.timestep * (np.linalg.norm(linear, axis=1) + np.linalg.norm(angular, axis=1) * self._radius)
        margin = np.zeros(len(step))
        for crate in np.flatnonzero(step > MAX_STEP).tolist():
            if self._is_approaching(crate, linear, step, d.xpos[self._bodies]):
                margin[crate] = min(1.5 * step[crate], MAX_MARGIN)
        m.body_margin[self._bodies] = margin
        m.geom_margin[self._geoms] = margin[self._crate_of_geom]
        self._has_margins = bool(margin.any())
        return self._has_margins

    def _is_approaching(self, crate: int, velocity: np.ndarray, step: np.ndarray, position: np.ndarray) -> bool:
        """Returns whether crate ``crate`` comes near another crate in the next step and does not merely pass it.

        velocity: [crate, 3] m/s; step: [crate] m, motion in a step; position: [crate, 3] m.
        """
        offset = position - position[crate]
        relative = velocity - velocity[crate]
        distance = np.linalg.norm(offset, axis=1)
        closing = -(offset * relative).sum(1)
        is_met = closing > PASSING * distance * np.linalg.norm(relative, axis=1)
        return bool((is_met & (distance < self._radius + self._radius[crate] + step + step[crate])).any())

    def limit_closing(self, m: mujoco.MjModel, d: mujoco.MjData) -> None:
        """After MuJoCo has made the constraints: let contacts with a gap close the gap within the step, without
        overlap.

        Contacts that do not close at the present speed are disabled, because MuJoCo's friction would push a body away
        from the body along which it slides. MuJoCo recomputes stiffness and damping from ``solref`` in every solve.
        Contacts without damping have no friction either.
        """
        contact = d.contact
        dt = m.opt.timestep
        is_open = np.flatnonzero((contact.dist > 0.0) & (contact.efc_address >= 0))
        row = contact.efc_address[is_open]
        gap = contact.dist[is_open]
        is_closing = d.efc_vel[row] * dt < -gap
        d.efc_margin[row] = np.where(is_closing, d.efc_pos[row] - gap, -NEVER_REACHED)
        contact.solref[is_open] = -STIFFNESS / dt**2, 0.0


# Contacts of rigid bodies with wires: MuJoCo's constraints, made as soft as the wires.
#
# MuJoCo's integrator ``discrete`` treats a contact as an implicit spring and damper with its own mass m. Impedance d
# and reference (k, b) of a contact with effective mass 1 / A at rest mean m = d / ((1 - d) A), stiffness m k and
# damping m b. Here m is the mass of the piece of wire, so that the force is the force of the wire's spring.


WIRE_MASS = 0.02
"""Effective mass [kg] of a piece of wire between posts, at the point of largest motion. DERIVED: a third of 2 m of
steel wire, 2.8 mm thick, weighs 0.03 kg."""
MARGIN_LEVELS = (0.005, 0.02, 0.05, 0.1)
"""Margins [m] that contacts with wires can have. The smallest margin that exceeds the motion of the fastest body in a
step is used.
"""
# MuJoCo's mjMINIMP, mjMAXIMP
_LEAST_IMPEDANCE = 1e-4
_MOST_IMPEDANCE = 0.9999
# parameters of solimp for an impedance that does not depend on depth
_WIDTH = 1.0
_MIDPOINT = 0.5
_POWER = 2.0


class SoftWires:
    """Makes contacts with wires in a MuJoCo world as soft as the wires, and moves the wires' geoms."""

    def __init__(self, wires: DeflectedWires) -> None:
        self._wires = wires
        self._geoms = np.append(np.zeros(FIRST_FIXED_GEOM, bool), wires.is_compliant)
        """[MuJoCo geom] Whether the geom is a compliant wire; the array ends with the last fixed piece."""
        self._numbers = np.flatnonzero(self._geoms)
        self._contacts = WireContacts(wires)
        self._at = self._row = np.zeros(0, int)
        self._gap = self._damping_time = self._mobility = self._impedance = self._rate = np.zeros(0)
        self._measured: dict[int, float] = {}
        self._moved = np.zeros(0, int)
        self._world: mujoco.MjModel | None = None

    def use_world(self, m: mujoco.MjModel) -> None:
        """Use a recompiled world, in which all wires are still straight."""
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
        """Returns key and kinematic tree, in the present world, of the pair of wire and geom that had ``key`` in the
        world ``before``."""
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
        """Before ``mj_step1``: move the geoms of deflected wires, because MuJoCo computes static poses only once."""
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
        """Set contact margins so large that all contacts of the step are found, also when a deflected wire springs
        back.

        A contact that is missed may end with the axis of the wire inside a box, and MuJoCo would then push the box
        along the wire.
        """
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
        """After MuJoCo has made the constraints: set the stiffness of each contact with a wire to the stiffness of the
        wire's spring.
        """
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
        self._damping_time = np.where(self._gap > 0.0, 0.0, WIRE_DAMPING_TIME)  # no damping before contact
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
        """Write impedance and reference (``solimp``, ``solref``) of the contacts with wires to MuJoCo."""
        share = self._mobility * WIRE_MASS
        self._impedance = impedance = np.clip(share / (1.0 + share), _LEAST_IMPEDANCE, _MOST_IMPEDANCE)
        mass = impedance / ((1.0 - impedance) * self._mobility)
        self._rate = self._contacts.stiffness / mass
        d.contact.solimp[self._at, 0] = d.contact.solimp[self._at, 1] = impedance
        d.contact.solimp[self._at, 2:] = _WIDTH, _MIDPOINT, _POWER
        d.contact.solref[self._at, 0] = -impedance * self._rate
        d.contact.solref[self._at, 1] = -impedance * self._damping_time * self._rate

    def _measure(self, d: mujoco.MjData, dt: float) -> None:
        """Compute the effective masses by which MuJoCo scaled the contacts in this step of ``dt`` [s].

        MuJoCo does not report these masses. They change little from step to step, so the next step uses them.
        """
        implicit = 1.0 + (self._damping_time + dt) * dt * self._rate
        self._mobility = d.efc_R[self._row] * implicit * self._impedance / (1.0 - self._impedance)
        self._measured = dict(zip(self._contacts.key.tolist(), self._mobility.tolist(), strict=True))

    def report(self, d: mujoco.MjData, dt: float) -> None:
        """After the second half of a step: report the contact forces and velocities to the model of the wires."""
        if len(self._at):
            self._measure(d, dt)
            force = d.efc_force[self._row]
            stiffness = self._contacts.stiffness
            # from the law of spring and damper: force = -stiffness (gap + dt v) - damping v
            velocity = -(force + stiffness * self._gap) / (stiffness * (dt + self._damping_time))
            self._contacts.add_presses(force, velocity)


def _turn(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Returns the shortest rotation [4] (wxyz) from the direction of ``before`` [3] to the direction of ``after``
    [3]."""
    size = math.sqrt((before @ before) * (after @ after))
    return frames.to_wxyz(frames.normalize(np.append(frames.cross(before, after), size + before @ after)))


def _widen_boxes(m: mujoco.MjModel, is_wire: np.ndarray) -> None:
    """Enlarge MuJoCo's bounding volume tree of static geoms so that it contains wires at any deflection."""
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
