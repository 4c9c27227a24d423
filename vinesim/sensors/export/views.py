"""Views for the pictures of a data set: poses of a camera from which bunches are visible, drawn from a mix, and poses
of a camera that drives along the row."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from vinesim.core import frames
from vinesim.scene.ids import LABEL_STRIDE, Organ, label
from vinesim.scene.model import Model
from vinesim.scene.terrain import ground_height
from vinesim.scene.values import CameraInfo, Snapshot
from vinesim.sensors import ground_truth
from vinesim.sensors.export import annotations as formats
from vinesim.sensors.export import images as picture
from vinesim.sensors.export.mix import SequenceTable, ViewEntry, draw_number
from vinesim.sensors.ground_truth import PixelBuffers
from vinesim.sensors.primitives.ray_caster import enclosing_primitive
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.raster.camera_rasterizer import CameraRasterizer, pinhole
from vinesim.sensors.spec_file import SensorError

MAX_ACTOR_DISTANCE = 2.5
"""Largest horizontal distance [m] from the actors' place of work to the bunch in view."""
MIN_CLEARANCE = 0.15
"""Depth [m] below which at most a fiftieth of a picture's pixels may be; other views are rejected."""
MIN_ACTOR_SHARE = 0.01
"""Least share of a picture's pixels that show actors or boxes, in scenes that have any."""
MIN_PLANT_SHARE = 0.02
"""Least share of the pixels of a picture without bunches that show a plant."""
BUNCHES_PER_DRAW = 10
"""Number of bunches that are tried with the same drawn values, so that the views are distributed as the mix says."""
_PREVIEW_WIDTH = 160
"""Largest width of a preview [px]."""
_MAX_TRIES = 100
_DRAWS_PER_TRY = 20
_TRIES_WITH_ACTORS = 30
_TRIES_WITH_ALL_BUNCHES = 60
_TRIES_WITHOUT_BUNCHES = 300
_TRIES_UNTIL_DOWN = 60


class ViewError(SensorError):
    """Raised if no view of a scene is as the mix wants it. The message is one line."""


@dataclasses.dataclass(frozen=True, slots=True)
class Drive:
    """Motion of a camera along a row, relative to its first pose."""

    speed: float
    """[m/s] Speed in the direction of +x."""
    period: float
    """[s] Time between two frames."""
    frames: int
    table: SequenceTable
    phase: np.ndarray
    """[3, 3] rad, phases of the waves of heave, pitch and roll."""

    @classmethod
    def random(cls, rng: np.random.Generator, table: SequenceTable, count: int, step: float) -> Drive:
        """Returns a drive in a random direction along the row, of ``count`` frames that are a whole number of steps of
        ``step`` [s] apart."""
        speed = draw_number(rng, table.speed) * (1.0 if rng.random() < 0.5 else -1.0)
        period = step * max(round(1.0 / (table.rate * step)), 1)
        return cls(speed, period, count, table, rng.uniform(0.0, 2.0 * np.pi, (3, 3)))

    def pose(self, first: np.ndarray, frame: int, model: Model) -> np.ndarray:
        """Returns the pose [7] of the optical frame in a frame of the sequence; ``first``: its pose [7] in frame 0."""
        way = self.speed * self.period * frame
        # waves of sod and tracks, GUESSED: 1.7, 0.9 and 0.4 m long
        waves = np.sin(self.phase + 2.0 * np.pi * way / np.array([1.7, 0.9, 0.4])) - np.sin(self.phase)
        heave, rock, roll = waves @ np.array([0.6, 0.3, 0.1])
        eye = first[:3] + np.array([way, 0.0, self.table.heave * heave])
        eye[2] += ground_height(model.terrain, *eye[:2]) - ground_height(model.terrain, *first[:2])
        turn = frames.exp(self.table.rock * np.array([rock, 0.0, roll]))
        return frames.pose(eye, frames.multiply(first[3:], turn))


@dataclasses.dataclass(frozen=True, slots=True)
class ViewFinder:
    """Finds views of one scene, whose primitives are posed to a snapshot."""

    name: str
    """Name of the scene, for messages."""
    primitives: Primitives
    snapshot: Snapshot
    near: np.ndarray | None = None
    """Point [2] m of the ground near which the bunch in view hangs; None: any bunch."""
    drive: Drive | None = None
    """Motion of the camera after the first picture; its whole way must be free."""

    def of_bunch(
        self, rng: np.random.Generator, entry: ViewEntry, info: CameraInfo, actors: list[tuple[float, float]]
    ) -> tuple[PixelBuffers, dict[str, Any]]:
        """Returns the view of a random hanging bunch from a free place, in which the bunch is visible, and the drawn
        values.

        ``actors``: positions [m], one of which is in view too, unless too many tries fail.
        """
        hanging = self._hanging_bunches()
        preview = _Preview.of(self.primitives, info)
        tries = 0
        values: dict[str, float] = {}
        for draw in range(_MAX_TRIES * _DRAWS_PER_TRY):
            with_actors = bool(actors) and tries < _TRIES_WITH_ACTORS
            if draw % BUNCHES_PER_DRAW == 0 or with_actors:
                values = _draw_values(rng, entry)
            bunch = int(hanging[rng.integers(len(hanging))])
            middle = self._middle_of_bunch(bunch)
            side = 1.0 if rng.random() < 0.5 else -1.0
            if with_actors:  # look from the side opposite to an actor, as far as the mix allows
                behind = np.array(actors[rng.integers(len(actors))]) - middle[:2]
                wanted = math.atan2(behind[1], behind[0]) + rng.normal(0.0, 0.3)
                values["turn"], side = _turn_towards(wanted, entry, values["turn"], side)
            pose, depth, distance = self._place(middle, bunch, side, values, info)
            if not self._is_free(pose, entry, distance):
                continue
            tries += 1
            is_choosy = tries <= _TRIES_WITH_ALL_BUNCHES
            wanted = _Wanted(
                bunch,
                entry.visible * self._outline(bunch, depth, info) if is_choosy else 0.0,
                entry.bunches if is_choosy else 1,
                with_actors,
            )
            if wanted.is_in(*preview.draw(pose), preview.scale):
                seen = ground_truth.render_buffers(self.primitives, info, pose)
                if wanted.is_in(seen.labels, seen.depth):
                    return seen, {"bunch": bunch, "side": side, "distance": distance, **values}
            if tries == _MAX_TRIES:
                break
        raise ViewError(
            f"scene {self.name!r} has no open place near its bunches for views {entry.name!r} of the mix, in {tries} "
            "pictures; widen the ranges of the mix"
        )

    def without_bunches(
        self, rng: np.random.Generator, entry: ViewEntry, info: CameraInfo
    ) -> tuple[PixelBuffers, dict[str, Any]]:
        """Returns a view from a free place near a random hanging bunch, in a direction in which a plant is visible, but
        no bunch; and the drawn values."""
        hanging = self._hanging_bunches()
        for attempt in range(_TRIES_WITHOUT_BUNCHES):
            middle = self._middle_of_bunch(int(hanging[rng.integers(len(hanging))]))
            bearing, heading = rng.uniform(0.0, 2.0 * np.pi, 2)
            away = draw_number(rng, entry.distance)
            eye = np.array([*(middle[:2] + away * np.array([np.cos(bearing), np.sin(bearing)])), 0.0])
            eye[2] = rng.uniform(*entry.camera_height) + ground_height(self.primitives.model.terrain, *eye[:2])
            # Bunches hang at the height of the camera. So later tries look farther down, at trunks and the ground.
            pitch = rng.uniform(-0.3, 0.3) - 0.9 * min(attempt / _TRIES_UNTIL_DOWN, 1.0)
            roll = draw_number(rng, entry.roll)
            pose = _pose(eye, heading, pitch, roll)
            if not self._is_way_free(pose):
                continue
            seen = ground_truth.render_buffers(self.primitives, info, pose)
            if _is_obstructed(seen.depth):
                continue
            organs = seen.labels // LABEL_STRIDE
            is_plant = (organs >= Organ.TRUNK) & (organs <= Organ.LEAF)
            if not (organs == Organ.BUNCH).any() and is_plant.mean() >= MIN_PLANT_SHARE:
                return seen, {"pitch": pitch, "roll": roll}
        raise ViewError(
            f"scene {self.name!r} has no view of a plant without bunches, in {_TRIES_WITHOUT_BUNCHES} tries; "
            "lower fruit.bunches, or give --negatives 0"
        )

    def _hanging_bunches(self) -> np.ndarray:
        """Returns the indices of the hanging bunches; if possible only of those around the point :attr:`near`."""
        snapshot = self.snapshot
        hanging = np.flatnonzero(snapshot.bunch_attached)
        if self.near is not None:
            place = snapshot.body_q[self.primitives.model.bunch_body[hanging], :2]
            is_near = np.linalg.norm(place - self.near, axis=1) < MAX_ACTOR_DISTANCE
            hanging = hanging[is_near] if is_near.any() else hanging
        if not len(hanging):
            raise ViewError(f"scene {self.name!r} bears too few bunches; raise fruit.bunches")
        return hanging

    def _middle_of_bunch(self, bunch: int) -> np.ndarray:
        """Returns the middle [3] m of a bunch's rachis."""
        model = self.primitives.model
        pose = self.snapshot.body_q[model.bunch_body[bunch]].astype(float)
        return pose[:3] + frames.rotate(pose[3:], np.array([0.5 * model.bunch_length[bunch], 0.0, 0.0]))

    def _place(
        self, middle: np.ndarray, bunch: int, side: float, values: dict[str, float], info: CameraInfo
    ) -> tuple[np.ndarray, float, float]:
        """Returns the pose [7] of the optical frame from which ``middle`` [3] m is where ``values`` want it in the
        picture, and the depth and distance of ``middle`` [m].

        ``side``: side of the row on which the camera stands, 1 or -1.
        """
        column = (0.5 + values["across"]) * info.width - 0.5
        row = (0.5 + values["down"]) * info.height - 0.5
        ray = np.array([(column - info.cx) / info.fx, (row - info.cy) / info.fy, 1.0])
        turned = _pose(middle, values["turn"] - side * 0.5 * np.pi, values["pitch"], values["roll"])
        if "bunch_height" in values:
            length = float(self.primitives.model.bunch_length[bunch])
            depth = length * info.fy / (values["bunch_height"] * info.height)
        else:
            depth = values["distance"] / float(np.linalg.norm(ray))
        turned[:3] -= frames.rotate(turned[3:], ray * depth)
        return turned, depth, depth * float(np.linalg.norm(ray))

    def pose_at(self, point: np.ndarray, side: float, values: dict[str, float], info: CameraInfo) -> np.ndarray:
        """Returns the pose [7] of the optical frame from which ``point`` [3] m is where ``values`` want it in the
        picture; ``side``: side of the row on which the camera stands, 1 or -1."""
        return self._place(point, -1, side, values, info)[0]

    def is_free(self, pose: np.ndarray, entry: ViewEntry, distance: float) -> bool:
        """Returns whether the camera may stand at ``pose`` [7], ``distance`` [m] from what it looks at."""
        return self._is_free(pose, entry, distance)

    @staticmethod
    def is_obstructed(seen: PixelBuffers) -> bool:
        """Returns whether something is too near to the camera."""
        return _is_obstructed(seen.depth)

    def _outline(self, bunch: int, depth: float, info: CameraInfo) -> float:
        """Returns the area [px] of a bunch at ``depth`` [m], seen from the side, as an ellipse."""
        model = self.primitives.model
        size = np.pi / 2.0 * float(model.bunch_length[bunch]) * float(model.bunch_radius[bunch])
        return size * info.fx * info.fy / depth**2

    def _is_free(self, pose: np.ndarray, entry: ViewEntry, distance: float) -> bool:
        """Returns whether the camera may stand at ``pose`` [7]: within the limits of the mix, and not in a body."""
        limits = entry.distance if isinstance(entry.distance, tuple) else (entry.distance,)
        height = pose[2] - ground_height(self.primitives.model.terrain, *pose[:2])
        return (
            limits[0] - 1e-9 <= distance <= limits[-1] + 1e-9
            and entry.camera_height[0] <= height <= entry.camera_height[1]
            and self._is_way_free(pose)
        )

    def _is_way_free(self, pose: np.ndarray) -> bool:
        """Returns whether the camera is outside of all bodies at ``pose`` [7] and on its drive."""
        way = [pose]
        if self.drive is not None:
            way = [self.drive.pose(pose, k, self.primitives.model) for k in range(self.drive.frames)]
        return all(enclosing_primitive(self.primitives, one[:3]) < 0 for one in way)


@dataclasses.dataclass(frozen=True, slots=True)
class _Preview:
    """Small pictures of views, by which most of the unsuitable ones are rejected at a low cost."""

    primitives: Primitives
    info: CameraInfo
    rasterizer: CameraRasterizer
    scale: float
    """Number of pixels of the whole picture in one of these."""

    @classmethod
    def of(cls, primitives: Primitives, info: CameraInfo) -> _Preview:
        """Returns a preview of pictures with intrinsics ``info``, without their distortion."""
        share = min(_PREVIEW_WIDTH / info.width, 1.0)
        width, height = max(round(info.width * share), 1), max(round(info.height * share), 1)
        fx, fy = (focal * share for focal in (info.fx, info.fy))
        small = CameraInfo(width, height, fx, fy, 0.5 * (width - 1), 0.5 * (height - 1), info.frame_id)
        rasterizer = CameraRasterizer(width, height, primitives.device)
        return cls(primitives, small, rasterizer, share**-2)

    def draw(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns labels and depth [m] of the pixels seen from ``pose`` [7]."""
        self.rasterizer.draw(self.primitives, pinhole(self.info, pose))
        return self.rasterizer.labels.numpy(), self.rasterizer.depth.numpy()


@dataclasses.dataclass(frozen=True, slots=True)
class _Wanted:
    """What a view shall show."""

    bunch: int
    pixels: float
    """Least number of pixels of the bunch."""
    bunches: int
    """Least number of bunches that are large enough to be annotated."""
    with_actors: bool

    def is_in(self, labels: np.ndarray, depth: np.ndarray, scale: float = 1.0) -> bool:
        """Returns whether a view with these labels and depths [m] shows it, and nothing is too near. ``scale``: number
        of pixels that each of the given ones stands for."""
        if _is_obstructed(depth):
            return False
        shown, pixels = np.unique(labels[labels // LABEL_STRIDE == int(Organ.BUNCH)], return_counts=True)
        pixels = pixels * scale
        mine = float(pixels[shown == label(Organ.BUNCH, self.bunch)].sum())
        if mine < max(self.pixels, formats.MIN_ANNOTATED_PIXELS):
            return False
        if (pixels >= formats.MIN_ANNOTATED_PIXELS).sum() < self.bunches:
            return False
        actors = np.isin(labels // LABEL_STRIDE, (Organ.BOX, Organ.ROBOT, Organ.HUMAN))
        return not self.with_actors or bool(actors.mean() >= MIN_ACTOR_SHARE)


def _is_obstructed(depth: np.ndarray) -> bool:
    """Returns whether something is too near to the camera in a view with these depths [m]."""
    return bool((depth < MIN_CLEARANCE).mean() >= 0.02)


def _draw_values(rng: np.random.Generator, entry: ViewEntry) -> dict[str, float]:
    """Returns values of a view by name, drawn from the mix."""
    names = ["pitch", "turn", "roll", "across", "down", "distance" if entry.bunch_height is None else "bunch_height"]
    return {name: draw_number(rng, getattr(entry, name)) for name in names}


def _turn_towards(heading: float, entry: ViewEntry, turn: float, side: float) -> tuple[float, float]:
    """Returns turn [rad] and side with which a camera looks in the direction ``heading`` [rad]; ``turn`` and ``side``
    if the turn is not within the limits of the mix."""
    limits = entry.turn if isinstance(entry.turn, tuple) else (entry.turn,)
    for one in (side, -side):
        wanted = (heading + one * 0.5 * np.pi + np.pi) % (2.0 * np.pi) - np.pi
        if limits[0] <= wanted <= limits[-1]:
            return wanted, one
    return turn, side


def _pose(eye: np.ndarray, heading: float, pitch: float, roll: float) -> np.ndarray:
    """Returns the pose [7] of an optical frame at ``eye`` [3] m that looks in the direction ``heading`` [rad] from +x,
    ``pitch`` [rad] up, turned by ``roll`` [rad] about its axis."""
    forward = np.array([math.cos(pitch) * math.cos(heading), math.cos(pitch) * math.sin(heading), math.sin(pitch)])
    pose = picture.look_at(eye, eye + forward)
    pose[3:] = frames.multiply(pose[3:], frames.exp(np.array([0.0, 0.0, roll])))
    return pose
