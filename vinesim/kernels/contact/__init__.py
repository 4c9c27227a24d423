"""Contacts of plants with rigid bodies and with each other: broadphase, narrowphase, islands, friction-cone solver.

The stages in their order, a module each: ``broadphase``, ``narrowphase_rigid`` and ``narrowphase_plants``, ``islands``,
``jacobians``, ``delassus``, ``projected_gauss_seidel`` with the steps of ``newton``, ``forces``. ``structs`` groups their
arrays, ``distance`` and ``motion`` hold the geometry.
"""
