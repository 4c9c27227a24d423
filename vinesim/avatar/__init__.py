"""People that this client moves: a person and its haptic feedback, finger poses, estimated legs, a scripted person.

Their bodies in the physics are in ``vinesim.physics.rigid``; copies of other clients' people in
``vinesim.client.remote``.
"""
