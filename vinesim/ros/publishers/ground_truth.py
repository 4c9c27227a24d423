"""The truth about the vineyard, for those who want it: poses apart from the robot's own tf, and what labels mean."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
from std_msgs.msg import String

from vinesim.ros.messages import convert
from vinesim.ros.messages.transforms import Transforms
from vinesim.ros.publishers.robot import MAP
from vinesim.ros.topic import LATCHED, RELIABLE, Advertise, Offer


class Surroundings:
    """``tf_environment`` (what moves) and ``tf_environment_static`` (poles) in the map; ``label_map``, latched."""

    def __init__(self, advertise: Advertise, tf_message: type) -> None:
        self._moving = advertise(tf_message, "tf_environment", RELIABLE)
        self._static = advertise(tf_message, "tf_environment_static", LATCHED)
        advertise(String, "label_map", LATCHED).send(convert.label_map())
        self._names: Sequence[str] | None = None
        self._transforms = Transforms([])

    def offers(self, time: float, names: tuple[str, ...], poses: np.ndarray) -> Iterator[Offer]:
        """What moves; what is no longer named is gone. Pass the same tuple as long as the names stay."""
        yield self._moving, partial(self._message, time, names, poses)

    def static_offers(self, names: tuple[str, ...], poses: np.ndarray) -> Iterator[Offer]:
        """What stands, once for all."""
        transforms = Transforms([(MAP, name) for name in names])
        yield self._static, partial(transforms.message, 0.0, poses)

    def _message(self, time: float, names: tuple[str, ...], poses: np.ndarray) -> bytes:
        if names is not self._names:
            self._transforms = Transforms([(MAP, name) for name in names])
            self._names = names
        return self._transforms.message(time, poses)
