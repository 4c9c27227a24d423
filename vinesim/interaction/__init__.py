"""Actions of actors on plants and objects: holding, picking, cutting and setting down.

``hand_grasp`` closes and opens people's hands. ``detachment`` detaches bunches and canes that are pulled, bent or cut.
``blades`` moves the edges of cutters through wood, by the laws of ``cutting_force``. ``fruit_damage`` records what
happens to bunches.
``dormant_bunches`` stores picked bunches that have no body in the physics while no actor is near. ``support_tracking``
determines the support on which an object rests.
"""
