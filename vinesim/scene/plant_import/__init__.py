"""Imports plants from OpenAlea, Helios or a scanner as trees with wood."""
