"""Kernels of batches of worlds (:mod:`vinesim.worlds`): contacts of trees with robots and boxes, one system a world.

``narrowphase`` finds the contacts, ``contact_step`` writes their rows and applies their impulses, ``delassus`` writes
the system of a world, ``dense_solver`` and ``row_solver`` solve it, ``rigid_state`` exchanges numbers with mujoco_warp,
``views`` selects the entries of one world. ``cutting`` closes blades, ``free_bunches`` moves what they cut off to rigid
bodies, ``drives`` moves robots, ``reset`` returns worlds to their first states, ``pictures`` draws all worlds. The
contact law and the shapes are those of :mod:`vinesim.kernels.contact`.
"""
