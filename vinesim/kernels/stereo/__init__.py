"""Kernels that compute a sensor's measurements from exact depth: stereo matching."""
