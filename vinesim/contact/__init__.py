"""Contacts of plants: detection, and one solve shared by plants and rigid bodies.

Stages of a step, all called by ``contact_solver``: broadphase and narrowphase (``detection``), islands and impulses
(``impulse_solver``). ``plant_capsules`` lists the collision shapes of plants; ``collision_arrays`` holds what the
kernels read.
"""
