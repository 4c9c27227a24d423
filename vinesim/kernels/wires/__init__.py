"""Kernels of wires and arms: how they couple their shoots, what presses on them, and where they are seen."""
