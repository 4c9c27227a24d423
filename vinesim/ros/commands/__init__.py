"""Subscribed topics: commands to the robot as plain values."""
