"""Tasks of a robot client, their planning, start poses, and the handler of ROS commands."""
