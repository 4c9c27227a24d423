"""A digest of all states of a client's run. Equal digests mean runs that are equal to the bit."""

from __future__ import annotations

import hashlib

from vinesim.client.client import Client


class StateDigest:
    """Digest of the joints of plants and rigid bodies. Call it after every step."""

    def __init__(self) -> None:
        self._digest = hashlib.blake2b(digest_size=16)

    def __call__(self, client: Client) -> None:
        physics = client.physics
        for array in (physics.state.joint_q, physics.state.joint_qd, physics.rigid.mj_data.qpos):
            self._digest.update(array.tobytes())

    def hexdigest(self) -> str:
        """Returns the digest of all states so far."""
        return self._digest.hexdigest()
