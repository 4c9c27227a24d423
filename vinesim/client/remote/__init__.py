"""Actors and objects of other clients in this client's world."""
