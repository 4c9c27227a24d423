"""Recorders, replay, and traces of what a client saw."""
