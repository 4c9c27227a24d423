"""Wind on plants: ``plant_wind`` applies wind to simulated trees, ``sway`` computes the motion of all other trees,
``shelter`` computes the share of the wind that reaches each tree.
"""
