"""Kernels of lidars: which primitive each ray of a spinning head meets, and what comes back of a laser shot."""
