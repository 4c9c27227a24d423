"""Tasks of a robot client and their planning, start poses, and handling of ROS commands and requests."""
