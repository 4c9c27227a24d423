"""Gradients of the differentiable rollout against central differences of the very same scheme, and what they are for."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from vinesim import frames
from vinesim.physics.plants import Plants
from vinesim.physics.rollout import Rollout, Track
from vinesim.world.grow import Tree, Wood, assemble
from vinesim.world.model import Model
from vinesim.world.state import State

MODULUS, BETA = 4e9, 0.03


def forked() -> Model:
    """A cane that forks in space, a bunch on one arm; at the origin, where single precision is finest."""
    wood = Wood(MODULUS, 800.0, BETA)
    tree = Tree(frames.pose(np.zeros(3)))
    stem = tree.rod(-1, 0.5, (0.004, 0.0035), wood, 6)
    arm = tree.rod(stem[-1], 0.3, (0.003, 0.002), wood, 4, rest=frames.exp(np.array([0.3, 0.0, 0.6])))
    tree.rod(stem[2], 0.3, (0.003, 0.002), wood, 4, rest=frames.exp(np.array([0.0, 0.7, -0.5])))
    tree.add(
        arm[-1], offset=(0.075, 0.0, 0.0), mass=0.1, com=(0.05, 0.01, 0.0), inertia=(2e-4, 3e-4, 3e-4), length=0.1,
        radius=(0.03, 0.03), stiffness=(0.05, 0.05, 0.05), damping=(0.002, 0.002, 0.002),
    )  # fmt: skip
    return assemble([tree])


def swinging(model: Model) -> np.ndarray:
    """Joint rates [body, 3] that set all of it in motion."""
    return np.random.default_rng(4).normal(size=(len(model.body_mass), 3)) * 0.5 + [0.0, 0.7, 0.7]


def squares(track: Track) -> tuple[float, np.ndarray, np.ndarray]:
    """A loss of poses and velocities of unlike weights, and its derivatives by both."""
    weight_q = np.array([3.0, 1.0, 2.0, 0.3, 0.2, 0.1, 0.0])
    weight_qd = np.array([0.1, 0.2, 0.05, 0.01, 0.0, 0.02])
    q, qd = track.body_q.astype(float), track.body_qd.astype(float)
    loss = 0.5 * (weight_q * q * q).sum() + 0.5 * (weight_qd * qd * qd).sum()
    return loss, weight_q * q, weight_qd * qd


def slope(loss, step: float) -> float:
    """d loss(1 + e) / de at 0 by central differences at two steps, extrapolated (Richardson)."""
    wide, narrow = ((loss(1.0 + e) - loss(1.0 - e)) / (2.0 * e) for e in (2.0 * step, step))
    return (4.0 * narrow - wide) / 3.0


@pytest.mark.parametrize("ticks", [50, 200])
@pytest.mark.parametrize("checkpoint", [50, 33])
def test_gradient_is_the_slope_of_the_loss(ticks: int, checkpoint: int) -> None:
    model = forked()
    rates = swinging(model)
    rollout = Rollout(model, ticks, watch=np.array([9, 13, 14]), checkpoint=checkpoint)
    gives = {
        "stiffness": model.joint_stiffness, "damping": model.joint_damping, "mass": model.body_mass, "joint_qd": rates,
    }  # fmt: skip
    _, *by = squares(rollout.run(joint_qd=rates))
    gradient = rollout.gradient(*by)
    for name, value in gives.items():

        def loss(scale: float, name: str = name, value: np.ndarray = value) -> float:
            return squares(rollout.run(**({"joint_qd": rates} | {name: scale * value})))[0]

        found = float((getattr(gradient, name) * value).sum())
        print(ticks, checkpoint, name, found, slope(loss, 0.02)/found-1, slope(loss, 0.01)/found-1, slope(loss, 0.04)/found-1)
