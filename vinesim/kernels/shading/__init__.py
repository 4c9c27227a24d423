"""Colour of visible surfaces: materials, light, shadows, exposure."""
