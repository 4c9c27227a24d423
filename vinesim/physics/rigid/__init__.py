"""Rigid bodies in one MuJoCo world: static geoms, crates, robots, people, picked bunches.

Stages of a step: ``hand_grasp`` closes and opens hands, ``rigid_world`` predicts and integrates, ``hand_grasp`` places
hands on the plants that they hold. After a step ``support_tracking`` finds out which objects rest in which frame.

``rigid_world`` is the world with its step; ``world_core`` its compilation and kinematics; ``robot_access``,
``human_access`` and ``bunch_access`` what can be asked of robots, people and free bunches. ``robot_body``,
``human_body`` (with ``hand_body``, ``human_posture``, ``human_shapes``) and ``free_bunch`` are what the world contains;
``dormant_bunches`` are picked bunches without a body. ``recompile`` transfers the state when the world is compiled
anew.
"""
