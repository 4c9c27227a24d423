"""What actors do to plants and objects: hold, pick, cut, and set down.

``hand_grasp`` closes and opens people's hands; ``detachment`` takes off what is pulled, bent or cut;
``dormant_bunches`` are picked bunches that have no body while no actor is near; ``support_tracking`` finds out in which
frame an object rests.
"""
