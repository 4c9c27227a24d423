"""RGB-D cameras: rasterisers, light, exposure, stereo depth, point clouds."""
