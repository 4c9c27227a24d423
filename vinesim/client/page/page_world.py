"""The world as the server sends it to pages, which are the browser tabs that show a client.

A page first receives the shapes of everything (the primitives that cameras render), then the poses of moved bodies.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any, Protocol

import msgspec
import numpy as np

from vinesim.avatar.gestures import OPEN_HAND
from vinesim.avatar.tracked_human import TrackedHuman, TrackedPoints
from vinesim.client.client import Client
from vinesim.client.page.first_view import first_view
from vinesim.client.remote.remote_human import RemoteHuman
from vinesim.client.spectator import Spectator
from vinesim.core import frames
from vinesim.kernels.shading import materials
from vinesim.rigid.human_posture import SIDES
from vinesim.scene.appearance import load_human_model, load_shears
from vinesim.scene.ids import Organ, object_name
from vinesim.scene.model import Model
from vinesim.scene.palette import Palette
from vinesim.scene.terrain import Terrain
from vinesim.scene.values import INTENTIONS, CameraMount, Contact, Haptic, RigidVisual, SegmentPoses, Snapshot
from vinesim.sensors.camera.exposure import usual_exposure
from vinesim.sensors.camera.sunlight import OutdoorLight
from vinesim.sensors.primitives import textures
from vinesim.sensors.primitives.palette_colours import shared_colours
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.sensors.primitives.static_primitives import row_layout
from vinesim.sensors.sensor import load_kernels
from vinesim.web import array_message
from vinesim.web.page_input import PageInput, ReplayCommand, TrackedPerson
from vinesim.web.page_server import PageServer
from vinesim.wind.sway import Sway
from vinesim.wires.wire_segments import wire_segments

GRASS = 25.0
"""Grass tufts for each square metre; a browser draws fewer than the cameras."""
MAX_PRIMITIVES = 400_000
"""Largest number of primitives of plants and ground in a page at a time: 32 MB."""
LOADED = {int(materials.STEM): 0.4, int(materials.GRASS): 0.5, int(materials.BERRY): 1.0}
"""Distance up to which a page loads primitives of a material, relative to the distance for berries: about the distance
up to which the page draws them. GUESSED."""
ELSE_LOADED = 2.0
"""Distance up to which a page loads leaves and wood, relative to the distance for berries. GUESSED."""
AMONG_VINES = 1.08
"""Ratio of a page's exposure to the usual daylight exposure. Automatic exposure of cameras among vines yields 1.06 to
1.12 in the pictures of docs/web.md."""
MAX_SENTENCES = 4
"""Largest number of texts about recent closings of the person's shears, or about recent work, in one state for a page.
Enough for both hands between two states."""
BLADE_STEPS = 5
"""Number of steps between two reports of the wood that is between the blades of shears."""
_TURN_STEPS = 32767
"""Integer that encodes 1 in a component of a quaternion."""


class Replay(Protocol):
    """Interface of a recording that is played for pages."""

    def status(self) -> dict[str, float | bool]:
        """Status that pages receive with every state."""
        ...

    def take(self, command: ReplayCommand) -> None:
        """Execute a command of a page: play, pause or seek. Called in the server's thread."""
        ...


class PageWorld:
    """The world of one client as its pages (browser tabs) receive it.

    The client's loop writes it, and the server's thread reads it.

    The primitives (shapes) are built when the first page requests them. A page starts with the poses that the plants
    had when this object was made. This object stores the tick in which each tree last moved. A state for a page
    contains the trees that have moved since the last state for that page.
    """

    def __init__(
        self,
        client: Client,
        person: TrackedHuman | None = None,
        most: int = MAX_PRIMITIVES,
        replay: Replay | None = None,
    ) -> None:
        """Make the world of a client for its pages.

        Args:
            client: the client.
            person: source of the client's own human, whom the first page controls.
            most: largest number of primitives of plants and ground in a page; the nearest to its viewpoint are sent.
            replay: the recording that the client plays, if any.
        """
        self._client = client
        self._person = person
        self._most = most
        self._replay = replay
        self._ticks_before = 0
        """Sum of the ticks of earlier clients, so that ticks of states always increase; see :meth:`show`."""
        self._at_rest = client.physics.snapshot().body_q.copy()
        self._moved_at = np.full(len(client.model.tree_first), -1)
        """Tick in which each tree last moved [tree]."""
        self._wires = wire_segments(client.model)
        """Segments of wires. Pages treat them as bodies, numbered after the plant bodies."""
        self._wire_q, self._wire_moved_at = self._wires.rest_q.astype(np.float32), np.full(len(self._wires), -1)
        """Last pose of each segment of a wire [segment, 7] m, 1, and the tick in which the segment last moved
        [segment]."""
        self._wires_away = self._wires.piece[:0].astype(int)
        """Indices [k] of the segments of wires that were displaced in the last step."""
        self._sway: Sway | None = None
        self._primitives: Primitives | None = None
        """Primitives of the world; None until a page requests them."""
        self._layout_lock = threading.Lock()
        """Held while primitives are read for a page, and while they follow rigid bodies that came or went."""
        self._lock = threading.Lock()
        self._snapshot: tuple[int, Snapshot] | None = None
        self._rigid_version = 0
        self._rigid = b""
        self._lamps: dict[str, np.ndarray] = {}
        """Changed indicator lights, for the state of pages: index of each changed primitive among the primitives of
        rigid bodies, and its present surface and material."""
        self._laid_out: dict[str, np.ndarray] = {}
        """Columns of the primitives of rigid bodies, with the values that pages load before lights change."""
        self._has_shone = np.zeros(0, bool)
        """[primitive of a rigid body] Whether colour or material of the primitive have differed from ``_laid_out``
        since pages loaded the primitives. Only indicator lights change these. Every state for a page contains the
        present colours of the primitives marked here, so that the page also shows when a light goes out."""
        self._visuals: tuple[Any, ...] | None = None
        self._stumps = np.zeros((0, 3))
        self._leaf_off = np.zeros(0, bool)
        client.after_reset.append(self._follow_reset)
        self._driver: int | None = None
        """The page that controls the spectator's eyes or the person: the first page that sends a message, with a person
        if there is one."""
        self._eyes: np.ndarray | None = None
        self._intention = ""
        self._overlay_pages: set[int] = set()
        """Pages that show contacts and owners."""
        self._contacts: tuple[Contact, ...] = ()
        self._hands: dict[str, np.ndarray] = {}
        """Poses [2, 7] of the person's left and right hand: the simulated palms, and the controllers that they
        followed."""
        self._held = ["", ""]
        """What the person's left and right hand hold, as text such as "the bunch"; "" for nothing."""
        self._haptics: dict[str, Haptic] = {}
        """Strongest vibration of each hand since the last state."""
        self._shears: dict[str, Any] = {"closures": 0, "said": [], "between": ["", ""]}
        """Number of closings of the person's shears, their last results, and what is between the open blades of both
        hands. The dictionary is replaced, never changed."""
        self._wishes: list[str] = []
        """Work on plants that pages have asked for, and that is not done yet."""
        self._newest_wish: tuple[int, int] | None = None
        """Page and number of the last wish in ``_wishes``."""
        self._work: dict[str, Any] = {"count": 0, "said": []}
        """Number of wishes that were answered, and the last answers. The dictionary is replaced, never changed."""

    # ------------------------------------------------------------------ in the client's loop

    def show(self, client: Client) -> None:
        """Replace the shown client by another client of the same vineyard. Pages receive all trees again that had
        moved."""
        with self._lock:
            self._ticks_before += self._client.physics.tick + 1
            self._client = client
            self._snapshot = None
            self._moved_at[self._moved_at >= 0] = self._tick
            self._wire_moved_at[self._wire_moved_at >= 0] = self._tick
        client.after_reset.append(self._follow_reset)
        self._visuals = None
        if self._sway is not None:
            self._sway = Sway(client.model)

    @property
    def _tick(self) -> int:
        """Tick of the newest state for pages."""
        return self._client.physics.tick + self._ticks_before

    def collect(self, server: PageServer, *, again: bool = False) -> None:
        """Record the results of a step for pages: what has moved, and a snapshot if a page is connected. Also applies
        what pages have requested: the eyes of a spectator, the intention of a person, and the person's work on plants.

        ``again``: whether pages must receive a new state although there was no step.
        """
        physics = self._client.physics
        self._ticks_before += again
        self._moved_at[physics.plants.awake] = self._tick
        if self._eyes is not None and isinstance(self._client, Spectator):
            self._client.pose = self._eyes
        if self._person is not None:
            human = self._client.humans[self._client.name]
            if human.intention != self._intention:
                human.indicate(self._intention)
            while self._wishes:
                said = [*self._work["said"], human.work(self._wishes.pop(0))]
                self._work = {"count": self._work["count"] + 1, "said": said[-MAX_SENTENCES:]}
            for haptic in human.haptics:
                if (before := self._haptics.get(haptic.hand)) is None or before.amplitude < haptic.amplitude:
                    self._haptics[haptic.hand] = haptic
            if human.closures:
                said = [*self._shears["said"], *(closure.sentence for closure in human.closures)]
                closures = self._shears["closures"] + len(human.closures)
                self._shears = {**self._shears, "closures": closures, "said": said[-MAX_SENTENCES:]}
        if self._sway is None or not server.has_viewers:
            return
        self._contacts = physics.contacts if self._overlay_pages else ()
        snapshot = physics.snapshot()
        swayed = self._sway.apply(snapshot, np.flatnonzero(self._moved_at == self._tick))
        self._moved_at[swayed.moved_trees] = self._tick
        self._follow_wires(snapshot.wires)
        if self._person is not None:
            hands = [physics.hand(self._client.name, side) for side in SIDES]
            self._hands = {
                "hand_proxy": np.array([hand.pose for hand in hands], np.float32),
                "hand_controller": np.array([hand.controller for hand in hands], np.float32),
            }
            self._held = [_held_thing(hand.held, self._client.model) for hand in hands]
            if physics.tick % BLADE_STEPS == 0:
                between = self._client.humans[self._client.name].between_blades()
                self._shears = {**self._shears, "between": list(between)}
        with self._lock:
            self._snapshot = self._tick, swayed
        server.notify()

    def _follow_wires(self, wires: SegmentPoses) -> None:
        """Record which segments of wires have moved in the last step. ``wires``: poses of the displaced segments."""
        which = np.union1d(self._wires_away, wires.segment).astype(int)
        now = self._wires.poses(which, wires)
        moved = which[(now != self._wire_q[which]).any(1)]
        self._wire_q[which] = now
        self._wire_moved_at[moved] = self._tick
        self._wires_away = wires.segment

    def _follow_reset(self) -> None:
        """Mark all trees that had moved as moved again, so that pages receive their poses after a reset."""
        self._moved_at[self._moved_at >= 0] = self._tick + 1
        self._wire_moved_at[self._wire_moved_at >= 0] = self._tick + 1
        if self._sway is not None:
            self._sway = Sway(self._client.model)

    # ------------------------------------------------------------------ in the server's thread for layouts

    def scene(self) -> bytes:
        """Returns the message with which a page starts: everything that does not change while the page is open.

        It contains the settings of the page, the primitives of plants and ground near the first viewpoint, the initial
        poses of all bodies, the textures, the daylight, and how much of the sky is visible from each part of the
        ground. For a person's page it also contains the objects that the person can reach for.
        """
        primitives = self._lay_out()
        scene = self._client.scene
        outline, hull = textures.leaf_outlines()
        outline = np.round(_halved(outline[..., None])[..., 0]).astype(np.int8)
        leaf = _halved(textures.leaf_texture())
        leaf = leaf * [1.0, 0.5, 0.5, 1.0] + [0.0, 0.5, 0.5, 0.0]  # slopes are signed numbers
        ground = primitives.materials
        model = self._client.model
        sun = scene.sun.direction(0.0)
        grid, nodes = _terrain_grid(model.terrain)
        start = self._start_view()
        with self._layout_lock:
            reach, plants = _nearest(primitives, start[:3], self._most)
        return array_message.encode(
            {
                "scene": scene.name,
                "seed": scene.seed,
                "sun": list(sun),
                "light": _light(sun[2], model.look.palette),
                "palette": shared_colours(model.look.palette) | msgspec.structs.asdict(model.look.palette.sky),
                "rows": list(row_layout(model)),
                "room": min(primitives.plant_count, self._most),
                "reach": reach,
                "bodies": len(model.body_mass) + len(self._wires),
                "dt": self._client.physics.dt,
                "interest": self._client.replicator.interest_radius,
                "ground": [float(ground.ground_x), float(ground.ground_y), float(ground.ground_cell)],
                "ground_columns": int(ground.ground_sky.shape[1]),
                "terrain": grid,
                "person": None if self._person is None else self._client.name,
                "is_controlled": self._person is not None and self._driver is not None,
                "mouth": None if self._person is None else load_shears().mouth[:3].tolist(),
                "limbs": None if self._person is None else self._limbs(),
                "replay": None if self._replay is None else self._replay.status(),
                "intentions": [] if self._person is None else list(INTENTIONS[1:]),
                "gestures": {} if self._person is None else dict(self._person.gestures.poses),
                "buttons": {} if self._person is None else dict(self._person.gestures.buttons),
            },
            plants
            | {
                "tree_first": model.tree_first.astype(np.uint32),
                "poses": np.concatenate([self._at_rest, self._wires.rest_q]).astype(np.float32),
                "outline": outline,
                "hull": hull,
                "noise": _bytes(textures.noise_texture()),
                "leaf": _bytes(leaf),
                "ground_sky": ground.ground_sky.numpy(),
                "terrain": nodes,
                "start": np.asarray(start, np.float32),
            }
            | ({} if self._person is None else _within_reach(model)),
        )

    def _limbs(self) -> dict[str, Any]:
        """Returns joints and lengths of the person's limbs [m], as :class:`vinesim.scene.appearance.human.Limbs`."""
        return msgspec.to_builtins(load_human_model(self._client.humans[self._client.name].height).limbs)

    def plants(self, place: np.ndarray) -> bytes:
        """Returns a message with the primitives of plants and ground around ``place`` [3] m.

        A page requests it in a vineyard that is too large to be loaded as a whole.
        """
        primitives = self._lay_out()
        with self._layout_lock:
            reach, plants = _nearest(primitives, place, self._most)
        return array_message.encode({"reach": reach, "place": place.tolist()}, plants)

    def _lay_out(self) -> Primitives:
        """Returns the primitives of the vineyard, and builds them at the first call."""
        if self._primitives is None:
            load_kernels(CameraMount.kind)
            self._sway = Sway(self._client.model)
            self._primitives = Primitives(self._client.model, grass=GRASS)
        return self._primitives

    # ------------------------------------------------------------------ in the server's thread

    def rigid(self) -> bytes:
        """Returns a message with the shapes of the present robots, people, boxes and picked bunches."""
        return self._rigid

    def state(self, since: int, page: int = -1) -> tuple[int, bytes] | None:
        """Returns the newest state as a message, with its tick before it; None if the state is not newer than tick
        ``since``, or if rigid bodies came or went while primitives are read for a page; the next state then has them.

        The message contains the poses of the bodies of trees that moved after tick ``since``, the poses of all rigid
        bodies, and which bunches are picked. For a person it also says which page controls the person: ``page``, which
        receives the state ("this"), another one ("other"), or none ("").
        """
        with self._lock:
            newest = self._snapshot
        if newest is None or self._primitives is None or newest[0] <= since:
            return None
        tick, snapshot = newest
        if snapshot.visuals is not self._visuals or self._is_cut(snapshot):
            if not self._layout_lock.acquire(blocking=False):
                return None
            try:
                self._follow_visuals(self._primitives, snapshot)
            finally:
                self._layout_lock.release()
        body = self._bodies(np.flatnonzero(self._moved_at > since))
        wire = np.flatnonzero(self._wire_moved_at > since)
        pose = np.concatenate([snapshot.body_q[body], self._wires.poses(wire, snapshot.wires)])
        body = np.concatenate([body, len(self._client.model.body_mass) + wire])
        rigid = np.asarray(snapshot.visual_q).reshape(-1, 7)
        haptics = self._haptics
        self._haptics = {}
        shown: dict[str, Any] = {"owners": owners(self._client)} if self._overlay_pages else {}
        if self._replay is not None:
            shown["replay"] = self._replay.status()
        if self._person is not None:
            shown["shears"] = self._shears
            shown["work"] = self._work
            shown["held"] = self._held
            driver = self._driver
            shown["control"] = "" if driver is None else "this" if driver == page else "other"
        state = array_message.encode(
            {
                **shown,
                "pace": self._client.pace_text(),
                "tick": tick,
                "time": snapshot.time,
                "rigid": self._rigid_version,
                "haptics": {hand: [one.amplitude, one.duration] for hand, one in haptics.items()},
            },
            {
                "body": body.astype(np.uint32),
                "place": pose[:, :3].astype(np.float32),
                "turn": _turns(pose),
                "rigid_place": rigid[:, :3].astype(np.float32),
                "rigid_turn": _turns(rigid),
                "picked": np.flatnonzero(~snapshot.bunch_attached).astype(np.uint32),
                **self._lamps,
                **self._hands,
                **contact_arrays(self._contacts),
            },
        )
        return tick, state

    def _follow_visuals(self, primitives: Primitives, snapshot: Snapshot) -> None:
        """Encode for pages the shapes of the rigid bodies (robots, people, boxes, picked bunches) of a snapshot.

        If only colours of indicator lights differ from the previous shapes, the changed colours become part of every
        state. Otherwise a new message for :meth:`rigid` is encoded, which pages load again. ``primitives`` are posed to
        the ``snapshot``.
        """
        primitives.update(snapshot)
        before = self._visuals
        self._visuals = snapshot.visuals
        rows = slice(primitives.plant_count, primitives.count)
        columns = _columns(primitives, rows)
        is_cut = self._is_cut(snapshot)
        self._stumps = snapshot.stumps
        self._leaf_off = snapshot.leaf_off
        if before is None or is_cut or not _differ_in_lights_only(before, snapshot.visuals):
            self._lay_out_rigid(primitives, snapshot, rows)
            self._laid_out = columns
            self._has_shone = np.zeros(len(columns["material"]), bool)
        self._has_shone |= (columns["surface"] != self._laid_out["surface"]).any(1)
        self._has_shone |= columns["material"] != self._laid_out["material"]
        lamps = np.flatnonzero(self._has_shone)
        self._lamps = {
            "lamp": lamps.astype(np.uint32),
            "lamp_surface": columns["surface"][lamps],
            "lamp_material": columns["material"][lamps],
        }

    def _is_cut(self, snapshot: Snapshot) -> bool:
        """Returns whether canes were cut or leaves taken off since the shapes were encoded."""
        has_shed = snapshot.leaf_off is not self._leaf_off and not np.array_equal(snapshot.leaf_off, self._leaf_off)
        return has_shed or not np.array_equal(snapshot.stumps, self._stumps)

    def _lay_out_rigid(self, primitives: Primitives, snapshot: Snapshot, rows: slice) -> None:
        self._rigid_version += 1
        clusters = slice(len(primitives.cluster_first) - len(primitives.rigid_clusters), None)
        keys = np.array(primitives.stump_keys, np.float32).reshape(-1, 5)
        stumps = _columns(primitives, keys[:, 0].astype(np.int64))
        self._rigid = array_message.encode(
            {"version": self._rigid_version, "names": [visual.name for visual in snapshot.visuals]},
            _columns(primitives, rows)
            | _clusters(primitives, clusters, primitives.plant_count)
            | {f"stump_{name}": values for name, values in stumps.items()}
            | {"stump_key": keys[:, 1:]},
        )

    def take(self, page: int, said: PageInput) -> None:
        """Apply a message from a page: its overlays and replay command, and its viewpoint and person if this page
        controls the actor. ``page``: number of the page."""
        (self._overlay_pages.add if said.overlays else self._overlay_pages.discard)(page)
        if said.replay is not None and self._replay is not None:
            self._replay.take(said.replay)
        if self._driver is None and (self._person is None or said.person is not None):
            self._driver = page
        if page != self._driver:
            return
        self._eyes = np.array(said.view)
        if self._person is not None and said.person is not None:
            self._person.take(_tracked(said.person))
            if said.person.intention in INTENTIONS:
                self._intention = said.person.intention
            work = said.person.work
            if work is not None and self._newest_wish != (page, work.number):
                self._newest_wish = page, work.number
                if len(self._wishes) < MAX_SENTENCES:
                    self._wishes.append(work.what)

    def leave(self, page: int) -> None:
        """Forget a page that has disconnected. If it controlled the eyes, another page does so now. If it controlled
        the person, the person stands still until a page is opened or loaded again."""
        self._overlay_pages.discard(page)
        if page == self._driver:
            self._driver = None

    def _bodies(self, trees: np.ndarray) -> np.ndarray:
        """Returns the indices of all bodies of ``trees`` [k], tree by tree."""
        model = self._client.model
        first = model.tree_first[trees]
        size = model.tree_size[trees]
        return np.repeat(first - (np.cumsum(size) - size), size) + np.arange(size.sum())

    def _start_view(self) -> np.ndarray:
        """Returns the first viewpoint of a page: a spectator's eyes, those of the person whom the page controls, or a
        view over the shoulder of an actor."""
        client = self._client
        if self._person is not None and self._driver is None:
            return client.humans[client.name].pose.head
        if not isinstance(client, Spectator):
            name = next(iter(client.robots), client.name)
            root = client.physics.rigid.base_state(name)[0] if client.robots else client.humans[name].pose.root
        elif self._eyes is not None or not client.begins_behind_actor or (root := self._nearest_root()) is None:
            return client.pose
        return first_view(np.asarray(root, float), client.model, self._at_rest[:, :3])

    def _nearest_root(self) -> np.ndarray | None:
        """Returns the pose [7] of the base of the remote actor that is nearest to a spectator's eyes; None if there is
        none."""
        client = self._client
        assert isinstance(client, Spectator)
        roots = []
        for name, actor in tuple(client.remote_actors.items()):
            if isinstance(actor, RemoteHuman):
                roots += [] if actor.pose is None else [actor.pose.root]
            else:
                roots.append(client.physics.rigid.base_state(name)[0])
        roots += [frames.pose(place) for place in client.far_actors().values()]
        return min(roots, key=lambda root: float(np.linalg.norm(root[:2] - client.pose[:2])), default=None)


MAX_TERRAIN_NODES = 250_000
"""Largest number of nodes of uneven ground in a page; finer ground is sent with every second, third ... node."""


def _terrain_grid(terrain: Terrain | None) -> tuple[dict[str, Any] | None, np.ndarray]:
    """Returns the grid of uneven ground as a page needs it, and the heights of its nodes above its inclined plane."""
    if terrain is None:
        return None, np.zeros(0, np.float32)
    stride = int(np.ceil(np.sqrt(terrain.residual.size / MAX_TERRAIN_NODES)))
    nodes = terrain.residual[::stride, ::stride]
    x, y = terrain.origin
    cell = stride * terrain.cell
    return {"x": x, "y": y, "cell": cell, "columns": nodes.shape[1], "slope": list(terrain.slope)}, nodes.ravel()


def _light(height: float, palette: Palette) -> dict[str, Any]:
    """Returns the daylight for pages, as JSON values: colours (linear RGB), brightness and exposure, equal to those of
    cameras. ``height``: sine of the sun's elevation [1]; ``palette``: colours of the vineyard."""
    light = OutdoorLight.of(height, palette)
    colours = {name: getattr(light, name).tolist() for name in ("sun", "sky", "haze", "ground", "canopy", "balance")}
    return colours | {"dim": light.dim, "exposure": AMONG_VINES * usual_exposure(light.brightness)}


def _halved(tables: np.ndarray) -> np.ndarray:
    """Returns textures [k, side, side, channel] with half the resolution: a page must load fast."""
    k, side, _, channels = tables.shape
    return tables.astype(np.float32).reshape(k, side // 2, 2, side // 2, 2, channels).mean((2, 4))


def _bytes(values: np.ndarray) -> np.ndarray:
    """Returns an array with values from 0 to 1 as uint8, from 0 to 255."""
    return np.round(255.0 * np.clip(values, 0.0, 1.0)).astype(np.uint8)


def _differ_in_lights_only(before: tuple[RigidVisual, ...], now: tuple[RigidVisual, ...]) -> bool:
    """Returns whether two lists of rigid bodies differ only in the colours of indicator lights."""
    return len(before) == len(now) and all(
        one is other
        or (
            (one.name, one.organ, one.index, len(one.shapes))
            == (other.name, other.organ, other.index, len(other.shapes))
            and all(
                a is b or (a.is_indicator and b.is_indicator) for a, b in zip(one.shapes, other.shapes, strict=True)
            )
        )
        for one, other in zip(before, now, strict=True)
    )


def _tracked(person: TrackedPerson) -> TrackedPoints:
    """Convert the head and hands in a page's message to tracked points for the simulated person."""
    hands = person.left, person.right
    left, right = (None if hand is None else np.array(hand.pose) for hand in hands)
    return TrackedPoints(
        np.array(person.head),
        left,
        right,
        (bool(hands[0] and hands[0].closed), bool(hands[1] and hands[1].closed)),
        (OPEN_HAND if hands[0] is None else hands[0].fingers, OPEN_HAND if hands[1] is None else hands[1].fingers),
        person.shears,
    )


def _held_thing(held: tuple[str, str] | None, model: Model) -> str:
    """Returns what a hand holds as text for people: "the bunch", "the cane", "the box" or an actor's name; "" for
    nothing. ``held``: as in :class:`vinesim.scene.values.HandSample`."""
    if held is None:
        return ""
    actor, link = held
    if actor == "plants":
        return "the bunch" if model.body_organ[int(link.removeprefix("body/"))] == Organ.BUNCH else "the cane"
    kind, _, number = actor.partition("/")
    return f"the {kind}" if number else actor


def _within_reach(model: Model) -> dict[str, np.ndarray]:
    """Returns arrays about the objects that a person can reach for.

    They contain bodies of wood with their lengths [m], and for each bunch its body, length and radius [m], and the last
    segment of its peduncle.
    """
    wood = np.flatnonzero(np.isin(model.body_organ, (Organ.CANE, Organ.PEDUNCLE)))
    stalk = model.body_parent[model.bunch_body]
    return {
        "wood": wood.astype(np.uint32),
        "wood_length": model.body_length[wood].astype(np.float32),
        "bunch_body": model.bunch_body.astype(np.uint32),
        "bunch_length": model.bunch_length.astype(np.float32),
        "bunch_radius": model.bunch_radius.astype(np.float32),
        "bunch_stalk": stalk.astype(np.uint32),
        "stalk_length": model.body_length[stalk].astype(np.float32),
    }


def _turns(pose: np.ndarray) -> np.ndarray:
    """Returns the quaternions of poses [k, 7] as integers [k, 4] int16; :data:`_TURN_STEPS` encodes 1."""
    return np.round(pose[:, 3:] * _TURN_STEPS).astype(np.int16)


def _columns(primitives: Primitives, rows: slice | np.ndarray) -> dict[str, np.ndarray]:
    """Returns the primitives ``rows`` [n] in the format of pages: shape [n, 16], surface (colour and visible sky) [n,
    4] uint8, material [n], and index of the body that carries each primitive [n]."""
    columns = primitives.local_columns(rows)
    shape = np.concatenate([columns[name] for name in "abcd"], 1).astype(np.float32)
    colour = np.round(255.0 * np.clip(columns["tint"], 0.0, 1.0) ** (1.0 / 2.2))
    light = np.round(255.0 * np.clip(columns["sky"], 0.0, 1.0))
    surface = np.column_stack([colour, light]).astype(np.uint8)
    return {
        "shape": shape,
        "surface": surface,
        "material": columns["material"].astype(np.uint8),
        "carrier": columns["carrier"].astype(np.uint32),
    }


def _nearest(primitives: Primitives, place: np.ndarray, most: int) -> tuple[float | None, dict[str, np.ndarray]]:
    """Select the clusters of plants and ground nearest to ``place`` [3] m, with at most ``most`` primitives.

    Returns the distance [m] up to which all berries are included (None: nothing is missing), and the primitives with
    their clusters. :data:`LOADED` has the distances of other materials.
    """
    count = len(primitives.cluster_first) - len(primitives.rigid_clusters)
    clusters = _clusters(primitives, slice(0, count))
    if primitives.plant_count <= most:
        return None, _columns(primitives, slice(0, primitives.plant_count)) | clusters
    first = clusters["first"].astype(int)
    size = clusters["size"].astype(int)
    material = primitives.local_columns(first)["material"]
    share = np.select([material == one for one in LOADED], list(LOADED.values()), ELSE_LOADED)
    away = np.linalg.norm(clusters["ball"][:, :3] - place, axis=1) / share
    order = np.argsort(away, kind="stable")
    fitting = int(np.searchsorted(np.cumsum(size[order]), most, side="right"))
    kept = np.sort(order[:fitting])
    clusters = {name: values[kept] for name, values in clusters.items()}
    start = np.cumsum(size[kept]) - size[kept]
    rows = np.repeat(first[kept] - start, size[kept]) + np.arange(size[kept].sum())
    clusters["first"] = start.astype(np.uint32)
    return float(away[order[fitting]]), _columns(primitives, rows) | clusters


def _clusters(primitives: Primitives, which: slice, row: int = 0) -> dict[str, np.ndarray]:
    """Returns clusters (runs of adjacent primitives) in the format of pages: first primitive, size, kind, bunch and
    bounding sphere of each. ``which``: the clusters; ``row``: index of the primitive that counts as the first."""
    return {
        "first": (primitives.cluster_first[which] - row).astype(np.uint32),
        "size": primitives.cluster_size[which].astype(np.uint32),
        "kind": primitives.cluster_kind[which].astype(np.uint8),
        "bunch": primitives.cluster_bunch[which].astype(np.int32),
        "ball": primitives.ball.numpy()[which].astype(np.float32),
    }


# Overlays that pages draw on demand: contact forces, and owners of trees, bunches and boxes.


MAX_CONTACTS = 300
"""Largest number of contacts sent to a page; those with the largest forces are sent."""


def owners(client: Client) -> dict[str, str]:
    """Returns the owner of each object that an actor owns: actor's name by object's name."""
    found = {}
    for replicator in client.replicators.values():
        for number in sorted(replicator.known):
            if (owner := replicator.owner(number)) is not None:
                found[object_name(number)] = owner
    return found


def contact_arrays(contacts: Sequence[Contact]) -> dict[str, np.ndarray]:
    """Returns positions [k, 3] m of contacts with plants, and the forces [k, 3] N on the plants."""
    force = -np.array([contact.force for contact in contacts], np.float32).reshape(-1, 3)
    place = np.array([contact.position for contact in contacts], np.float32).reshape(-1, 3)
    strongest = np.argsort(-np.linalg.norm(force, axis=1), kind="stable")[:MAX_CONTACTS]
    return {"contact_place": place[strongest], "contact_force": force[strongest]}
