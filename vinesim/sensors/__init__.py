"""Cameras, lidars and exact truth."""
