"""Fit a simulated cane or bunch to a measured one: stiffness, damping, mass and rest shape with their uncertainty.

    from vinesim.tune import load_specimen, read_trajectory, tune

    fit = tune(load_specimen("cane.toml"), read_trajectory("pull.csv"))
    print("\\n".join(fit.lines()))
    fit.write_plant("fitted.toml")

docs/tuning.md has examples. This package needs scipy: ``pip install 'vinesim[tune]'``.
"""

from __future__ import annotations

from vinesim.scene.plant_parameters import Specimen, load_specimen
from vinesim.tune.bunch_track import track_bunch
from vinesim.tune.cane_track import track_cane
from vinesim.tune.experiment import Experiment, hidden_specimen, measure
from vinesim.tune.features import Features, extract_features
from vinesim.tune.fit import Fit
from vinesim.tune.marker_track import track_marker
from vinesim.tune.point_cloud import with_cloud
from vinesim.tune.specimen import with_values
from vinesim.tune.trajectory import Trajectory, TrajectoryError, read_trajectory
from vinesim.tune.tuning import tune

__all__ = [
    "Experiment",
    "Features",
    "Fit",
    "Specimen",
    "Trajectory",
    "TrajectoryError",
    "extract_features",
    "hidden_specimen",
    "load_specimen",
    "measure",
    "read_trajectory",
    "track_bunch",
    "track_cane",
    "track_marker",
    "tune",
    "with_cloud",
    "with_values",
]
