"""Appearance of people, shears and crates: shapes read from ``data/figures``, in the frames of their links.

An appearance does not depend on the renderer. A part consists of a few round cones, ellipsoids, boxes, cylinders and
lofts (meshes through rings), each with a colour and a named surface. Collision shapes are separate, in the physics.
"""

from vinesim.scene.appearance.crates import crate_shapes
from vinesim.scene.appearance.human import (
    FINGERS,
    PHALANGES,
    HumanModel,
    Limbs,
    load_human_model,
    outfit_names,
    outfit_of,
)
from vinesim.scene.appearance.lofts import smooth_normals
from vinesim.scene.appearance.mesh_surfaces import read_surface, received_surface
from vinesim.scene.appearance.postures import apply_posture, posture_names
from vinesim.scene.appearance.shapes import SURFACES, AppearanceError
from vinesim.scene.appearance.shears import SHEARS_PARTS, ShearsModel, load_shears

__all__ = [
    "FINGERS",
    "PHALANGES",
    "SHEARS_PARTS",
    "SURFACES",
    "AppearanceError",
    "HumanModel",
    "Limbs",
    "ShearsModel",
    "apply_posture",
    "crate_shapes",
    "load_human_model",
    "load_shears",
    "outfit_names",
    "outfit_of",
    "posture_names",
    "read_surface",
    "received_surface",
    "smooth_normals",
]
