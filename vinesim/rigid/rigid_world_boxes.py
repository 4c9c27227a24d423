"""Boxes of the rigid world, by number; part of :class:`vinesim.rigid.rigid_world.RigidWorld`."""

from __future__ import annotations

from vinesim.rigid import static_world
from vinesim.rigid.mujoco_world import WorldCore
from vinesim.scene.values import RigidBox


class BoxAccess(WorldCore):
    """Boxes that come and go; those of the scene have the numbers that they have in its model."""

    def add_box(self, number: int, box: RigidBox) -> None:
        """Add a box at rest; the state of all others is unchanged. ``ValueError`` if one has its number."""
        if number in self._boxes:
            raise ValueError(f"box {number} is here already")
        self._use_boxes(self._boxes | {number: box})

    def remove_box(self, number: int) -> None:
        """Remove a box; what lay in it or on it falls. ``ValueError`` if there is none of this number."""
        if number not in self._boxes:
            raise ValueError(f"no box {number} here")
        self._use_boxes({other: box for other, box in self._boxes.items() if other != number})

    def _use_boxes(self, boxes: dict[int, RigidBox]) -> None:
        static = static_world.build_static_world(self.model, self.parameters, boxes)
        with self._compile_lock:
            self._boxes = boxes
            self._static_spec = static
        self._recompile()
