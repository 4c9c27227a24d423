"""Threads that share a step of plants in contact change no bit of it."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.bench import scenes
from vinesim.contact import detection, impulse_solver
from vinesim.world import Physics


def states(threads: int, bars: int = 3, canes: int = 12) -> list[bytes]:
    """Joints, forces and warm starts of canes between combs after some steps."""
    physics = Physics(scenes.cane_row(canes), threads=threads)
    physics.add_robot(scenes.combs("combs", bars, canes))
    scenes.keep_awake(physics, np.arange(canes))
    found = []
    for tick in range(120):
        physics.rigid.command("combs", np.full(2, 0.005 * min(1.0, tick / 100)))
        physics.step()
        forces = np.array([contact.force for contact in physics.contacts]).tobytes()
        found.append(physics.state.joint_q.tobytes() + physics.rigid.mj_data.qpos.tobytes() + forces)
    assert len(physics.contacts) == bars * canes
    return found


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_change_no_bit_of_contacts(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = states(1)
    for sizes in (detection.TREES_PER_CHUNK, impulse_solver.ITEMS_PER_CHUNK):
        for work in sizes:
            monkeypatch.setitem(sizes, work, 1)  # even of so little each thread takes some
    assert states(threads) == alone
