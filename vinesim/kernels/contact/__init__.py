"""Contacts of plants with rigid bodies and with each other: broadphase, narrowphase, islands, friction-cone solver.

Each stage is a module. In their order: ``broadphase``, ``narrowphase_rigid`` and ``narrowphase_plants``, ``islands``,
``jacobians``, ``row_response``, ``delassus``, ``projected_gauss_seidel`` with the steps of ``newton`` on an
``island_system``, ``forces``. ``structs`` groups their arrays; ``distance`` and ``body_motion`` hold the geometry. The
kernels of batches of worlds (:mod:`vinesim.kernels.worlds`) do the same work. All solvers call ``friction_law``.
"""
