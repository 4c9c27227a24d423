"""Kernels of robot control: inverse kinematics."""
