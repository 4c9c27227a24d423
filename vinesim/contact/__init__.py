"""Contacts of plants: their detection, and one solver that plants and rigid bodies share.

Stages of a step, all called by ``contact_solver``: broadphase and narrowphase (``detection``), islands and impulses
(``impulse_solver``). ``plant_capsules`` lists the collision shapes of plants; ``collision_arrays`` holds the arrays
that the kernels read.
"""
