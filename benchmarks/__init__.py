"""Measurements that need a checkout: load generators, emulated networks, long runs, programs that are killed.

``python -m benchmarks --help`` lists them; ``vinesim bench`` has those that a user may want to repeat.
"""
