"""People whom this client controls: pose sources, haptic feedback, shears, finger poses, estimated legs.

The bodies of people in the physics are in ``vinesim.rigid``, the copies of other clients' people in
``vinesim.client.remote``.
"""
