"""Composes scenes for pictures: places robots, people and crates in a vineyard."""
