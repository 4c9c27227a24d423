"""Frequencies of small vibrations of vinesim's own model, by linearisation in double precision."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from vinesim.core import frames
from vinesim.scene.builder import GRAVITY
from vinesim.scene.model import Model

STEP = 1e-3


def model_frequencies(model: Model) -> np.ndarray:
    """Returns the frequencies [mode] Hz of a model without berry clusters, about its drawn shape, with all supports
    rigid. Potential energy: theta^T K theta / 2 of each joint, weight, and ties. The coordinates turn each body about
    its joint, in its own axes."""
    drawn = model.joint_settled.astype(float)
    bodies = len(drawn)
    mass = model.body_mass.astype(float)
    com = model.body_com.astype(float)
    count = 3 * bodies
    parent = model.body_parent

    def poses(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q = frames.multiply(drawn, frames.exp(x.reshape(bodies, 3)))
        world = model.forward_kinematics(q)
        return q, world

    def energy(x: np.ndarray) -> float:
        q, world = poses(x)
        theta = frames.log(q)
        spring = 0.5 * (model.joint_stiffness * theta * theta).sum()
        place = world[:, :3] + frames.rotate(world[:, 3:], com)
        weight = -(mass * (place @ GRAVITY)).sum()
        tied = world[model.tie_body]
        stretch = tied[:, :3] + frames.rotate(tied[:, 3:], model.tie_point.astype(float)) - model.tie_anchor
        return spring + weight + 0.5 * (model.tie_stiffness[:, None] * stretch * stretch).sum()

    e = STEP * np.eye(count)
    here = energy(np.zeros(count))
    one = np.array([[energy(s * e[i]) for s in (1, -1)] for i in range(count)])
    K = np.zeros((count, count))
    for i in range(count):
        K[i, i] = (one[i].sum() - 2 * here) / STEP**2
        for j in range(i):
            both = energy(e[i] + e[j]) + energy(-e[i] - e[j])
            K[i, j] = K[j, i] = (both - one[i].sum() - one[j].sum() + 2 * here) / (2 * STEP**2)
    _, world = poses(np.zeros(count))
    place = world[:, :3] + frames.rotate(world[:, 3:], com)
    M = np.zeros((count, count))
    for body in range(bodies):
        turn = np.zeros((3, count))
        joint = body
        move = np.zeros((3, count))
        while joint >= 0:
            axes = frames.to_matrix(world[joint, 3:])
            turn[:, 3 * joint : 3 * joint + 3] = axes
            move[:, 3 * joint : 3 * joint + 3] = np.cross(axes, place[body] - world[joint, :3], axis=0)
            joint = parent[joint]
        axes = frames.to_matrix(world[body, 3:])
        M += mass[body] * move.T @ move + turn.T @ (axes * model.body_inertia[body]) @ axes.T @ turn
    squares = scipy.linalg.eigh(K, M, eigvals_only=True)
    return np.sqrt(np.maximum(squares, 0.0)) / (2.0 * np.pi)
