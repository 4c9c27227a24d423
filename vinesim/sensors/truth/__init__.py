"""Exact ground truth of pictures."""
