"""Contacts: detection and the shared solve of plants and rigid bodies."""
