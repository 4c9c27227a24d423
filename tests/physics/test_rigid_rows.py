"""Rows of rigid bodies hold nothing of contacts that had their place before."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.bench import scenes
from vinesim.contact.impulse_solver import ImpulseSolver
from vinesim.world import Physics

CANES = 12


def states(physics: Physics) -> list[bytes]:
    """Of canes on a bar and in a gripper that comes, moves and goes: rows belong now to one body and now to another."""
    physics.add_robot(scenes.bar("bar", 0, CANES))
    scenes.keep_awake(physics, np.arange(CANES))
    found = []
    for tick in range(200):
        if tick == 60:
            physics.add_robot(scenes.gripper("hand", scenes.bunch_center(4)))
        if tick == 150:
            physics.remove_robot("hand")
        wave = 0.02 * np.sin(0.1 * tick)
        physics.rigid.command("bar", np.array([0.04 + wave]))
        if 60 <= tick < 150:
            grip = 0.05 * min(1.0, (tick - 60) / 30)
            physics.rigid.command("hand", np.array([wave, grip, grip]))
        physics.step()
        found.append(physics.state.joint_q.tobytes() + physics.rigid.mj_data.qpos.tobytes())
    return found


def test_rows_that_are_cleared_where_they_were_written_are_rows_of_zeros(monkeypatch: pytest.MonkeyPatch) -> None:
    """To the bit as with arrays that are cleared as a whole before every solve."""
    solve = ImpulseSolver.solve
    used = set()

    def solve_with_clear_rows(solver: ImpulseSolver, count: int) -> None:
        solver.rows.rigid_jacobian[:] = solver.rows.rigid_response[:] = 0.0
        solve(solver, count)
        used.update(solver._rigid_spans[:count, 0].tolist())

    usual = states(Physics(scenes.cane_row(CANES)))
    monkeypatch.setattr(ImpulseSolver, "solve", solve_with_clear_rows)
    assert states(Physics(scenes.cane_row(CANES))) == usual
    assert len(used) > 1
