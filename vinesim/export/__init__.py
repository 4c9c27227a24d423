"""A vineyard for other simulators: MuJoCo's MJCF, OpenUSD with UsdPhysics, URDF; docs/export.md.

``joint_springs`` computes the hinges that replace ball joints, ``articulation`` the content of every format; ``mjcf``,
``urdf`` and ``usd`` write it, and ``vineyard_file`` chooses among them.
"""
