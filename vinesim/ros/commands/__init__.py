"""Command topics and actions of a robot: their messages are converted to plain values."""
