"""Places robots, people and crates in a vineyard for a picture, as in a simulation at that instant.

    composer = SceneComposer(
        robots=(RobotPlacement("vinebot", 1.5, 0.8),), crates=(CratePlacement(3.0, 0.5, fill=0.6),)
    )
    snapshot = composer.compose(model, scene.physics)

Bunches in a crate are picked from the nearest vines. They fall in one after another, simulated by the rigid world.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from vinesim.core import frames
from vinesim.rigid.human_posture import standing_pose
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.description.loader import load_description
from vinesim.scene import appearance
from vinesim.scene.berries import VARIETIES
from vinesim.scene.ids import Organ, label
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.terrain import Terrain, on_ground
from vinesim.scene.values import HumanSpec, RobotSpec, Snapshot
from vinesim.sensors.primitives.scene_primitives import rest_snapshot

if TYPE_CHECKING:
    from vinesim.world import Physics

HEAP_DENSITY = 330.0
"""Bulk density of a heap of bunches [kg/m3]. GUESSED: a crate of 50 l filled to 60 % has 10 kg."""
CRATE_WALL = 0.012
"""Thickness of a crate's walls [m]. GUESSED."""
CRATE_MASS = 1.6
"""Mass of an empty crate [kg]. GUESSED."""
MAX_PENETRATION = 0.01
"""Largest depth to which an actor may penetrate anything [m]."""
FALL_STEPS = 25
"""Steps between two bunches that fall into a crate."""
SETTLE_STEPS = 100
"""Steps in which the heap settles."""
MAX_REFILLS = 3
"""Largest number of attempts to put back bunches that rolled out."""


class PlacementError(ValueError):
    """An actor or crate does not fit at its place. The message is one line."""


@dataclasses.dataclass(frozen=True, slots=True)
class RobotPlacement:
    """A robot, given by the name of its description, at ``x``, ``y`` [m], ``yaw`` [rad]."""

    robot: str
    x: float
    y: float
    yaw: float = 0.0


@dataclasses.dataclass(frozen=True, slots=True)
class PersonPlacement:
    """A person in a posture of ``data/figures/postures.toml``."""

    x: float
    y: float
    yaw: float = 0.0
    posture: str = "stand"
    height: float = 1.75
    """Height of the person [m]."""


@dataclasses.dataclass(frozen=True, slots=True)
class CratePlacement:
    """A crate on the ground; ``fill`` is the fraction of its inside that is filled with bunches."""

    x: float
    y: float
    yaw: float = 0.0
    fill: float = 0.0
    size: tuple[float, float, float] = (0.6, 0.4, 0.24)
    """Outer length, width, height [m]."""

    @property
    def pose(self) -> np.ndarray:
        """Pose [7] of the crate on level ground."""
        return _ground_pose(None, self.x, self.y, self.yaw)

    def pose_on(self, terrain: Terrain | None) -> np.ndarray:
        """Returns the pose [7] of the crate on the ground."""
        if terrain is None:
            return self.pose
        return terrain.resting_pose(self.x, self.y, self.yaw, (0.5 * self.size[0], 0.5 * self.size[1]))


@dataclasses.dataclass(frozen=True, slots=True)
class SceneComposer:
    """The actors and crates of a picture. Labels count from 0 in the given order."""

    robots: tuple[RobotPlacement, ...] = ()
    people: tuple[PersonPlacement, ...] = ()
    crates: tuple[CratePlacement, ...] = ()
    """Crates in addition to the boxes of the scene, numbered after them."""

    def compose(self, model: Model, parameters: PhysicsParameters = PhysicsParameters()) -> Snapshot:
        """Returns a snapshot of the vineyard with actors and crates at rest. Raises :class:`PlacementError` if two of
        them overlap.

        ``parameters``: physics parameters of the model's scene.
        """
        furnished = self.with_crates(model)
        if any(crate.fill > 0.0 for crate in self.crates):
            # imported here, because the kernels of plants take half a second to load and few pictures need them
            from vinesim.world import Physics

            return self.populate(Physics(furnished, parameters=parameters))
        rigid = RigidWorld(furnished, parameters=parameters)  # no bunches are picked, so the plants need not move
        self._add_actors(rigid)
        return rest_snapshot(model, rigid.visuals(), rigid.visual_q())

    def with_crates(self, model: Model) -> Model:
        """Returns the model with the crates added after its own boxes."""
        count = len(self.crates)
        pose = np.array([c.pose_on(model.terrain) for c in self.crates])
        size = np.array([c.size for c in self.crates])
        return dataclasses.replace(
            model,
            box_pose=np.concatenate([model.box_pose, pose.reshape(count, 7)]).astype(model.box_pose.dtype),
            box_size=np.concatenate([model.box_size, size.reshape(count, 3)]).astype(model.box_size.dtype),
            box_mass=np.append(model.box_mass, [CRATE_MASS] * count).astype(model.box_mass.dtype),
        )

    def populate(self, physics: Physics) -> Snapshot:
        """Fill the crates and add the actors in ``physics``, whose model is from :meth:`with_crates`. Returns a
        snapshot."""
        for number, crate in enumerate(self.crates, len(physics.model.box_size) - len(self.crates)):
            fill_crate(physics, number, crate)
        self._add_actors(physics.rigid)
        return physics.snapshot()

    def robot_specs(self, terrain: Terrain | None) -> list[RobotSpec]:
        """Returns the specifications of all robots on the ground. Raises :class:`DescriptionError`."""
        return [
            load_description(one.robot).to_spec(
                f"robot_{index}", index=index, pose=_ground_pose(terrain, one.x, one.y, one.yaw)
            )
            for index, one in enumerate(self.robots)
        ]

    def _add_actors(self, rigid: RigidWorld) -> None:
        """Add robots and people. Raises :class:`PlacementError` if one overlaps something."""
        terrain = rigid.model.terrain
        for spec in self.robot_specs(terrain):
            rigid.add_robot(spec)
        for index, one in enumerate(self.people):
            pose = appearance.apply_posture(
                standing_pose(_ground_pose(terrain, one.x, one.y, one.yaw), one.height), one.posture, one.height
            )
            rigid.add_human(HumanSpec(f"person_{index}", index, pose, one.height))
        _check_clearance(rigid)

    def actor_records(self, model: Model) -> list[dict]:
        """Returns kind, label and placement of all robots, people and boxes, as JSON values."""
        records = []
        for organ, things, start in (
            (Organ.ROBOT, self.robots, 0),
            (Organ.HUMAN, self.people, 0),
            (Organ.BOX, self.crates, len(model.box_size)),
        ):
            for number, one in enumerate(things, start):
                records.append({"kind": organ.name.lower(), "label": label(organ, number), **dataclasses.asdict(one)})
        return records


def _ground_pose(terrain: Terrain | None, x: float, y: float, yaw: float) -> np.ndarray:
    return on_ground(terrain, frames.pose(np.array([x, y, 0.0]), frames.from_yaw(yaw)))


def bunch_masses(model: Model) -> np.ndarray:
    """Returns the mass [bunch] kg of all bunches."""
    return model.bunch_berries * np.array([v.mass for v in VARIETIES])[model.bunch_variety]


def fill_crate(physics: Physics, number: int, crate: CratePlacement) -> list[int]:
    """Let the bunches nearest to a crate fall into it until its ``fill`` is reached. Returns their indices."""
    model = physics.model
    rigid = physics.rigid
    pose = crate.pose_on(model.terrain)
    inside = np.array(crate.size) - [2.0 * CRATE_WALL, 2.0 * CRATE_WALL, CRATE_WALL]
    wanted = crate.fill * HEAP_DENSITY * float(np.prod(inside))
    where = physics.state.body_q[model.bunch_body, :3]
    away = np.hypot(where[:, 0] - crate.x, where[:, 1] - crate.y)
    near = np.argsort(np.where(physics.state.bunch_attached, away, np.inf), kind="stable")
    near = near[: int(physics.state.bunch_attached.sum())]
    chosen = near[: int(np.searchsorted(np.cumsum(bunch_masses(model)[near]), wanted))]
    if len(chosen) == len(near) and wanted > 0.0:
        raise PlacementError(
            f"crate {number} wants {wanted:.1f} kg of bunches, more than the vineyard bears; fill it less"
        )
    rng = np.random.default_rng([number, model.bunch_seed[0] if len(model.bunch_seed) else 0])
    waiting = chosen.tolist()
    inside_it = []
    for _ in range(MAX_REFILLS):
        for bunch in waiting:
            if physics.state.bunch_attached[bunch]:
                physics.pick(bunch)
            top = max([CRATE_WALL, *(_top_height(physics, other) for other in inside_it)])
            rigid.place_bunch(bunch, frames.compose(pose, _drop_pose(model, bunch, inside, top, rng)), np.zeros(6))
            inside_it.append(bunch)
            _step_rigid(rigid, FALL_STEPS)
        _step_rigid(rigid, SETTLE_STEPS)
        middle = {bunch: _rachis_ends(physics, bunch).mean(0) - pose[:3] for bunch in inside_it}
        level = {bunch: frames.rotate(frames.conjugate(pose[3:]), at)[:2] for bunch, at in middle.items()}
        waiting = [bunch for bunch, at in level.items() if (np.abs(at) > 0.5 * inside[:2]).any()]
        inside_it = [bunch for bunch in inside_it if bunch not in waiting]
        if not waiting:
            break
    return chosen.tolist()


def _drop_pose(model: Model, bunch: int, inside: np.ndarray, top: float, rng: np.random.Generator) -> np.ndarray:
    """Returns a random pose [7] of a bunch just above the height ``top`` [m] of a heap, in the crate's frame.

    ``inside``: inner size of the crate [3] m.
    """
    length = float(model.bunch_length[bunch])
    radius = float(model.bunch_radius[bunch])
    room = np.maximum(0.5 * inside[:2] - [0.5 * length + 0.02, radius + 0.01], 0.0)
    yaw = rng.choice([0.0, np.pi]) + rng.uniform(-0.35, 0.35)
    start = rng.uniform(-room, room) - 0.5 * length * np.array([np.cos(yaw), np.sin(yaw)])
    roll = frames.exp(np.array([rng.uniform(-np.pi, np.pi), 0.0, 0.0]))
    return frames.pose(np.array([*start, top + radius + 0.01]), frames.multiply(frames.from_yaw(yaw), roll))


def _rachis_ends(physics: Physics, bunch: int) -> np.ndarray:
    """Returns both ends [2, 3] m of a free bunch's rachis, in the world."""
    reach = np.array([[0.0, 0.0, 0.0], [float(physics.model.bunch_length[bunch]), 0.0, 0.0]])
    pose = physics.rigid.bunch_pose(bunch)
    return pose[:3] + frames.rotate(pose[3:], reach)


def _top_height(physics: Physics, bunch: int) -> float:
    """Returns an upper bound of the height [m] of a bunch's highest point."""
    return float(_rachis_ends(physics, bunch)[:, 2].max() + physics.model.bunch_radius[bunch])


def _step_rigid(rigid: RigidWorld, ticks: int) -> None:
    """Step the rigid world without the plants."""
    for _ in range(ticks):
        rigid.predict()
        rigid.integrate()


def _check_clearance(rigid: RigidWorld) -> None:
    """Raise :class:`PlacementError` if an actor overlaps another actor, an object or the trellis."""
    rigid.predict()
    for names in rigid.penetrations():
        one, other = sorted(names[:2], key=rigid.actors.__contains__, reverse=True)
        if names[2] > MAX_PENETRATION and one in rigid.actors:
            kind, _, number = other.partition("/")
            if kind == "fixed":
                other = Organ(int(rigid.model.fixed_organ[int(number)])).name.lower()
            raise PlacementError(f"{one} stands {100.0 * names[2]:.0f} cm deep in {other}; move one of them")
