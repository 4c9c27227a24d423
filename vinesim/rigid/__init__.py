"""Rigid bodies in one MuJoCo world: static geoms, crates, robots, people, picked bunches.

``rigid_world`` is the world with its step, ``mujoco_world`` its compilation and kinematics. ``robot_body``,
``human_body`` (with ``hand_body``, ``human_posture``, ``human_shapes``) and ``free_bunch`` are what the world contains.
``recompile`` transfers the state when the world is compiled again. ``collision_geoms`` and ``hulls`` list the geoms
that plants collide with, ``effective_mass`` says how constrained rigid bodies respond.
"""
