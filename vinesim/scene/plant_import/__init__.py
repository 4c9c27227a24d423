"""Imports plants from files of OpenAlea, Helios or a scanner, as trees of bodies with properties of wood."""
