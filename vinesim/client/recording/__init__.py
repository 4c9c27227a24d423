"""Recorder and replay of a world, and traces of single bunches."""
