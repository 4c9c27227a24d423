"""Tools to look at a running ROS graph."""
