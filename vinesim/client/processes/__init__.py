"""The process that renders a robot's sensors and runs its ROS node."""
