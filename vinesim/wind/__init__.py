"""Wind on plants: ``plant_wind`` blows on the trees that are simulated, ``sway`` says where wind holds and swings the
others, ``shelter`` how much of the wind reaches each tree.
"""
