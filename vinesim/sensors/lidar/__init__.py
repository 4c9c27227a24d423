"""Spinning lidars: firings, rasterised rays, echoes and returns, scans of a moving world."""
