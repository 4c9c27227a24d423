"""Scripted tasks: push a bunch, pick a bunch into a box, swap boxes."""
