"""What a sensor measures of exact depth: stereo matching, lidar echoes."""
