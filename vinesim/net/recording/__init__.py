"""Recordings of network messages as MCAP files."""
