"""Rigid bodies in one MuJoCo world: static geoms, crates, robots, people, picked bunches.

``rigid_world`` is the world with its step, ``mujoco_world`` its compilation and kinematics. ``robot_body``,
``human_body`` (with ``human_posture``) and ``free_bunch`` are the bodies in the world. ``recompile`` transfers the
state when the world is compiled again. ``collision_geoms`` lists the geoms that plants collide with, ``effective_mass``
computes the response of constrained rigid bodies to impulses.
"""
