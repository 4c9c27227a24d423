"""Scripted tasks of a robot: push a bunch, pick a bunch into a box, swap boxes, bring a box to a person."""
