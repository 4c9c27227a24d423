"""Simulated cameras and lidars, their schedule, exact ground truth, and data sets."""
