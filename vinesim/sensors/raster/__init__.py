"""Rasterisers: which primitive each pixel of a camera sees."""
