"""Measurements that need a checkout of the project: load generators, emulated networks, long runs, killed programs.

``python -m benchmarks --help`` lists the measurements. ``vinesim bench`` has those that a user may want to repeat.
"""
