"""Kernels that find the primitive in each pixel or ray: rasterisers for cameras, and the ray caster that verifies
them."""
