"""Kernels of lidars: the nearest primitive along each ray of a spinning head, and the echoes of a laser shot."""
