"""Contact loads: wrenches that act on bodies of plants over one step, and the list of trees that have such loads."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from vinesim.core.warp_arrays import share
from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.kernels.plants import contact_loads as kernels

LEAST_ROOM = 64
"""Smallest capacity of the arrays [bodies]."""


class ContactLoads:
    """Sums for each body the wrenches that act on it in a step."""

    def __init__(
        self,
        *,
        body_tree: np.ndarray,
        place_in_tree: np.ndarray,
        is_stepped: np.ndarray,
        tree_moving: np.ndarray,
        body_wrench: np.ndarray,
        touched: np.ndarray,
        touched_count: np.ndarray,
        euler_steps: np.ndarray,
        onset: int,
        then: Sequence[KernelLaunch],
    ) -> None:
        """Args:
        body_tree: [body] tree of each body.
        place_in_tree: [body] index of each body within its tree.
        is_stepped: [tree] whether the tree was in the last prediction.
        tree_moving: [tree] number of bodies of the tree that move.
        body_wrench: [body, 6] N, N m where the sums are written; zero for bodies that are not loaded.
        touched: [tree] list of the touched trees.
        touched_count: [1] number of entries of ``touched``.
        euler_steps: [tree] number of next steps with backward Euler (phi = 1); at least ``onset`` where contact begins.
        onset: number of steps with backward Euler (phi = 1) at the beginning of a contact.
        then: launches that follow the sum; they apply the summed wrenches to the touched trees.
        """
        self._then = then
        self._touched_count = touched_count
        self._touched = touched
        self._body_tree = body_tree
        self._place_in_tree = place_in_tree
        self._is_stepped = is_stepped
        self._tree_moving = tree_moving
        self._numbers = np.zeros(kernels.NUMBERS, np.int64)
        self._numbers[kernels.ONSET_STEPS] = onset
        last_contact = np.full(len(touched), -2, np.int64)  # step of the last contact
        self._given = [
            share(body_tree, wp.int32),
            share(place_in_tree, wp.int32),
            share(is_stepped, wp.bool),
            share(tree_moving, wp.int32),
        ]
        self._results = [
            share(body_wrench, wp.spatial_vector),
            share(touched, wp.int32),
            share(self._touched_count, wp.int32),
            share(last_contact, wp.int64),
            share(euler_steps, wp.int32),
        ]
        self._loaded = self._body = np.zeros(0, np.int32)  # the first contact makes room and loads the kernel

    def _make_room(self, bodies: int) -> None:
        loaded = self._loaded
        self._loaded = np.zeros(bodies, np.int32)
        self._loaded[: len(loaded)] = loaded
        self._body = np.zeros(bodies, np.int32)
        self._wrench = np.zeros((bodies, 6), np.float32)
        load = KernelLaunch(
            kernels.load_bodies,
            [*self._given, share(self._body, wp.int32), share(self._wrench, wp.spatial_vector)],
            [share(self._numbers, wp.int64), share(self._loaded, wp.int32), *self._results],
            threads=1,
        )
        self._load = KernelGraph(load, *self._then)

    def __len__(self) -> int:
        """Returns the number of wrenches of the present step. A body with several wrenches counts several times."""
        return int(self._numbers[kernels.LOADED])

    def replace(self, bodies: np.ndarray, wrenches: np.ndarray, tick: int) -> np.ndarray:
        """Replace the wrenches of the last call by ``wrenches`` [k, 6] on ``bodies`` [k] in step ``tick``, and apply
        them.

        A body may occur several times. Returns the trees [j] of the bodies, as a view that the next call overwrites. If
        a body was not in the last prediction, raises :class:`ValueError` and changes nothing.
        """
        count = len(bodies)
        if count > len(self._body):
            self._make_room(max(2 * count, LEAST_ROOM))
        self._body[:count] = bodies
        self._wrench[:count] = wrenches
        self._numbers[kernels.GIVEN], self._numbers[kernels.TICK] = count, tick
        self._load(count)
        if self._numbers[kernels.REFUSED]:
            self.require_stepped(bodies)
        return self._touched[: self._touched_count[0]]

    def require_stepped(self, bodies: np.ndarray) -> None:
        """Raises :class:`ValueError` unless all ``bodies`` [k] can move and their trees were in the last prediction."""
        trees = self._body_tree[bodies]
        if not (is_stepped := self._is_stepped[trees]).all():
            late = int(np.argmin(is_stepped))
            raise ValueError(f"body {bodies[late]} is touched, but tree {trees[late]} slept: wake it before predict()")
        if not (moves := self._place_in_tree[bodies] < self._tree_moving[trees]).all():
            late = int(np.argmin(moves))
            raise ValueError(
                f"body {bodies[late]} is touched, but tree {trees[late]} is coarse and the body rides on its bunch: "
                "touch the bunch, or refine the tree before predict()"
            )
