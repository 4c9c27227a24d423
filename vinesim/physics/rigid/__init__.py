"""Rigid bodies in MuJoCo: static world, robots, people, boxes and picked bunches."""
