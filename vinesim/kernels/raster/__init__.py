"""Which primitive each pixel or ray meets: rasterisers for cameras and lidars, and the ray caster they are held to."""
