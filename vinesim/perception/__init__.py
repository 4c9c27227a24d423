"""Measurements on pictures and scans, compared with the truth: point clouds, fusion, registration, bunches and berries.

    from vinesim.perception import measure_bunch, true_bunch

    frames = [camera.render(simulation, pose) for pose in poses]
    print(measure_bunch(frames, 3).volume, true_bunch(simulation, 3).volume)

Point clouds, fusion and registration need Open3D: ``pip install 'vinesim[perception]'``. It is loaded when it is first
needed.
"""

from __future__ import annotations

from vinesim.perception.bunches import BerryFit, BunchMeasurement, measure_bunch
from vinesim.perception.clouds import picture_cloud, scan_cloud
from vinesim.perception.fusion import FusedSurface, fuse
from vinesim.perception.open3d_library import Open3DMissing
from vinesim.perception.registration import Registration, register, relative_pose
from vinesim.perception.tour import TourError, open_tour
from vinesim.perception.truth import TrueBunch, true_bunch, true_volumes, wood_distance

__all__ = [
    "BerryFit",
    "BunchMeasurement",
    "FusedSurface",
    "Open3DMissing",
    "Registration",
    "TourError",
    "TrueBunch",
    "fuse",
    "measure_bunch",
    "open_tour",
    "picture_cloud",
    "register",
    "relative_pose",
    "scan_cloud",
    "true_bunch",
    "true_volumes",
    "wood_distance",
]
