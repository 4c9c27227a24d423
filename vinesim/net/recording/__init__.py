"""Recordings of what crossed the network, as MCAP files."""
