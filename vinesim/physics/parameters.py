"""Parameters of the physics, as its packages and its users import them.

The value itself is defined in :mod:`vinesim.scene.physics_parameters`, since a scene file may override it.
"""

from __future__ import annotations

from vinesim.scene.physics_parameters import ParameterError, PhysicsParameters

__all__ = ["ParameterError", "PhysicsParameters"]
