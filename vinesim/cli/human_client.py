"""``vinesim client --role human``: join a vineyard as a human who is moved by a page in a browser, or by a script."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from vinesim.avatar.gestures import Gestures
from vinesim.avatar.scripted_human import ScriptedHuman
from vinesim.avatar.tracked_human import TrackedHuman
from vinesim.cli.client_options import ClientOptions
from vinesim.cli.client_session import ClientSession, save_report
from vinesim.client.client import Client
from vinesim.client.tasks.start_poses import bunch_centres, start_pose, validate_bunch
from vinesim.errors import writing

REACH = 0.55
"""Horizontal distance from a bunch at which a human stands to take hold of it [m]. GUESSED."""


def run(options: ClientOptions) -> int:
    """Be the person in front of the page, or by a script walk, reach for a bunch, hold it, pull at it, let go; until a
    signal; then write report.json; the exit code."""
    gestures = None if options.gestures is None else Gestures.load(options.gestures)
    with ClientSession(options) as session:
        validate_bunch(session.model, options.reach)
        if options.out is not None:
            with writing(options.out):
                options.out.mkdir(parents=True, exist_ok=True)
        start = start_pose(session.scene, session.spawn)
        human = ScriptedHuman(start, options.height)
        if options.is_for_page:
            human = TrackedHuman(start, options.height, gestures=gestures)
        client = Client(
            session.scene, session.model, None, session.bus(session.name), pose=start, source=human,
            height=options.height, **session.client_options(),
        )  # fmt: skip
        session.leave_at_end(client)
        if options.walk is not None and isinstance(human, ScriptedHuman):
            human.do(human.walk(options.walk))
        if options.reach is not None and isinstance(human, ScriptedHuman):
            trace = session.trace(client, options.reach)
            if options.walk is None:
                human.do(human.walk(standing_place(bunch_centres(session.model)[options.reach], start)))
            human.do(pull_repeatedly(human, trace.centre))
        session.show_page(client, human if isinstance(human, TrackedHuman) else None)
        status = session.run(client)
        if options.out is not None:
            save_report(options.out, status.report())
            if client.trace is not None:
                with writing(options.out / "trace.npz"):
                    client.trace.rows().save(options.out / "trace.npz")
    return 0


def pull_repeatedly(human: ScriptedHuman, point: Callable[[], np.ndarray]) -> Iterator[None]:
    """Hold what is at a point [3] in the world, pull at it, let it go; without end."""
    while True:
        yield from human.reach("right", point)
        yield from human.wait(0.5)
        yield from human.withdraw("right", 0.3)
        yield from human.wait(1.0)
        yield from human.release("right")
        yield from human.withdraw("right")
        yield from human.wait(1.5)


def standing_place(bunch: np.ndarray, start: np.ndarray) -> tuple[float, float]:
    """A point (x, y) [m] within reach of a bunch [3] m, on the side of the pose ``start`` [7]."""
    way = bunch[:2] - start[:2]
    length = float(np.linalg.norm(way))
    x, y = bunch[:2] - way * min(1.0, REACH / max(length, 1e-9))
    return float(x), float(y)
