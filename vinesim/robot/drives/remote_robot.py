"""Copy of a robot that another client controls: servos pull it to the states that arrive over the network."""

from __future__ import annotations

import numpy as np

from vinesim.robot.drives.commands import CommandError
from vinesim.robot.drives.robot_instance import RobotInstance
from vinesim.scene.values import RobotUpdate


class RemoteRobot(RobotInstance):
    """The copy of a robot that another client controls: pulled to its states, yet it can be held and pushed."""

    TELEPORT_DISTANCE = 1.0
    """[m] Beyond it the copy is placed anew instead of pulled. GUESSED"""

    def follow(self, update: RobotUpdate) -> None:
        """Pull the copy to the state of ``update`` from now on.

        Raises :class:`CommandError` if the update has another number of joints than the description.
        """
        count = len(self.description.drives)
        if update.position.shape != (count,) or update.velocity.shape != (count,):
            raise CommandError(
                f"{self.name}: update has {update.position.size} joints, its description {count}; "
                "load the same robot on both clients"
            )
        self.lights = update.lights
        here, _ = self.rigid.base_state(self.name)
        if np.linalg.norm(update.base_q[:3] - here[:3]) > self.TELEPORT_DISTANCE:
            self._teleport(update, here)
        self.rigid.follow_remote(self.name, update.base_q, update.base_qd, update.position, update.velocity)

    def _teleport(self, update: RobotUpdate, here: np.ndarray) -> None:
        """Place the copy at the update's state; ``here`` [7]: where its base is."""
        if abs(update.base_q[2] - here[2]) > 1e-3:  # the base joint is planar: another height needs a new body
            self.rigid.remove_robot(self.name)
            self._shown_color = None
            self.rigid.add_robot(self.description.to_spec(self.name, self._index, update.base_q))
        self.rigid.place_robot(self.name, update.base_q, update.position)
