"""Wind on plants: ``plant_wind`` applies wind to simulated trees, ``sway`` computes the motion of the other trees,
``shelter`` how much of the wind reaches each tree.
"""
