"""Picked bunches as free bodies of MuJoCo: spheres and capsules on a body from a pool.

Recompiling a MuJoCo world takes about 10 ms. Therefore each world contains a pool of sleeping bodies without
collisions. When a bunch leaves its vine, one of these bodies gets the bunch's mass and shapes, with all constants that
MuJoCo derives from them.
"""

from __future__ import annotations

import dataclasses
import functools

import mujoco
import numpy as np

from vinesim.core import frames
from vinesim.rigid.static_world import ALL_BITS, CRATE_FLOOR, FREE_BUNCH, contact_friction, geom_user
from vinesim.scene.materials import Material
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.values import Shape, Stalk

MAX_GEOMS = 12
"""Largest number of collision shapes of a free bunch, and number of geoms of each body in the pool."""
PARKING_HEIGHT = -100.0
"""Height z [m] at which unused bodies of the pool are placed, below the ground."""
CONAFFINITY = ALL_BITS & ~CRATE_FLOOR
"""Collision bits with which the shapes of a free bunch collide."""
_SOLIMP = [0.99, 0.999, 0.001, 0.5, 2]
"""Constraint impedance (MuJoCo's ``solimp``) of contacts of free bunches. TUNED: with harder contacts a bunch is held
with a penetration of a few micrometres, and a moving hand loses contact for a step. Fingers that hold with 25 N then
move by 3 mm, and the bunch falls."""

BODY_ARRAYS = (
    "body_mass",
    "body_ipos",
    "body_iquat",
    "body_inertia",
    "body_subtreemass",
    "body_sameframe",
    "body_invweight0",
    "body_contype",
    "body_conaffinity",
)
"""Names of the arrays of ``MjModel`` with constants of a body that MuJoCo derives from the body's mass and shapes."""
GEOM_ARRAYS = (
    "geom_type",
    "geom_contype",
    "geom_conaffinity",
    "geom_condim",
    "geom_priority",
    "geom_size",
    "geom_pos",
    "geom_quat",
    "geom_aabb",
    "geom_rbound",
    "geom_sameframe",
    "geom_friction",
    "geom_solimp",
    "geom_solref",
)
"""Names of the arrays of ``MjModel`` with properties and derived constants of a geom."""
_FRUIT = (0.25, 0.05, 0.3, 1.0)
_STALK = (0.35, 0.45, 0.15, 1.0)
"""Colours of the shapes of a free bunch and of its stalk, sRGB and opacity."""
_Z_TO_X = frames.exp(np.array([0.0, 0.5 * np.pi, 0.0]))


@dataclasses.dataclass(frozen=True, eq=False)
class FreeBunch:
    """Mass and shapes of a picked bunch, in the frame of its former plant body."""

    mass: float
    """Mass [kg]."""
    com: np.ndarray
    """[3] m, centre of mass."""
    inertia: np.ndarray
    """[3] kg m^2, moments of inertia xx, yy, zz about the centre of mass."""
    product: np.ndarray
    """[3] kg m^2, entries yz, zx, xy of the inertia matrix."""
    start: np.ndarray
    """[shape, 3] m, start of a capsule's axis; for a sphere ``start`` equals ``end``."""
    end: np.ndarray
    """[shape, 3] m, end of a capsule's axis."""
    radius: np.ndarray
    """[shape] m, radius of each sphere or capsule."""
    stalk: Stalk | None = None
    """Stalk above the bunch, whose pieces are the last shapes; None: it parted at its joint."""

    @functools.cached_property
    def shapes(self) -> tuple[Shape, ...]:
        """Spheres and capsules, in the bunch's frame."""
        axis = self.end - self.start
        middle = 0.5 * (self.start + self.end)
        half = 0.5 * np.linalg.norm(axis, axis=-1)
        pieces = 0 if self.stalk is None else self.stalk.pieces
        colours = [_FRUIT] * (len(self.radius) - pieces) + [_STALK] * pieces
        turn = frames.multiply(frames.from_x_axis(axis), _Z_TO_X)
        return tuple(
            Shape("capsule", (float(r), float(h)), frames.pose(p, q), rgba)
            if h > 0.0
            else Shape("sphere", (float(r),), frames.pose(p), rgba)
            for r, h, p, q, rgba in zip(self.radius, half, middle, turn, colours, strict=True)
        )


def slot_name(slot: int) -> str:
    """Returns MuJoCo's name of the body with index ``slot`` in the pool, and of its joint."""
    return f"free_bunch/{slot}"


def add_slot(spec: mujoco.MjSpec, slot: int) -> None:
    """Add body ``slot`` of the pool, asleep and with placeholder values; call :func:`disable_collision` after
    compiling."""
    body = spec.worldbody.add_body(
        name=slot_name(slot),
        pos=_parking_pose(slot)[:3],
        mass=0.5,
        ipos=[0.05, 0.0, 0.0],
        inertia=[1e-3, 1e-3, 1e-3],
        explicitinertial=True,
        sleep=mujoco.mjtSleepPolicy.mjSLEEP_INIT,
    )
    body.add_freejoint(name=slot_name(slot))
    for _ in range(MAX_GEOMS):
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[0.01, 0, 0],
            pos=[0.05, 0.0, 0.0],
            mass=0.0,
            contype=FREE_BUNCH,
            conaffinity=CONAFFINITY,
            userdata=geom_user(Material.BERRY),
        )  # collision bits are needed for MuJoCo to create bounding volumes


def _parking_pose(slot: int) -> np.ndarray:
    """Returns the pose [7] (m, wxyz) of body ``slot`` of the pool while it is unused."""
    return np.array([float(slot), 0.0, PARKING_HEIGHT, 1.0, 0.0, 0.0, 0.0])


def compile_alone(bunch: FreeBunch, parameters: PhysicsParameters) -> mujoco.MjModel:
    """Compile a MuJoCo model that contains only ``bunch``, for the constants that MuJoCo derives.

    Raises ``ValueError`` if the bunch has too many shapes or none.
    """
    spec = mujoco.MjSpec()
    add_free_bunch(spec, bunch, parameters)
    return spec.compile()


def add_free_bunch(spec: mujoco.MjSpec, bunch: FreeBunch, parameters: PhysicsParameters) -> None:
    """Add a bunch to a world as a free body; ``ValueError`` if it has too many shapes or none."""
    if not 0 < len(bunch.radius) <= MAX_GEOMS:
        raise ValueError(f"a bunch has {len(bunch.radius)} collision shapes; a free bunch can have 1 to {MAX_GEOMS}")
    widest = max(float(radius) for radius in bunch.radius)
    softness = [parameters.bunch_contact_time, parameters.bunch_contact_damping_ratio]
    yz, zx, xy = bunch.product
    body = spec.worldbody.add_body(
        mass=bunch.mass, ipos=bunch.com, fullinertia=[*bunch.inertia, xy, zx, yz], explicitinertial=True
    )
    body.add_freejoint()
    for start, end, radius in zip(bunch.start, bunch.end, bunch.radius, strict=True):
        kind = mujoco.mjtGeom.mjGEOM_SPHERE
        place = {"pos": start}
        if (start != end).any():
            kind = mujoco.mjtGeom.mjGEOM_CAPSULE
            place = {"fromto": np.concatenate([start, end])}
        body.add_geom(
            type=kind,
            size=[float(radius), 0, 0],
            mass=0.0,
            contype=FREE_BUNCH,
            conaffinity=CONAFFINITY,
            condim=6,
            friction=contact_friction(parameters.friction, parameters.bunch_rolling_arm * float(radius) / widest),
            priority=1,
            solref=softness,
            solimp=_SOLIMP,
            **place,
        )
    for _ in range(MAX_GEOMS - len(bunch.radius)):
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[1e-3, 0, 0],
            pos=bunch.start[0],
            mass=0.0,
            contype=FREE_BUNCH,
            conaffinity=CONAFFINITY,
        )


def activate(world: mujoco.MjModel, slot: int, bunch: FreeBunch, derived: mujoco.MjModel) -> None:
    """Set mass, shapes and derived constants of body ``slot`` of the pool to those of ``bunch``.

    All constants are copied from ``derived``, the model of :func:`compile_alone`, because ``mj_setConst`` would compute
    neither bounding volumes nor the collision bits of bodies.
    """
    body = world.body(slot_name(slot)).id
    for name in BODY_ARRAYS:
        getattr(world, name)[body] = getattr(derived, name)[1]
    geoms = slice(world.body_geomadr[body], world.body_geomadr[body] + MAX_GEOMS)
    for name in GEOM_ARRAYS:
        getattr(world, name)[geoms] = getattr(derived, name)
    spare = slice(geoms.start + len(bunch.radius), geoms.stop)
    world.geom_contype[spare] = world.geom_conaffinity[spare] = 0
    dofs = slice(world.body_dofadr[body], world.body_dofadr[body] + 6)
    for name in ("dof_M0", "dof_invweight0", "dof_length"):
        getattr(world, name)[dofs] = getattr(derived, name)
    volumes = slice(world.body_bvhadr[body], world.body_bvhadr[body] + derived.body_bvhnum[1])
    for name in ("bvh_aabb", "bvh_child", "bvh_depth"):
        getattr(world, name)[volumes] = getattr(derived, name)
    world.bvh_nodeid[volumes] = np.where(derived.bvh_nodeid >= 0, derived.bvh_nodeid + geoms.start, -1)


def disable_collision(world: mujoco.MjModel, slot: int) -> None:
    """Disable collisions of an unused body of the pool. Call it after compilation."""
    body = world.body(slot_name(slot)).id
    geoms = slice(world.body_geomadr[body], world.body_geomadr[body] + MAX_GEOMS)
    world.body_contype[body] = world.body_conaffinity[body] = 0
    world.geom_contype[geoms] = world.geom_conaffinity[geoms] = 0
