"""Spinning lidars."""
