"""People that this client moves: a person, its haptic feedback and shears, finger poses, estimated legs, a script.

Their bodies in the physics are in ``vinesim.rigid``; copies of other clients' people in
``vinesim.client.remote``.
"""
