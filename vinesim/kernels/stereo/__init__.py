"""Kernels of stereo cameras: the depth that stereo matching would measure, computed from exact depth."""
