"""The spectator role: a client without a body that receives what happens near its viewpoint and renders it."""

from __future__ import annotations

import pathlib
from collections.abc import Callable

import numpy as np

from vinesim.client.client import Client, label_index
from vinesim.core import frames
from vinesim.core.errors import writing
from vinesim.net.codec.control import Hello
from vinesim.net.replication.replication_state import SPECTATOR
from vinesim.net.replication.replicator import Replicator
from vinesim.net.transport.bus import Bus
from vinesim.robot.description.description import RobotDescription
from vinesim.scene.terrain import Terrain, on_ground
from vinesim.scene.values import CameraFrame, CameraInfo, CameraMount, HumanPose, RobotUpdate
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export import images
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.sensor import load_kernels
from vinesim.wind.sway import Sway

EYE_HEIGHT = 1.6
"""Height of a standing person's eyes above the ground [m]."""

FOLLOW_DISTANCE = 2.6
"""Horizontal distance of the eyes from a robot that they follow [m]."""

FOLLOW_YAW = 0.7
"""Angle between the line straight behind a followed robot and the line from the robot to the eyes [rad]."""


def standing_view(x: float, y: float, heading: float, terrain: Terrain | None = None) -> np.ndarray:
    """Returns the pose [7] m, 1 of the eyes of a person who stands at (x, y) [m] and looks along ``heading`` [rad]."""
    return on_ground(terrain, frames.pose(np.array([x, y, EYE_HEIGHT]), frames.from_yaw(heading)))


def follow_view(base: np.ndarray, terrain: Terrain | None = None) -> np.ndarray:
    """Returns the pose [7] m, 1 of the eyes of a person who looks over the shoulder of a robot with its base at
    ``base`` [7]."""
    ahead = frames.rotate(base[3:], np.array([1.0, 0.0, 0.0]))
    heading = float(np.arctan2(ahead[1], ahead[0])) + FOLLOW_YAW
    eye = base[:2] - FOLLOW_DISTANCE * np.array([np.cos(heading), np.sin(heading)])
    return standing_view(float(eye[0]), float(eye[1]), heading, terrain)


class Spectator(Client):
    """A client that only watches. :attr:`pose` [7] is the pose of its eyes: x forward, z up. Assign it to move them."""

    picking = False  # owners of plants report detachments
    slows_the_world = False
    begins_behind_actor = False
    """Whether its first page begins behind the nearest actor, wherever the eyes are."""

    def _add_own_actor(
        self,
        description: RobotDescription | None,
        pose: np.ndarray,
        source: Callable[[float], HumanPose] | None,
        height: float,
        bus: Bus,
    ) -> None:
        self.pose = np.asarray(pose, float)
        hello = Hello(
            name=self.name,
            kind=SPECTATOR,
            scene=self.scene.name,
            digest=self.model.digest(),
            index=label_index(self.name),
            joints=0,
            seed=self.scene.seed,
        )
        self.replicators[self.name] = Replicator(
            bus, hello, self.model, interest_radius=self._interest_radius, jitter_buffer=self._jitter_buffer
        )

    def sense(self) -> None:
        """Call the functions of :attr:`post_step`."""
        for sense in self.post_step:
            sense(self)

    def send(self, now: float) -> None:
        """Publish the pose of the eyes, and nothing else."""
        here = RobotUpdate(self.name, now, self.pose, np.zeros(6), np.zeros(0), np.zeros(0))
        self.objects.collect()
        self.replicator.send(now, here, read=self.objects.read_state)


class PictureWriter:
    """Writes a spectator's view to files ``view_SECONDS.png``, and the last one also with depth and labels.

    The pictures are rendered in the loop, so each shows exactly the state of its time, and a replay renders the same
    pictures every time. Late steps do no harm, because a spectator has no robot.
    """

    WIDTH = 960
    HEIGHT = 640
    ANGLE = 1.2
    """Horizontal field of view [rad]; ``SIZE`` is the size of a picture [px]."""

    def __init__(
        self,
        spectator: Spectator,
        folder: pathlib.Path,
        period: float = 1.0,
        device: str = "cpu",
    ) -> None:
        """Write one picture every ``period`` [s] of simulated time into ``folder``, which must exist."""
        if device == "cpu":
            load_kernels(CameraMount.kind)
        focal = 0.5 * self.WIDTH / np.tan(0.5 * self.ANGLE)
        info = CameraInfo(
            self.WIDTH, self.HEIGHT, focal, focal, 0.5 * (self.WIDTH - 1), 0.5 * (self.HEIGHT - 1), "viewpoint"
        )
        sun = spectator.scene.sun.direction
        self.folder = folder
        self.count = 0
        self.last: CameraFrame | None = None
        self._camera = Camera(
            CameraSpec.load("pinhole"), info, "viewpoint", sun, quality="full", shadow_period=0.0, device=device
        )
        self._primitives = Primitives(spectator.model, device=device)
        self._sway = Sway(spectator.model)
        self._moved = np.zeros(len(spectator.model.tree_first), bool)
        self._every = max(round(period / spectator.physics.dt), 1)
        spectator.post_step.append(self._after_step)

    def _after_step(self, client: Client) -> None:
        assert isinstance(client, Spectator)
        physics = client.physics
        self._moved[physics.plants.awake] = True
        if physics.tick % self._every == 0:
            self._draw(client)

    def _draw(self, spectator: Spectator) -> None:
        view = self._sway.apply(spectator.physics.snapshot(), np.flatnonzero(self._moved))
        self._primitives.update(view, view.moved_trees)
        self._moved[:] = False
        ahead = frames.rotate(spectator.pose[3:], np.array([1.0, 0.0, 0.0]))
        eye = images.look_at(spectator.pose[:3], spectator.pose[:3] + ahead)
        self.last = self._camera.render(self._primitives, eye, view.time)
        self.count += 1
        with writing(self.folder):
            images.write_png(self.folder / f"view_{view.time:08.2f}.png", self.last.rgb)

    def save(self, spectator: Spectator) -> None:
        """Render the present view into the PNG files ``rgb``, ``depth``, ``depth_mm`` and ``labels``."""
        self._draw(spectator)
        assert self.last is not None
        with writing(self.folder):
            images.save_frame(self.last, self.folder, "")
