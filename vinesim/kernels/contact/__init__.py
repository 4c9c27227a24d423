"""Contacts of plants with rigid bodies and with each other: narrowphase, islands, friction-cone solver."""
