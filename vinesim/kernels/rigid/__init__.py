"""Kernels of rigid bodies: postures of people, and joint servos of robots."""
