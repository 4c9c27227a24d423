"""Loose bunches: what left its vine is a free body of round shapes, one of those that waited asleep for it."""

from __future__ import annotations

import dataclasses
import functools

import mujoco
import numpy as np

from vinesim import frames
from vinesim.physics.rigid.static_world import ALL_BITS, CRATE_FLOOR, FREE_BUNCH, FRICTION
from vinesim.scene.values import Shape

POOL_SIZE = 12
"""Free bodies that wait asleep for bunches to come. Every compilation makes so many; when all are taken, the next bunch
has to wait for one, some ten milliseconds.
"""
MAX_GEOMS = 12
"""Shapes that a waiting body has room for."""
ROLLING = 0.004
"""[m] Arm of the rolling resistance of a bunch: GUESSED, half the distance between two berries that it lies on is 10 mm
and gives way. Without it a bunch of round shapes rolls on for ever.
"""
SOFT = (0.02, 3.0)
"""Time constant [s] and damping ratio of a loose bunch's contacts. With MuJoCo's own ratio of 1 one that falls from a
metre, centimetres deep in the crate after one tick, leaves it at up to 110 m/s; a longer time never comes to rest.
"""
PARKED = -100.0
"""[m] Where waiting bodies sleep: under the ground, where nothing is."""

# constants that MuJoCo derives from a body's weight and shapes
OF_BODY = (
    "body_mass", "body_ipos", "body_iquat", "body_inertia", "body_subtreemass", "body_sameframe", "body_invweight0",
    "body_contype", "body_conaffinity",
)  # fmt: skip
OF_GEOM = (
    "geom_type", "geom_contype", "geom_conaffinity", "geom_condim", "geom_priority", "geom_size", "geom_pos",
    "geom_quat", "geom_aabb", "geom_rbound", "geom_sameframe", "geom_friction", "geom_solimp", "geom_solref",
)  # fmt: skip
_Z_TO_X = frames.exp(np.array([0.0, 0.5 * np.pi, 0.0]))


@dataclasses.dataclass(frozen=True, eq=False)
class FreeBunch:
    """A bunch that hangs on no vine: its weight and its round shapes, in the frame that it had as a plant's body."""

    mass: float
    com: np.ndarray
    inertia: np.ndarray
    """[3] kg m^2 about the centre of mass: moments xx, yy, zz."""
    product: np.ndarray
    """[3] kg m^2: entries yz, zx, xy."""
    start: np.ndarray
    """[shape, 3] m; a capsule reaches from here to ``end``, a sphere has both in one place."""
    end: np.ndarray
    radius: np.ndarray
    """[shape] m"""

    @functools.cached_property
    def shapes(self) -> tuple[Shape, ...]:
        """Spheres and capsules, in the bunch's frame."""
        axis, middle = self.end - self.start, 0.5 * (self.start + self.end)
        half, rgba = 0.5 * np.linalg.norm(axis, axis=-1), (0.25, 0.05, 0.3, 1.0)
        turn = frames.multiply(frames.from_x_axis(axis), _Z_TO_X)
        return tuple(
            Shape("capsule", (float(r), float(h)), frames.pose(p, q), rgba) if h > 0.0
            else Shape("sphere", (float(r),), frames.pose(p), rgba)
            for r, h, p, q in zip(self.radius, half, middle, turn, strict=True)
        )  # fmt: skip


def slot_name(slot: int) -> str:
    """What MuJoCo calls the body that waits in a slot, and its joint."""
    return f"loose/{slot}"


def add_slot(spec: mujoco.MjSpec, slot: int) -> None:
    """A free body that waits for a bunch: asleep, touched by nothing, its numbers of no meaning yet."""
    body = spec.worldbody.add_body(
        name=slot_name(slot), pos=_place_of(slot)[:3], mass=0.5, ipos=[0.05, 0.0, 0.0], inertia=[1e-3, 1e-3, 1e-3],
        explicitinertial=True, sleep=mujoco.mjtSleepPolicy.mjSLEEP_INIT,
    )  # fmt: skip
    body.add_freejoint(name=slot_name(slot))
    for _ in range(MAX_GEOMS):
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0], pos=[0.05, 0.0, 0.0], mass=0.0, contype=FREE_BUNCH,
            conaffinity=ALL_BITS & ~CRATE_FLOOR,
        )  # fmt: skip  # MuJoCo makes no bounding volumes for what nothing touches: that comes after compiling


def _place_of(slot: int) -> np.ndarray:
    """Where a body waits: position and quaternion (w first) [7]."""
    return np.array([float(slot), 0.0, PARKED, 1.0, 0.0, 0.0, 0.0])


@functools.lru_cache(maxsize=256)  # every compilation asks anew
def compile_alone(loose: FreeBunch) -> mujoco.MjModel:
    """A bunch in a world of its own."""
    spec = mujoco.MjSpec()
    add_free_bunch(spec, loose)
    return spec.compile()


def add_free_bunch(spec: mujoco.MjSpec, loose: FreeBunch) -> None:
    """A bunch as a free body of round shapes.

    Harder than MuJoCo's own ``solimp`` it would be held a few micrometres deep, and a hand that moves would lose touch
    for a tick: fingers that hold with 25 N then are 3 mm further, and the bunch falls.
    """
    if not 0 < len(loose.radius) <= MAX_GEOMS:
        raise ValueError(f"a bunch of {len(loose.radius)} shapes; a loose one has 1 to {MAX_GEOMS}")
    yz, zx, xy = loose.product
    body = spec.worldbody.add_body(
        mass=loose.mass, ipos=loose.com, fullinertia=[*loose.inertia, xy, zx, yz], explicitinertial=True
    )
    body.add_freejoint()
    for start, end, radius in zip(loose.start, loose.end, loose.radius, strict=True):
        kind, place = mujoco.mjtGeom.mjGEOM_SPHERE, {"pos": start}
        if (start != end).any():
            kind, place = mujoco.mjtGeom.mjGEOM_CAPSULE, {"fromto": np.concatenate([start, end])}
        body.add_geom(
            type=kind, size=[float(radius), 0, 0], mass=0.0, contype=FREE_BUNCH, conaffinity=ALL_BITS & ~CRATE_FLOOR, condim=6,
            friction=[FRICTION, 0.005, ROLLING], priority=1, solref=SOFT, solimp=[0.99, 0.999, 0.001, 0.5, 2],
            **place,
        )  # fmt: skip
    for _ in range(MAX_GEOMS - len(loose.radius)):
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-3, 0, 0], pos=loose.start[0], mass=0.0, contype=FREE_BUNCH,
            conaffinity=ALL_BITS & ~CRATE_FLOOR,
        )  # fmt: skip


def activate(world: mujoco.MjModel, slot: int, bunch: FreeBunch, derived: mujoco.MjModel) -> None:
    """Give a waiting body the weight and shapes of a bunch, with all constants that MuJoCo derives from them.

    ``mj_setConst`` would derive some of them, but neither bounding volumes nor the bits by which whole bodies are
    sorted out; so they are copied from what was ``derived`` for the bunch :func:`alone`.
    """
    body = world.body(slot_name(slot)).id
    for name in OF_BODY:
        getattr(world, name)[body] = getattr(derived, name)[1]
    geoms = slice(world.body_geomadr[body], world.body_geomadr[body] + MAX_GEOMS)
    for name in OF_GEOM:
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
    """Let nothing touch a waiting body."""
    body = world.body(slot_name(slot)).id
    geoms = slice(world.body_geomadr[body], world.body_geomadr[body] + MAX_GEOMS)
    world.body_contype[body] = world.body_conaffinity[body] = 0
    world.geom_contype[geoms] = world.geom_conaffinity[geoms] = 0
