"""The start place of an actor that joins a world: the first one at which no other actor stands.

Other actors are known by the poses that they publish. An actor that is live but has not published a pose is starting,
too: actors around the start place publish five poses a second, and all others a coarse pose every two seconds. Such
actors take places in the order of their names, so that clients that start at the same time choose different places.
"""

from __future__ import annotations

import itertools
import logging
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from vinesim.client.tasks.start_poses import BASE_CLEARANCE, QUEUE_SPACING, ground_clearance, start_pose
from vinesim.net.codec.header import MessageError
from vinesim.net.codec.human import decode_pose
from vinesim.net.codec.messages import sender_of
from vinesim.net.replication import interest
from vinesim.net.transport.bus import Bus
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene
from vinesim.scene.values import RobotUpdate

log = logging.getLogger(__name__)

TAKEN = 0.7
"""Horizontal distance from another actor within which a start place is taken [m]."""
STARTING_TIME = 3.0
"""Longest time for which an actor waits for the poses of actors that are starting [s]. From its choice to its first
pose a client takes 0.6 s, more on a busy machine."""
POSE_TIME = 0.5
"""Longest time for which an actor with a given place waits for the poses of others [s]. Those of actors around that
place arrive five times a second."""
_POLL_PERIOD = 0.02
_MAX_LAPS = 20
"""Number of rows of places that are tried behind the start places of a scene."""


class Others(NamedTuple):
    """The other live actors of a world."""

    places: dict[str, np.ndarray]
    """Position [2] m of each robot and person, by name."""
    starting: tuple[str, ...] = ()
    """Sorted names of the actors whose pose is unknown."""


def find_others(bus: Bus, start: np.ndarray, timeout: float, wait: Callable[[float], object] = time.sleep) -> Others:
    """Returns the live actors in the window of regions around ``start`` [2 or 3] m, without spectators, and those that
    have no pose yet.

    In a world of more than 100 actors coarse poses are so rare that an actor without one need not be starting. No actor
    counts as starting then.

    Returns when all live actors are known, at the latest after the ``timeout`` [s]. ``wait(seconds)`` lets time pass.
    """
    window = interest.cell_window(interest.cell_of(start, interest.REGION_SIZE))
    key = interest.POSE_LAYERS[0].key
    patterns = [key.format(region=interest.region_chunks(region), actor="*") for region in sorted(window)]
    subscriptions = [bus.subscribe(pattern) for pattern in (*patterns, interest.FAR_KEY.format(actor="*"))]
    places: dict[str, np.ndarray | None] = {}
    for _ in range(round(timeout / _POLL_PERIOD)):
        for sent_under, payload in bus.poll():
            name = sender_of(sent_under)
            try:
                pose = decode_pose(payload, name)
            except MessageError:  # the client counts such messages when it has started
                continue
            if sent_under == interest.FAR_KEY.format(actor=name):
                if interest.cell_of(pose.base_q, interest.REGION_SIZE) not in window:
                    places.setdefault(name, None)
                continue
            is_spectator = isinstance(pose, RobotUpdate) and not len(pose.position)
            places[name] = None if is_spectator else pose.base_q[:2]
        if not bus.alive() - {bus.name} - places.keys():
            break
        wait(_POLL_PERIOD)
    for subscription in subscriptions:
        subscription.close()
    live = bus.alive() - {bus.name}
    if interest.thinning(len(live), interest.POSE_RATE / interest.FAR_EVERY, interest.FAR_BUDGET) > 1:
        live &= places.keys()
    return Others(
        {name: place for name in sorted(live & places.keys()) if (place := places[name]) is not None},
        tuple(sorted(live - places.keys())),
    )


def choose_places(
    scene: Scene,
    model: Model,
    bus: Bus,
    *,
    number: int | None = None,
    count: int = 1,
    wait: Callable[[float], object] = time.sleep,
) -> list[int]:
    """Returns the places of ``count`` actors of one client, as ``queue`` numbers of
    :func:`vinesim.client.tasks.start_poses.start_pose` for the start place ``number`` or, if that is None, 0.

    If ``number`` is given, the first actor starts there, and a warning says if another actor stands there. Otherwise
    each actor takes the first free place, and a warning says which places were taken.
    """
    others = find_others(bus, start_pose(scene, number or 0), STARTING_TIME if number is None else POSE_TIME, wait)
    taken = list(others.places.items())
    starting = [name for name in others.starting if name < bus.name]
    chosen: list[int] = []
    passed: dict[str, str] = {}
    for queue in itertools.count():
        if len(chosen) == count:
            break
        is_given = queue == 0 and number is not None
        place = start_pose(scene, number or 0, queue=queue)[:2]
        if queue >= len(scene.spawns) and ground_clearance(model, place[None])[0] < BASE_CLEARANCE and not is_given:
            continue
        holder = next((name for name, there in taken if np.linalg.norm(there - place) < TAKEN), "")
        if not holder and not is_given and starting:
            holder = starting.pop(0)
            taken.append((holder, place))
        if holder and holder != bus.name:
            passed[_place_name(scene, number or 0, queue)] = holder
        if is_given or not holder:
            chosen.append(queue)
            taken.append((bus.name, place))
    _report(bus.name, passed, [_place_name(scene, number or 0, queue) for queue in chosen], is_given=number is not None)
    return chosen


def _report(name: str, passed: Mapping[str, str], chosen: list[str], *, is_given: bool) -> None:
    """Log which places were taken by others, and where the actors of the client ``name`` start instead."""
    if not passed:
        return
    taken = " and ".join(f"{place} by {holder}" for place, holder in passed.items())
    remedy = "; leave out --spawn or --pose, and it takes a free place" if is_given else ""
    log.warning("taken start places: %s; %s starts at %s%s", taken, name, " and ".join(chosen), remedy)


def _place_name(scene: Scene, first: int, queue: int) -> str:
    """Returns a text for people: number and name of a start place of the scene, or a place behind it."""
    count = max(len(scene.spawns), 1)
    lap, number = divmod(first + queue, count) if queue else (0, first)
    name = f"{number} ({scene.spawns[number].name})" if scene.spawns else str(number)
    return f"{QUEUE_SPACING * lap:g} m behind {name}" if lap else name
