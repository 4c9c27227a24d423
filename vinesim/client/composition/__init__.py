"""Scenes composed for pictures: robots, people and crates placed in a vineyard."""
