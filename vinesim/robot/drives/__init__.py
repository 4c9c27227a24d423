"""Robots in the world: joint servos, base, gripper, cutters, odometry, body sensors; copies of other clients'
robots."""
