"""Replication of objects between clients: interest, authority, dead reckoning, retained state."""
