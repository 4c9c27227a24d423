"""Subscriptions: commands of ROS peers as plain values."""
