"""What pages are shown: the primitives of the cameras once, then the poses of what has moved."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from vinesim.client.client import Client
from vinesim.client.spectator import Spectator, follow_view
from vinesim.physics.plants.sway import Sway
from vinesim.scene.values import Snapshot
from vinesim.sensors.scene import textures
from vinesim.sensors.scene.primitives import Primitives
from vinesim.sensors.scene.static_primitives import row_layout
from vinesim.sensors.scheduler import load_kernels
from vinesim.web import array_message
from vinesim.web.page_server import PageServer

GRASS = 25.0
"""Tufts a square metre: a browser draws fewer than the cameras."""
_TURN_STEPS = 32767
"""Steps of a component of a quaternion from 0 to 1."""


class PageWorld:
    """The world of one client as its pages see it. The client's loop writes it, the server's thread reads it.

    Nothing is laid out before the first page asks. A page knows the poses of all trees at rest. It is kept in which
    tick each tree has last moved; a page is sent the trees that have moved since the last state that was sent to it.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self._at_rest = client.physics.snapshot().body_q.copy()
        self._moved_at = np.full(len(client.model.tree_first), -1)
        """[tree] tick"""
        self._sway: Sway | None = None
        self._primitives: Primitives | None = None
        """None until a page asks."""
        self._lock = threading.Lock()
        self._snapshot: Snapshot | None = None
        self._rigid_version, self._rigid = 0, b""
        self._visuals: tuple[Any, ...] | None = None
        self.pose: list[float] | None = None
        """Where the newest page looks from [7] m, 1: x forward, z up; None while there is none."""

    # ------------------------------------------------------------------ in the client's loop

    def collect(self, server: PageServer) -> None:
        """After a step: note what has moved, take a snapshot if a page looks, and lead a spectator's eyes there."""
        physics = self._client.physics
        self._moved_at[physics.plants.awake] = physics.tick
        if self.pose is not None and isinstance(self._client, Spectator):
            self._client.pose = np.array(self.pose)
        if self._sway is None or not server.has_viewers:
            return
        snapshot = physics.snapshot()
        swayed = self._sway.apply(snapshot, np.flatnonzero(self._moved_at == physics.tick))
        self._moved_at[swayed.moved_trees] = physics.tick
        with self._lock:
            self._snapshot = swayed
        server.notify()

    # ------------------------------------------------------------------ in the server's thread

    def scene(self) -> bytes:
        """Everything that stands or grows, at rest; tables of leaves' outlines; light of the ground."""
        if self._primitives is None:
            load_kernels()
            self._sway = Sway(self._client.model)
            self._primitives = Primitives(self._client.model, grass=GRASS)
        primitives, scene = self._primitives, self._client.scene
        outline, hull = textures.leaf_outlines()
        ground = primitives.materials
        model = self._client.model
        sun = scene.sun.direction(0.0)
        return array_message.encode(
            {
                "scene": scene.name, "seed": scene.seed, "sun": list(sun), "rows": list(row_layout(model)),
                "bodies": len(model.body_mass), "dt": self._client.physics.dt,
                "ground": [float(ground.ground_x), float(ground.ground_y), float(ground.ground_cell)],
                "ground_columns": int(ground.ground_sky.shape[1]),
            },
            _columns(primitives, slice(0, primitives.plant_count))
            | _clusters(primitives, slice(0, len(primitives.cluster_first) - len(primitives.rigid_clusters)))
            | {
                "poses": self._at_rest.astype(np.float32), "outline": outline, "hull": hull,
                "ground_sky": ground.ground_sky.numpy(), "start": np.asarray(self._start_view(), np.float32),
            },
        )  # fmt: skip

    def rigid(self) -> bytes:
        """Robots, people, boxes and picked bunches that there are now."""
        return self._rigid

    def state(self, since: int) -> tuple[int, bytes] | None:
        """Bodies of the trees that have moved after the tick ``since``, all rigid bodies, and what was picked."""
        with self._lock:
            snapshot = self._snapshot
        if snapshot is None or self._primitives is None or snapshot.tick <= since:
            return None
        if snapshot.visuals is not self._visuals:
            self._lay_out_rigid(self._primitives, snapshot)
        body = self._bodies(np.flatnonzero(self._moved_at > since))
        pose, rigid = snapshot.body_q[body], np.asarray(snapshot.visual_q).reshape(-1, 7)
        state = array_message.encode(
            {"tick": snapshot.tick, "time": snapshot.time, "rigid": self._rigid_version},
            {
                "body": body.astype(np.uint32), "place": pose[:, :3].astype(np.float32), "turn": _turns(pose),
                "rigid_place": rigid[:, :3].astype(np.float32), "rigid_turn": _turns(rigid),
                "picked": np.flatnonzero(~snapshot.bunch_attached).astype(np.uint32),
            },
        )  # fmt: skip
        return snapshot.tick, state

    def _lay_out_rigid(self, primitives: Primitives, snapshot: Snapshot) -> None:
        primitives.update(snapshot)
        self._visuals, self._rigid_version = snapshot.visuals, self._rigid_version + 1
        rows = slice(primitives.plant_count, primitives.count)
        clusters = slice(len(primitives.cluster_first) - len(primitives.rigid_clusters), None)
        self._rigid = array_message.encode(
            {"version": self._rigid_version, "names": [visual.name for visual in snapshot.visuals]},
            _columns(primitives, rows) | _clusters(primitives, clusters, primitives.plant_count),
        )

    def view(self, pose: list[float]) -> None:
        """Take over where a page looks from."""
        self.pose = pose

    def _bodies(self, trees: np.ndarray) -> np.ndarray:
        """Bodies of some trees, one tree after the other."""
        model = self._client.model
        first, size = model.tree_first[trees], model.tree_size[trees]
        return np.repeat(first - (np.cumsum(size) - size), size) + np.arange(size.sum())

    def _start_view(self) -> np.ndarray:
        """Where the page looks from at first: a spectator's eyes, else over the shoulder of the client's own actor."""
        client = self._client
        if isinstance(client, Spectator):
            return client.pose
        if client.robots:
            return follow_view(client.physics.rigid.base_state(next(iter(client.robots)))[0])
        return follow_view(client.humans[client.name].pose.points[0])


def _turns(pose: np.ndarray) -> np.ndarray:
    """Quaternions of poses [k, 7] in steps, [k, 4] int16."""
    return np.round(pose[:, 3:] * _TURN_STEPS).astype(np.int16)


def _columns(primitives: Primitives, rows: slice) -> dict[str, np.ndarray]:
    """Values of primitives as a page needs them."""
    columns = primitives.local_columns(rows)
    shape = np.concatenate([columns[name] for name in "abcd"], 1).astype(np.float32)
    colour = np.round(255.0 * np.clip(columns["tint"], 0.0, 1.0) ** (1.0 / 2.2))
    light = np.round(255.0 * np.clip(columns["sky"], 0.0, 1.0))
    surface = np.column_stack([colour, light]).astype(np.uint8)
    return {
        "shape": shape, "surface": surface, "material": columns["material"].astype(np.uint8),
        "carrier": columns["carrier"].astype(np.uint32),
    }  # fmt: skip


def _clusters(primitives: Primitives, which: slice, row: int = 0) -> dict[str, np.ndarray]:
    """Clusters as a page needs them: runs of primitives, counted from ``row``, and balls around them in the world."""
    return {
        "first": (primitives.cluster_first[which] - row).astype(np.uint32),
        "size": primitives.cluster_size[which].astype(np.uint32),
        "kind": primitives.cluster_kind[which].astype(np.uint8),
        "bunch": primitives.cluster_bunch[which].astype(np.int32),
        "ball": primitives.ball.numpy()[which].astype(np.float32),
    }
