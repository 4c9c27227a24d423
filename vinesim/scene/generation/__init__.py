"""Generates models from scene files: old wood, wires, shoots, leaves and bunches."""
