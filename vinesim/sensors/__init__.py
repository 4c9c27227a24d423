"""Cameras, lidars and exact ground truth."""
