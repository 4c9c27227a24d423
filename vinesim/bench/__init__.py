"""Benchmarks beside peers: ``vinesim bench``. Nothing here runs in the product."""
