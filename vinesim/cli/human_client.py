"""``vinesim client --role human``: join a vineyard as a person who is controlled by a page in a browser, or by a
script."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from vinesim.avatar.gestures import Gestures
from vinesim.avatar.scripted_human import ScriptedHuman
from vinesim.avatar.tracked_human import TrackedHuman
from vinesim.cli.client_options import ClientOptions
from vinesim.cli.client_session import ClientSession, save_report
from vinesim.client.client import Client
from vinesim.client.tasks.planning import REACH
from vinesim.client.tasks.start_poses import bunch_centres, start_pose, validate_bunch
from vinesim.core import frames
from vinesim.core.errors import writing
from vinesim.world import Physics

GIVING_HEIGHT = 0.70
"""Height of the hand above the bottom of a box when the hand releases a bunch [m]. GUESSED."""
LIFTED = 0.08
STILL_SPEED = 0.03
HOLDS_STILL = 1.0
"""Time for which a box must move slower than ``STILL_SPEED`` [m/s], raised by at least ``LIFTED`` [m], to count as held
out [s]. GUESSED."""


def run(options: ClientOptions) -> int:
    """Run the client of a person who follows the input of a page, or a script: walk, reach for a bunch, hold it, pull,
    let go.

    At a signal the client writes report.json. Returns the exit code.
    """
    gestures = None if options.gestures is None else Gestures.load(options.gestures)
    with ClientSession(options) as session:
        validate_bunch(session.model, options.reach)
        if options.out is not None:
            with writing(options.out):
                options.out.mkdir(parents=True, exist_ok=True)
        bus = session.bus(session.name)
        start = start_pose(session.scene, session.spawn or 0, queue=session.choose_places(bus)[0])
        human = ScriptedHuman(start, options.height, terrain=session.model.terrain)
        if options.is_for_page:
            human = TrackedHuman(start, options.height, gestures=gestures, terrain=session.model.terrain)
        client = Client(
            session.scene,
            session.model,
            None,
            bus,
            pose=start,
            source=human,
            height=options.height,
            outfit=options.outfit or "",
            **session.client_options(),
        )
        session.leave_at_end(client)
        if options.walk is not None and isinstance(human, ScriptedHuman):
            human.do(human.walk(options.walk))
        if options.reach is not None and isinstance(human, ScriptedHuman):
            trace = session.trace(client, options.reach)
            if options.walk is None:
                human.do(human.walk(standing_place(bunch_centres(session.model)[options.reach], start)))
            indicate = client.humans[session.name].indicate
            if options.into is None:
                human.do(pull_repeatedly(human, trace.centre, indicate))
            else:
                human.do(pick_and_give(human, client.physics, options.reach, options.into, indicate))
        session.show_page(client, human if isinstance(human, TrackedHuman) else None)
        status = session.run(client)
        if options.out is not None:
            save_report(options.out, status.report())
            if client.trace is not None:
                with writing(options.out / "trace.npz"):
                    client.trace.rows().save(options.out / "trace.npz")
    return 0


def pull_repeatedly(
    human: ScriptedHuman, point: Callable[[], np.ndarray], indicate: Callable[[str], None] = lambda _: None
) -> Iterator[None]:
    """Script for a person: hold the object at a point [3] m in the world, pull at it, let it go, and begin again.

    ``indicate`` is called with what the person is about to do.
    """
    while True:
        indicate("pick")
        yield from human.reach("right", point)
        yield from human.wait(0.5)
        yield from human.withdraw("right", 0.3)
        yield from human.wait(1.0)
        yield from human.release("right")
        indicate("")
        yield from human.withdraw("right")
        yield from human.wait(1.5)


def pick_and_give(
    human: ScriptedHuman, physics: Physics, bunch: int, box: int, indicate: Callable[[str], None] = lambda _: None
) -> Iterator[None]:
    """Script for a person: pick a bunch in reach, lower it, wait until a box was lifted and is held still, lay the
    bunch into the box, step back.

    ``indicate`` is called with what the person is about to do.
    """
    body = int(physics.model.bunch_body[bunch])
    middle = 0.5 * float(physics.model.bunch_length[bunch])

    def centre() -> np.ndarray:
        physics.update_kinematics()
        return frames.compose(physics.state.body_q[body].astype(float), frames.pose([middle, 0.0, 0.0]))[:3]

    def box_place() -> np.ndarray:
        names = [visual.name for visual in physics.rigid.visuals()]
        return physics.rigid.visual_q()[names.index(f"box/{box}"), :3]

    indicate("pick")
    yield from human.reach("right", centre)
    yield from human.wait(0.5)
    yield from human.back(lambda: not physics.state.bunch_attached[bunch])
    yield from human.back(lambda: False, 0.3)
    yield from human.withdraw("right")  # otherwise the hand hits the bunches that hang on its way, and tears them off
    indicate("hand over")
    low = box_place()[2]
    before = box_place()
    still = 0.0
    while still < HOLDS_STILL:
        yield
        here = box_place()
        is_still = np.linalg.norm(here - before) < STILL_SPEED * human.dt and here[2] > low + LIFTED
        before = here
        still = still + human.dt if is_still else 0.0
    yield from human.walk(standing_place(box_place(), human.place))
    yield from human.face((float(before[0]), float(before[1])))
    yield from human.reach("right", lambda: box_place() + np.array([0.0, 0.0, GIVING_HEIGHT]))
    yield from human.wait(0.5)
    yield from human.release("right")
    yield from human.wait(0.5)
    indicate("")
    yield from human.withdraw("right")
    yield from human.back(lambda: False, 0.5)


def standing_place(goal: np.ndarray, start: np.ndarray) -> tuple[float, float]:
    """Returns a point (x, y) [m] within reach of a ``goal`` [3] m, on the side of the place ``start`` [2 or 7]."""
    way = goal[:2] - start[:2]
    length = float(np.linalg.norm(way))
    x, y = goal[:2] - way * min(1.0, REACH / max(length, 1e-9))
    return float(x), float(y)
