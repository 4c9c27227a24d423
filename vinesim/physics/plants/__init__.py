"""Plants: the articulated-body solver, sleep, level of detail, wind, detachment, faults, gradients."""
