"""RGB-D and multispectral cameras: pictures, light and shadows, exposure, stereo depth."""
