"""The vineyard, its actors and objects as analytic primitives for cameras and lidars, and a ray caster."""
