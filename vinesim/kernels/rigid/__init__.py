"""Kernels of rigid bodies: posture of people, and the servos of robots."""
