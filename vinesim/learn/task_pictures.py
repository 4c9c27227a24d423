"""Pictures of the tasks: of the worlds' cameras for policies, and of a spectator for people."""

from __future__ import annotations

from collections.abc import Sequence

import gymnasium
import numpy as np
import warp as wp

from vinesim.kernels.learn.pictures import limit_depth
from vinesim.sensors.camera.world_cameras import WorldCamera, WorldCameras
from vinesim.worlds.worlds import Worlds

FARTHEST = 10.0
"""[m] Largest depth of an observation. The sky and things farther away have this depth, so that observations are
finite."""
SPECTATOR_SIZE = (256, 256)
"""[px] Width and height of the pictures of ``render``."""

Pictures = dict[str, wp.array]
"""Arrays [world, camera, row, column] by name: ``rgb``, ``depth`` and ``labels``."""


class ObservedPictures:
    """The pictures that policies get.

    Args:
        worlds: the worlds.
        cameras: their cameras.
        size: width and height [px].
    """

    def __init__(self, worlds: Worlds, cameras: Sequence[WorldCamera], size: int) -> None:
        self._cameras = WorldCameras(worlds, cameras, (size, size))
        shape = (len(cameras), size, size)
        box = gymnasium.spaces.Box
        self.spaces: dict[str, gymnasium.Space] = {
            "rgb": box(0, 255, (*shape, 3), np.uint8),
            "depth": box(0.0, FARTHEST, shape, np.float32),
            "labels": box(0, np.iinfo(np.int32).max, shape, np.int32),
        }
        """Spaces of one world's pictures."""

    def empty(self) -> Pictures:
        """Returns arrays for pictures of all worlds."""
        return {name: wp.zeros_like(array) for name, array in self._drawn().items()}

    def write(self, pictures: Pictures, worlds: wp.array | None = None) -> None:
        """Write pictures of the present states. ``worlds``: bool [world], which may have changed since the last call;
        None: all."""
        self._cameras.render(worlds)
        for name, drawn in self._drawn().items():
            written = pictures[name]
            if name == "depth":
                given = [FARTHEST, drawn.flatten()]
                wp.launch(limit_depth, drawn.size, given, [written.flatten()], device=drawn.device)
            else:
                wp.copy(written, drawn)

    def _drawn(self) -> Pictures:
        assert self._cameras.rgb is not None, "made with colours"
        return {"rgb": self._cameras.rgb, "depth": self._cameras.depth, "labels": self._cameras.labels}


class Spectator:
    """Pictures of a camera that stands beside the robot, of all worlds. The camera is made with the first picture."""

    def __init__(self, worlds: Worlds, camera: WorldCamera) -> None:
        self._worlds = worlds
        self._camera = camera
        self._cameras: WorldCameras | None = None

    def frames(self) -> tuple[np.ndarray, ...]:
        """Returns a picture [height, width, 3] uint8 of each world's present state."""
        if self._cameras is None:
            self._cameras = WorldCameras(self._worlds, [self._camera], SPECTATOR_SIZE)
        self._cameras.render()
        assert self._cameras.rgb is not None, "made with colours"
        return tuple(self._cameras.rgb.numpy()[:, 0].copy())
