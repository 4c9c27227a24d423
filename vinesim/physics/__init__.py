"""Physics: plants in Warp, rigid bodies in MuJoCo, and one contact solve for both.

``step`` holds the world and its ordered list of stages; ``plants`` the articulated-body solver and what happens to
plants;
``contact`` the contacts between plants and rigid bodies; ``rigid`` the MuJoCo world; ``parameters`` all numbers.
"""
