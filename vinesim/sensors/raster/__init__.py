"""Rasterisers, which find the visible primitive in each pixel of a camera, and lens distortion."""
