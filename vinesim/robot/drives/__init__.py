"""Robots in the world: joint servos, base, grippers, cutters, odometry, body sensors; and copies of other clients'
robots."""
