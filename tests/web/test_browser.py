"""The page in a real browser: it draws the live vineyard within its budgets, and what happens there is seen."""

import dataclasses
import threading

import numpy as np
import pytest

from benchmarks.support.browser import emulated_headset
from tests.support.live_page import (
    BUNCH,
    CONTROLS,
    VICTORY,
    LiveVineyard,
    is_drawn_anew,
    look_at,
    open_page,
    press,
    touch_screen,
)
from tests.support.long_rows import long
from tests.support.recorded_pick import PICKED_AT, replay_of_a_pick
from tests.support.waiting import wait
from vinesim.avatar.gestures import GESTURES
from vinesim.client.page.page_world import LOADED, PageWorld
from vinesim.client.tasks.start_poses import bunch_centres
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.human_posture import standing_pose
from vinesim.scene import appearance
from vinesim.scene.ids import Organ
from vinesim.scene.values import INTENTIONS, HumanSpec
from vinesim.web.array_message import decode
from vinesim.web.page_input import PageInput, TrackedPerson
from vinesim.web.page_server import WINDOW, PageServer

MAX_CALLS = 20
MAX_TRIANGLES = 300_000
MAX_BYTES = 4_000_000
"""Of one picture for one eye, and of the vineyard that a page loads [B]."""
"""Put there by tools/build_page."""

MISPLACED = """
(() => {
  const shown = [...document.querySelectorAll(".panel, #enter")].filter((one) => one.checkVisibility());
  const boxes = shown.map((one) => [one.id || one.className, one.getBoundingClientRect()]);
  const wrong = boxes.filter(([, { left, top, right, bottom }]) =>
    left < 0 || top < 0 || right > innerWidth || bottom > innerHeight).map(([name]) => `${name} is cut off`);
  boxes.forEach(([name, a], k) => {
    for (const [other, b] of boxes.slice(k + 1))
      if (a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom)
        wrong.push(`${name} is over ${other}`);
  });
  return wrong;
})()
"""
LONG_STATE = "document.getElementById('state').textContent = 'no news for 100 s: the client pauses, or does not answer'"
SEEN_CUT = """
(viewer, cut) => {
  const { world, camera } = viewer, [, mark] = viewer.shears.marks;
  const project = (point) => {
    const { x, y } = viewer.project(point);
    return [(x + 1) / 2 * innerWidth, (1 - y) / 2 * innerHeight];
  };
  const place = mark.position.clone().set(...cut), eye = mark.position.clone().set(...viewer.eyes.place);
  const off = Math.hypot(...project(mark.position).map((value, axis) => value - project(place)[axis]));
  // parts of the hand that the line from the eyes to the cut passes through: boxes around their primitives
  const hides = [...world.bounds].filter(([carrier, box]) => {
    if (!/^viewer.right_(hand|thumb|index|middle|ring|little|forearm)/.test(world.nameOf(carrier))) return false;
    for (let share = 0; share < 1; share += 0.002)
      if (box.containsPoint(world.within(carrier, eye.clone().lerp(place, share)))) return true;
    return false;
  }).map(([carrier]) => world.nameOf(carrier));
  return { mark: mark.visible, off, hides };
}
"""
"""Whether a mark is drawn, how far from where the cut is [px], and what of the hand is before that."""
IS_LONG = """
(({ frame, lastFrame, absence, world, newest }, tick) => {
  const { dt } = world.header, usual = Math.max(absence.usual, newest.time - absence.known.time);
  const isLate = performance.now() - lastFrame > 6000 * frame;
  return isLate && (tick - newest.tick) * dt > Math.max(2 * absence.long, 6 * usual);
})
"""
"""Whether a hidden page would miss much more than the usual time between two pictures, by both clocks."""
OTHER_CARD = """
  const { prototype } = WebGL2RenderingContext, get = prototype.getParameter;
  prototype.getParameter = function (what) {
    const found = get.call(this, what);
    return typeof found === "string" && /swiftshader/i.test(found) ? "a graphics card" : found;
  };
"""
"""Runs before the page: what draws does not say that it is no graphics card."""
WRIST = """
(({ wrist, headset }) => {
  const left = headset.sources.findIndex((source) => source?.handedness === "left");
  const place = (one) => one.getWorldPosition(headset.rig.position.clone());
  const away = place(wrist.panel).distanceTo(place(headset.rays[left]));
  return { visible: wrist.panel.visible, lines: wrist.lines, away };
})(vinesim.viewer)
"""
"""What a person in a headset reads, whether it is seen, and how far it is from the left hand [m]."""


@pytest.mark.slow
@pytest.mark.xdist_group("browser")
def test_the_live_vineyard_in_a_browser(page):
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus) as live:
        page.open(live.server.address + "?rate=10")
        wait(lambda: page.run("window.vinesim?.drawn >= 3 || window.vinesim?.failure"), "three states are drawn")
        assert page.run("vinesim.failure") is None
        assert 0 < page.run("vinesim.calls") <= MAX_CALLS
        assert 50_000 < page.run("vinesim.triangles") <= MAX_TRIANGLES
        assert len(live.world.scene()) <= MAX_BYTES
        page.run("vinesim.viewer.world.budget = 60000, vinesim.viewer.world.listedAt = null")  # for a slow machine
        wait(lambda: page.run("vinesim.triangles") <= 60_000, "fewer triangles are drawn")
        page.run("document.getElementById('notices').style.display = 'none'")  # they come and go
        pictures = [page.picture()]

        def is_settled():
            pictures.append(page.picture())
            return np.abs(pictures[-1].astype(float) - pictures[-2]).mean() < 1.0

        wait(is_settled, "a picture in which shadows and lists of leaves are up to date")
        before = pictures[-1]
        assert before.std() > 30.0, "a vineyard, not one colour"

        # a page whose loop stands still gets no more than the window
        page.run("vinesim.viewer.renderer.setAnimationLoop(null)")
        sent = live.server.states_sent
        tick = live.client.physics.tick
        wait(lambda: live.client.physics.tick > tick + 40, "40 steps without a picture")
        assert live.server.states_sent - sent <= WINDOW
        page.run("vinesim.viewer.renderer.setAnimationLoop(() => vinesim.viewer.draw())")
        drawn = page.run("vinesim.drawn")
        wait(lambda: page.run("vinesim.drawn") > drawn + 1, "the page goes on")

        # the bunch before the eyes is picked, and falls out of sight
        live.due.append(lambda: live.client.physics.pick(BUNCH))
        wait(lambda: page.run("vinesim.viewer.world.picked.size") == 1, "the page knows of the picked bunch")
        carrier = f"vinesim.viewer.world.bodies + 1 + vinesim.viewer.world.names.findIndex(n => n.includes('{BUNCH}'))"
        wait(lambda: page.run(f"vinesim.viewer.world.place({carrier}).z") < 0.5, "the bunch has fallen")
        drawn = page.run("vinesim.drawn")
        wait(lambda: page.run("vinesim.drawn") > drawn + 1, "it is drawn there")
        change = np.abs(page.picture().astype(float) - before).mean(2)
        high, wide = change.shape
        middle = change[high // 2 - 25 : high // 2 + 25, wide // 2 - 25 : wide // 2 + 25].mean()
        assert middle > 8.0 * change.mean(), "where the bunch hung, the picture has changed"

        # keys fly, and the client knows where the eyes are
        page.key("KeyS", down=True)
        wait(lambda: np.linalg.norm(live.client.pose[:3] - live.bunch) > 1.2, "the eyes have flown away")
        page.key("KeyS", down=False)
        assert page.errors == []


@pytest.mark.slow
@pytest.mark.xdist_group("browser")
def test_a_person_in_a_browser_touches_takes_and_picks_a_bunch(page):
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus, is_person=True) as live:
        open_page(page, live)
        physics = live.client.physics
        body = live.client.model.bunch_body[BUNCH]
        here = physics.state.body_q[body, :3].copy()
        eye = look_at(page, live.bunch)
        assert np.linalg.norm(eye - live.client.humans["viewer"].pose.head[:3]) < 1e-3, "the person's own eyes"
        page.run(f"vinesim.viewer.hand.distance = {np.linalg.norm(live.bunch - eye) + 0.02}")
        page.run("document.querySelector('#intentions button').click()")
        wait(lambda: live.client.humans["viewer"].intention == INTENTIONS[1], "the person indicates what comes")
        page.key("KeyR", down=True)
        page.key("KeyR", down=False)
        wait(lambda: physics.hand("viewer", "right").touching, "the hand reaches the bunch")
        page.key("Digit3", down=True)
        wait(lambda: live.client.humans["viewer"].pose.right_fingers == GESTURES["point"], "the hand points")
        page.key("Digit3", down=True)
        page.key("Space", down=True)
        page.key("Space", down=False)
        wait(
            lambda: page.run("vinesim.haptics.right?.[0] > 0"),
            "a vibration of the right hand arrives",
        )
        wait(lambda: np.linalg.norm(physics.state.body_q[body, :3] - here) > 2e-3, "the bunch gives way")
        wait(lambda: physics.hand("viewer", "right").held is not None, "the hand holds the bunch")
        for code in ("KeyC", "KeyO"):
            page.key(code, down=True)
            page.key(code, down=False)
        drawn = "Number.isFinite(forces.geometry.drawRange.count) && forces.geometry.drawRange.count >= 6"
        wait(lambda: page.run(f"(({{ forces }}) => {drawn})(vinesim.viewer.overlays)"), "its force is drawn")
        wait(lambda: ": viewer" in page.run("document.getElementById('names').textContent"), "its tree is the person's")
        page.key("KeyS", down=True)
        wait(lambda: not physics.state.bunch_attached[BUNCH], "who walks away with it in the hand picks it")
        page.key("KeyS", down=False)
        assert np.linalg.norm(physics.hand("viewer", "right").force) <= 100.0 + 1e-6
        wait(lambda: page.run("vinesim.viewer.world.picked.size") == 1, "the page knows of the picked bunch")
        assert page.errors == []


@pytest.mark.long
@pytest.mark.xdist_group("browser")
def test_a_person_in_a_browser_takes_shears_and_cuts_a_bunch(page):
    """The page shows the shears where the cut then happens, and says what they have cut."""
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus, is_person=True) as live:
        open_page(page, live)
        physics = live.client.physics
        model = live.client.model
        shears = appearance.load_shears()
        stalk = int(model.body_parent[model.bunch_body[BUNCH]])
        assert model.body_organ[stalk] == int(Organ.PEDUNCLE)

        def middle():
            """[3] m of the last piece of the peduncle, where it is now."""
            half = frames.pose(np.array([0.5 * model.body_length[stalk], 0.0, 0.0]))
            return frames.compose(physics.state.body_q[stalk].astype(float), half)[:3]

        eye = look_at(page, middle())
        page.run(f"vinesim.viewer.hand.distance = {np.linalg.norm(middle() - eye)}, 0")
        drawn = "vinesim.viewer.world.names.includes('viewer/right_shears_blade')"
        page.run(
            "window.load = fetch, window.fetch = (path) => new Promise((go) => { goOn = () => go(load(path)); }), 0"
        )
        press(page, "KeyT")
        wait(lambda: page.run("'goOn' in window"), "the page asks for the shapes of the shears")
        states = page.run("vinesim.states")
        wait(lambda: page.run("vinesim.states") > states + 2, "states with other rows come before the shapes")
        names, places = page.run("""(({ world }) => [world.names, world.names.map((_, k) =>
          world.place(world.bodies + 1 + k).toArray())])(vinesim.viewer)""")
        there = dict(zip([one.name for one in physics.rigid.visuals()], physics.rigid.visual_q(), strict=True))
        np.testing.assert_allclose(places, [there[name][:3] for name in names], atol=0.15, err_msg="fingers close")
        page.run("goOn(), window.fetch = load, 0")
        wait(lambda: page.run(drawn), "the page draws them")
        assert live.client.humans["viewer"].pose.right_shears
        assert page.run("document.getElementById('shears').getAttribute('aria-pressed')") == "true"
        press(page, "KeyR")

        def is_between_blades():
            apart = frames.compose(physics.hand("viewer", "right").pose, shears.mouth)[:3] - middle()
            return np.abs(apart).max() < 0.012

        wait(is_between_blades, "the peduncle is between the blades")
        assert physics.state.bunch_attached[BUNCH]
        wait(lambda: page.run("document.getElementById('hold').innerText") == "Space cut bunch", "the button says so")
        seen = page.run(f"({SEEN_CUT})(vinesim.viewer, {list(map(float, middle()))})")
        assert seen["mark"]
        assert seen["off"] < 6.0, "a mark is where the blades cut [px]"
        assert seen["hides"] == [], "nothing of the hand is before it"
        press(page, "Space")
        wait(lambda: not physics.state.bunch_attached[BUNCH], "the bunch is cut")
        said = "The shears in the right hand cut 1 bunch."
        wait(lambda: page.run("vinesim.viewer.shears.told.at(-1)") == said, "the page says so")
        assert "cut 1 bunch" in page.run("document.getElementById('notices').textContent")
        wait(lambda: page.run("vinesim.haptics.right?.[0] > 0.99"), "the hand feels it")
        wait(lambda: not live.client.humans["viewer"].pose.right_closed, "the shears open by themselves")
        assert len(page.run("vinesim.viewer.shears.told")) == 1
        wait(lambda: page.run("document.getElementById('hold').innerText") == "Space cut", "nothing is between them")
        page.run("document.getElementById('shears').click()")
        wait(lambda: not page.run(drawn), "they are put away")
        press(page, "KeyL")
        wait(lambda: len(page.run("vinesim.viewer.handwork.told")) == 1, "the hand does something, or says why not")
        page.run("document.querySelector('[data-work=tie]').click()")
        wait(lambda: len(page.run("vinesim.viewer.handwork.told")) == 2, "a button does the same")
        assert page.run("vinesim.viewer.handwork.told.every((said) => said.startsWith('The right hand '))")
        assert page.errors == []


def touch(page, kind, *points):
    """An event of some fingers [px]; kinds: touchStart, touchMove, touchEnd."""
    points = [{"x": float(x), "y": float(y), "id": k} for k, (x, y) in enumerate(points)]
    page.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)


def tap(page, place):
    touch(page, "touchStart", place)
    touch(page, "touchEnd")


def tap_button(page, name):
    box = f"document.getElementById('{name}').getBoundingClientRect()"
    tap(page, page.run(f"(({{ x, y, width, height }}) => [x + width / 2, y + height / 2])({box})"))


def in_picture(page, point):
    """Where a point [3] m of the world is shown [px]."""
    return page.run(f"""(({{ world, eyes }}, viewer, point) => {{
      const {{ x, y }} = viewer.project(world.place(0).set(...point));
      return [(x + 1) / 2 * innerWidth, (1 - y) / 2 * innerHeight];
    }})(vinesim.viewer, vinesim.viewer, {[float(value) for value in point]})""")


@pytest.mark.long
@pytest.mark.xdist_group("browser")
def test_a_person_with_a_phone_picks_one_bunch_and_cuts_another_by_touch_alone(page):
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus, is_person=True) as live, touch_screen(page, 390, 844):
        page.open(live.server.address + "?triangles=10000&rate=10&shadows=0")
        wait(lambda: page.run("window.vinesim?.drawn >= 3 || window.vinesim?.failure"), "three states are drawn")
        physics = live.client.physics
        human = live.client.humans["viewer"]
        hand = lambda: physics.hand("viewer", "right")  # noqa: E731
        start = human.pose.head.copy()

        # one finger looks, and what it only passes over is not reached for
        touch(page, "touchStart", (200, 500))
        touch(page, "touchMove", (230, 500))
        touch(page, "touchEnd")
        wait(lambda: frames.to_yaw(human.pose.head[3:]) > 0.09, "one finger looks")
        assert not page.run("vinesim.viewer.hand.reaching")
        look_at(page, live.bunch)
        is_drawn_anew(page)

        tap(page, in_picture(page, live.bunch))
        assert page.run("vinesim.viewer.hand.target.what") == "bunch"
        wait(lambda: hand().touching, "the hand reaches the bunch")
        tap_button(page, "hold")
        wait(lambda: hand().held is not None, "it grasps it")
        assert page.run("document.getElementById('hold').innerText") == "let go"
        assert physics.state.bunch_attached[BUNCH]
        touch(page, "touchStart", (150, 400), (250, 400))
        touch(page, "touchMove", (150, 500), (250, 500))
        touch(page, "touchEnd")
        wait(lambda: not physics.state.bunch_attached[BUNCH], "who walks back with it by two fingers picks it")
        assert np.linalg.norm(hand().force) <= 100.0 + 1e-6
        assert human.pose.head[0] < start[0]
        tap_button(page, "reach")
        wait(lambda: hand().pose[2] < start[2] - 0.5, "the arm hangs down")
        assert hand().held is not None, "and holds the bunch still"
        tap_button(page, "hold")
        wait(lambda: hand().held is None, "it lets go")

        # what is too far away is said; shears cut the stalk of the bunch that was tapped
        model = live.client.model
        hangs = model.forward_kinematics(model.joint_settled)[model.bunch_body][:, :3] - np.array([0.0, 0.0, 0.06])
        far = np.linalg.norm(hangs - start[:3], axis=1) + 10.0 * (np.arange(len(hangs)) == BUNCH)
        other = int(far.argmin())
        place = hangs[other] - np.array([1.2, 0.0, hangs[other][2]])
        page.run(f"vinesim.viewer.eyes.place.splice(0, 2, {place[0]}, {place[1]}), 0")
        look_at(page, hangs[other])
        is_drawn_anew(page)
        tap_button(page, "shears")
        wait(lambda: human.pose.right_shears, "she takes the shears")
        tap(page, in_picture(page, hangs[other]))
        said = page.run("document.getElementById('notices').textContent")
        assert "This bunch is 1.2 m away" in said
        assert "walk nearer" in said
        assert not page.run("vinesim.viewer.hand.reaching")
        page.run(f"vinesim.viewer.eyes.place.splice(0, 1, {place[0] + 0.65}), 0")
        look_at(page, hangs[other])
        is_drawn_anew(page)
        tap(page, in_picture(page, hangs[other]))
        wait(lambda: page.run("document.getElementById('hold').innerText") == "cut bunch", "its stalk is between them")
        tap_button(page, "hold")
        wait(lambda: not physics.state.bunch_attached[other], "it is cut")
        assert page.errors == []


def pinch(page, place):
    """Open the emulated right hand, move it to a place [3] m above the floor, and pinch there."""
    for script in ("updatePinchValue(0)", f"position.set{place}", "updatePinchValue(1)"):
        page.run(f"device.hands.right.{script}, 0")
        drawn = page.run("vinesim.frames")
        wait(lambda drawn=drawn: page.run("vinesim.frames") > drawn + 1, "two pictures later")


@pytest.mark.slow
@pytest.mark.xdist_group("browser")
def test_a_headset_moves_head_and_hands(page):
    """An emulated headset (iwer) at known places: the person in the physics is there, in the world's axes."""
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus, is_person=True) as live:
        open_page(page, live, emulated_headset())
        human = live.client.humans["viewer"]
        start = human.pose.head.copy()
        page.run("vinesim.viewer.eyes.yaw = 0.5, 0")
        wait(lambda: page.run("!document.getElementById('enter').hidden"), "the page offers the headset")
        page.run("device.position.set(0.1, 1.5, -0.2), device.quaternion.set(0, 0, 0, 1), 0")
        page.run("device.controllers.right.position.set(0.3, 1.2, -0.6), 0")
        page.run("device.controllers.right.quaternion.set(0, 0, 0, 1), 0")
        page.run("document.getElementById('enter').click()")
        wait(lambda: page.run("vinesim.viewer.headset.isWorn"), "the headset is worn")
        # 0.2 m ahead and 0.1 m to the right of the floor's middle, which looks along 0.5 rad
        ahead = np.array([np.cos(0.5), np.sin(0.5)])
        right = np.array([np.sin(0.5), -np.cos(0.5)])
        head = np.array([*(start[:2] + 0.2 * ahead + 0.1 * right), 1.5])
        wait(lambda: np.linalg.norm(human.pose.head[:3] - head) < 5e-3, "the head is where the headset is")
        wait(lambda: frames.to_yaw(human.pose.head[3:]) == pytest.approx(0.5, abs=1e-3), "it looks where that looks")
        palm = np.array([*(start[:2] + 0.6 * ahead + 0.3 * right), 1.2])
        wait(lambda: np.linalg.norm(human.pose.right[:3] - palm) < 0.1, "the hand is where its controller is")
        fingers = frames.rotate(human.pose.right[3:], np.array([1.0, 0.0, 0.0]))
        assert np.dot(fingers[:2], ahead) > 0.7, "it points ahead"
        for button, fingers in (
            ("Value('trigger', 1)", (0.0, 1.0, 0.0, 0.0, 0.0)),
            ("Touch('a-button', true)", (1.0, 1.0, 0.0, 0.0, 0.0)),
            ("Value('trigger', 0)", (1.0, 0.0, 0.0, 0.0, 0.0)),
            ("Touch('a-button', false)", (0.0,) * 5),
        ):
            page.run(f"device.controllers.right.updateButton{button}, 0")
            wait(lambda fingers=fingers: human.pose.right_fingers == fingers, f"fingers {fingers} by {button}")
        page.run("device.controllers.right.updateButtonValue('squeeze', 1), 0")
        wait(lambda: human.pose.right_closed, "the hand closes")
        assert human.pose.right_fingers[2:] == (1.0, 1.0, 1.0)
        page.run("device.controllers.right.updateButtonValue('squeeze', 0), 0")
        page.run("device.controllers.right.updateButtonValue('a-button', 1), 0")
        wait(lambda: human.pose.right_fingers == VICTORY, "a button makes the person's own pose")
        page.run("device.controllers.right.updateButtonValue('thumbstick', 1), 0")
        wait(lambda: human.pose.right_shears, "pressing the stick takes the shears into that hand")
        assert not human.pose.left_shears
        page.run("device.controllers.right.updateButtonValue('thumbstick', 0), 0")
        page.run("vinesim.viewer.shears.toggle('right'), 0")
        wait(lambda: not human.pose.right_shears, "they are put away")
        with live.paused():
            hand = "vinesim.viewer.world.bodies + 1 + vinesim.viewer.world.names.indexOf('viewer/right_hand')"
            z = page.run(f"vinesim.viewer.world.place({hand}).z")
            page.run("device.controllers.right.position.y += 0.2, 0")
            wait(
                lambda: page.run(f"vinesim.viewer.world.place({hand}).z") == pytest.approx(z + 0.2, abs=0.01),
                "the page draws the hand where the controller is, while the client stands still",
            )
        assert not page.run(WRIST)["visible"]
        for intention in INTENTIONS[1:3]:
            page.run("device.controllers.right.updateAxes('thumbstick', 0, 1), 0")
            wait(lambda what=intention: human.intention == what, "pulling the right stick back chooses the next one")
            page.run("device.controllers.right.updateAxes('thumbstick', 0, 0), 0")
            is_drawn_anew(page)
        wrist = page.run(WRIST)
        assert wrist["visible"]
        assert [line for line, is_chosen in wrist["lines"] if is_chosen] == [INTENTIONS[2]]
        assert [line for line, _ in wrist["lines"][1 : len(INTENTIONS)]] == list(INTENTIONS[1:])
        assert wrist["away"] < 0.25, "it is at the left hand [m]"
        page.run("vinesim.viewer.shears.told.length = 0, document.getElementById('notices').replaceChildren()")
        page.run("import(new URL('notices.js', location)).then(({ say }) => say('A bunch was cut.')).then(() => 0)")
        wait(lambda: page.run(WRIST)["lines"][-1] == ["A bunch was cut.", False], "sentences are read at the wrist")
        page.run("device.primaryInputMode = 'hand', device.hands.right.position.set(0.2, 1.3, -0.5), 0")
        page.run("device.hands.right.quaternion.set(0, 0, 0, 1), 0")
        wrist = np.array([*(start[:2] + 0.5 * ahead + 0.2 * right), 1.3])
        wait(lambda: np.linalg.norm(human.pose.right[:3] - wrist) < 0.15, "a hand without a controller is followed")
        wait(lambda: not human.pose.right_closed and max(human.pose.right_fingers) < 0.6, "it is open")
        page.run("device.hands.right.updatePinchValue(1), 0")
        wait(lambda: human.pose.right_closed, "a pinch takes hold")
        hip = (0.25, 0.85, -0.2)
        ahead_of_her = (0.2, 1.3, -0.5)
        pinch(page, hip)
        wait(lambda: human.pose.right_shears, "a pinch at the hip takes the shears into that hand")
        pinch(page, ahead_of_her)
        wait(lambda: page.run("vinesim.viewer.shears.told.length") == 1, "a pinch elsewhere closes them, the first not")
        pinch(page, hip)
        wait(lambda: not human.pose.right_shears, "a pinch at the hip puts them away")
        page.run("device.primaryInputMode = 'controller', 0")
        page.run("device.controllers.left.updateAxes('thumbstick', 0, -1), 0")
        wait(lambda: np.dot(human.pose.head[:2] - head[:2], ahead) > 0.5, "the stick walks ahead")
        page.run("device.controllers.left.updateAxes('thumbstick', 0, 0), 0")
        page.run("device.controllers.right.updateAxes('thumbstick', 1, 0), 0")
        wait(lambda: frames.to_yaw(human.pose.head[3:]) < 0.0, "the stick turns to the right")
        page.run("device.controllers.right.updateAxes('thumbstick', 0, 0), 0")
        page.run("device.controllers.right.quaternion.set(-Math.sin(0.4), 0, 0, Math.cos(0.4)), 0")  # down by 0.8 rad
        page.run("device.controllers.right.updateAxes('thumbstick', 0, -1), 0")
        mark = "(({ mark }) => [mark.visible, mark.position.x, -mark.position.z])(vinesim.viewer.headset)"
        wait(lambda: page.run(mark)[0], "the stick pushed ahead marks a place on the floor")
        is_drawn_anew(page)
        place = np.array(page.run(mark)[1:])
        head = human.pose.head.copy()
        yaw = frames.to_yaw(head[3:])
        gone = 0.4 + 1.2 / np.tan(0.8)  # the controller is 0.4 m ahead of the head, 1.2 m above the floor
        expected = head[:2] + gone * np.array([np.cos(yaw), np.sin(yaw)])
        assert np.linalg.norm(place - expected) < 0.35, "where the controller points"
        page.run("device.controllers.right.updateAxes('thumbstick', 0, 0), 0")
        wait(lambda: np.linalg.norm(human.pose.head[:2] - place) < 5e-3, "letting go jumps there")
        feet = np.stack([human.pose.left_foot, human.pose.right_foot])[:, :2]
        assert np.linalg.norm(feet.mean(0) - place) < 0.2, "with both feet"
        assert not page.run(mark)[0]
        assert page.run("vinesim.calls") <= 2 * MAX_CALLS
        assert page.errors == []


@pytest.mark.long
@pytest.mark.xdist_group("browser")
def test_a_page_comes_back_by_itself_and_says_what_happened_meanwhile(page):
    """Its tab is hidden, its connection is cut, its client is started again; and what a browser lacks is said."""
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus) as live:
        open_page(page, live, "Object.defineProperty(window, 'isSecureContext', {value: false});")
        assert "--page-lan" in page.run("document.getElementById('notices').textContent")
        hosts = "[...new Set(performance.getEntriesByType('resource').map(entry => new URL(entry.name).origin))]"
        assert page.run(hosts) == [page.run("location.origin")]
        page.run("vinesim.viewer.absence.long = 0.3, 0")
        wait(lambda: page.run("vinesim.viewer.absence.pictures") > 5, "its first pictures are drawn")
        told = "vinesim.viewer.absence.told.join(' ')"

        with live.paused():  # so that the state with the pick is on its way when the tab is hidden
            wait(lambda: page.run("vinesim.tick") == live.client.physics.tick, "the page has drawn the newest state")
            page.run("vinesim.viewer.renderer.setAnimationLoop(null), 0")  # as browsers do with tabs that are hidden
            sent = live.server.states_sent
            live.due.append(lambda: live.client.physics.pick(BUNCH))
        wait(lambda: page.run("vinesim.viewer.world.picked.size") == 1, "the first state after that holds the pick")
        wait(lambda: live.server.states_sent == sent + WINDOW, "as many states as there may be are on their way")
        is_long = lambda: page.run(f"{IS_LONG}(vinesim.viewer, {live.client.physics.tick})")  # noqa: E731
        wait(is_long, "much more than the usual time between two pictures passes")
        assert live.server.states_sent - sent <= WINDOW
        page.run("vinesim.viewer.renderer.setAnimationLoop(() => vinesim.viewer.draw())")
        wait(lambda: "unseen: 1 bunch was picked." in page.run(told), "the page tells of the picked bunch")
        assert "1 bunch was picked" in page.run("document.getElementById('notices').textContent")

        page.run("""(({ absence }) => {
          absence.told.length = 0;
          Object.assign(absence, { long: 0.02, usual: 0 });
          window.cut = vinesim.viewer.socket;
          cut.close();
        })(vinesim.viewer)""")
        wait(
            lambda: page.run("vinesim.viewer.socket !== cut && vinesim.viewer.socket.readyState === 1"), "a new socket"
        )
        wait(lambda: "unseen" in page.run(told), "the page tells that it was away")
        tree = live.client.model.body_tree[live.client.model.bunch_body[BUNCH]]
        body = live.client.model.bodies_of(tree).stop - 1
        port = live.server.port
        rest = live.client.model.forward_kinematics(live.client.model.joint_settled)[body, :3]
        carried = f"vinesim.viewer.world.place({body}).toArray()"
        page.run(f"vinesim.viewer.world.poses.image.data[{8 * body}] += 1, 0")  # as if it had moved for good
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus, port=port) as live:
        wait(lambda: "started again" in page.run(told), "the page knows that the client is a new one")
        assert page.run("vinesim.viewer.world.picked.size") == 0
        np.testing.assert_allclose(page.run(carried), rest, atol=0.02)
        assert page.run("vinesim.failure") is None
        assert page.errors == []

        missing = "document.querySelector('#failure:not([hidden])')?.textContent"
        for lacks, said in (
            ("HTMLCanvasElement.prototype.getContext = () => null;", "no WebGL 2"),
            ("delete HTMLScriptElement.prototype.noModule;", "too old"),
        ):
            page.open(live.server.address, before=lacks)
            wait(lambda said=said: said in (page.run(missing) or ""), said)


@pytest.mark.slow
@pytest.mark.xdist_group("browser")
def test_a_later_page_of_a_person_watches_until_it_is_loaded_again(page):
    """It says who controls the person, has the controls of a spectator, and says when the person is free."""
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus, is_person=True) as live:
        head = tuple(live.client.humans["viewer"].pose.head.tolist())
        live.world.take(99, PageInput(1, head, TrackedPerson(head)))  # the other page
        open_page(page, live)
        notices = "document.getElementById('notices').textContent"
        visible = "document.getElementById('{}').checkVisibility()"
        assert "Another page controls the person" in page.run(notices)
        assert not page.run("vinesim.viewer.isPerson")
        assert not page.run(visible.format("tools"))
        assert page.run("document.querySelector('#guide li[aria-current]').dataset.name") == "look"
        assert page.run("document.querySelector('#guide li:last-child').dataset.name") == "follow"
        wait(lambda: page.run("vinesim.viewer.labels.has('viewer')"), "the person's name")
        press(page, "Space")
        is_drawn_anew(page)
        assert not live.client.humans["viewer"].pose.right_closed
        live.world.leave(99)
        wait(lambda: "page that controlled the person was closed" in page.run(notices), "it says so")
        open_page(page, live)
        assert page.run("vinesim.viewer.isPerson")
        wait(lambda: live.world._driver is not None, "this page controls the person")

        live.world._driver = 99  # two pages were opened at once, and the other one was first
        wait(
            lambda: page.run("window.vinesim?.viewer?.isPerson === false"), "the page is loaded again, and watches", 30
        )
        assert page.errors == []


@pytest.mark.slow
@pytest.mark.xdist_group("browser")
@pytest.mark.parametrize("before", [*long(""), OTHER_CARD], ids=["no graphics card", "a slow one"])
def test_a_spectator_alone_and_a_slow_browser_are_told_so_and_buttons_follow_who_comes(page, before):
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus) as live, touch_screen(page, 390, 844):
        notices = "document.getElementById('notices').textContent"
        slow = "vinesim.viewer.first.times = Array(12).fill(1), 0"
        with live.paused():  # a page without states gives no advice
            page.open(live.server.address, before=before)
            wait(lambda: page.run("window.vinesim?.viewer !== undefined"), "the vineyard is loaded")
            assert page.run("vinesim.viewer.isSlow") is not bool(before), "without a card from the start"
            page.run(slow)
        wait(lambda: "Nobody else is here yet" in page.run(notices), "a spectator without other actors is told so")
        assert "draws slowly" in page.run(notices)
        wait(lambda: 0 < page.run("vinesim.triangles") <= 90_000, "fewer triangles")
        pixels = page.run("vinesim.viewer.renderer.domElement.width * vinesim.viewer.renderer.domElement.height")
        assert 200_000 < pixels <= 250_000
        assert page.run("vinesim.viewer.renderer.getContext().getContextAttributes().antialias") is bool(before)

        pose = standing_pose(frames.pose(np.array([-8.0, -3.0, 0.0])))
        live.due.append(lambda: live.client.physics.add_human(HumanSpec("anna", 1, pose)))
        wait(lambda: page.run("vinesim.viewer.actors().length") == 1, "anna has come")
        tap(
            page,
            page.run(
                "(({ x, y }) => [x + 5, y + 5])(document.querySelector('#overlays summary').getBoundingClientRect())"
            ),
        )
        tap_button(page, "follow")
        wait(lambda: np.linalg.norm(live.client.pose[:2] - pose.head[:2]) < 4.0, "the eyes have followed her")
        assert page.run("vinesim.viewer.labels.has('anna')")
        tap_button(page, "label")
        wait(lambda: page.run("vinesim.viewer.labels.size") == 0, "without her name")
        assert page.errors == []


@pytest.mark.slow
@pytest.mark.xdist_group("browser")
@pytest.mark.parametrize("is_person", [False, True], ids=["spectator", "person"])
def test_controls_fit_on_desktops_and_phones_and_are_reached_by_keys(page, is_person):
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus, is_person=is_person) as live:
        open_page(page, live)
        told = {
            "closures": 2,
            "between": ["", ""],
            "said": ["The shears in the left hand missed: there was no wood.", "They cut 1 bunch."],
        }
        state = {"shears": told, "held": ["", ""]}
        page.run(f"(({{ shears }}) => {{ shears.closures = 0; shears.take({state}); }})(vinesim.viewer)")
        page.run("document.getElementById('timeline').hidden = false")
        for width, height in ((1280, 720), (1024, 600), (844, 390), (390, 844)):
            page.resize(width, height)
            wait(lambda width=width: page.run("innerWidth") == width, "the page has this size")
            assert page.run(MISPLACED) == [], (width, height)
            assert page.run(f"{LONG_STATE}, {MISPLACED}") == [], (width, height, "with a long sentence")
        controls = page.run(f"{CONTROLS}.length")
        folded = page.run("[...document.querySelectorAll('details')].filter((one) => one.checkVisibility()).length")
        assert folded == (3 if is_person else 1), "overlays, work at the right hand and intentions"
        assert controls == folded + 6 + is_person * 3, "first steps, hear, speak, timeline; hand and shears"
        for _ in range(2):
            page.run("document.querySelectorAll('details').forEach((one) => { one.open = !one.open; })")
            assert page.run(MISPLACED) == [], "folded and not"
        page.run("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
        controls = page.run(f"{CONTROLS}.length")
        assert controls == folded + 13 + is_person * (4 + len(INTENTIONS)), (
            "with overlays, work at the hand and intentions"
        )
        for _ in range(controls):
            page.call("Input.dispatchKeyEvent", type="keyDown", key="Tab", code="Tab", windowsVirtualKeyCode=9)
            page.run("document.activeElement.isReached = true")
        assert page.run(f"{CONTROLS}.filter((one) => !one.isReached).map((one) => one.outerHTML)") == []
        assert page.errors == []


@pytest.mark.long
@pytest.mark.xdist_group("browser")
@pytest.mark.parametrize(("yaw", "share"), [(0.0, 1.0), (1.5, 0.8), (4.0, 0.8)], ids=["into", "along", "out"])
def test_what_the_eyes_can_see_is_drawn_and_what_is_behind_them_only_casts_shadows(page, yaw, share):
    """Of all clusters that a list for every direction has, those left out are not in the picture, nor will be when the
    eyes turn until the next list; and they are there for the sun."""
    script = """(({ world, eyes, camera }) => {
      const rows = (list) => new Set(world.draws.flatMap((levels, kind) => kind === 6 ? [] :
        levels.flatMap((level) => [...level[list].rows.subarray(0, level[list].count)])));
      const { first, ball } = world.plantClusters;
      const ahead = camera.position.clone().set(Math.cos(eyes.yaw), Math.sin(eyes.yaw), 0);
      const eye = camera.position.clone().set(...eyes.place), field = vinesim.viewer.diagonal, turn = 0.35;
      const list = (way, field) => {
        world.listedAt = null;
        world.coarser = 1;
        world.budget = 1e7;
        world.list(eye, way, { field, turn });
        return [rows("seen"), rows("unseen")];
      };
      const lists = [list(ahead, Math.PI), list(ahead, field)];
      const [[all], [seen, unseen]] = lists, off = [];
      let lost = 0;
      first.forEach((row, k) => {
        if (!all.has(row) || seen.has(row)) return;
        const way = camera.position.clone().set(...ball.subarray(4 * k, 4 * k + 3)).sub(eye);
        off.push(way.angleTo(ahead) - Math.asin(Math.min(1, ball[4 * k + 3] / way.length())));
        lost += !unseen.has(row) && way.length() < 9;
      });
      const straight = [...first.keys()].filter((k) => all.has(first[k]) && k % 100 === 0).every((k) => {
        const way = camera.position.clone().set(...ball.subarray(4 * k, 4 * k + 3)).sub(eye);
        return list(way.normalize().multiplyScalar(1 + 1e-7), field)[0].has(first[k]);
      });
      return { all: all.size, seen: seen.size, least: Math.min(...off), bound: field + turn, lost, straight };
    })(vinesim.viewer)"""
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus) as live:
        open_page(page, live)
        page.run(f"Object.assign(vinesim.viewer.eyes, {{ yaw: {yaw}, pitch: 0 }}), 0")
        is_drawn_anew(page)
        found = page.run(script)
        is_drawn_anew(page)
        page.run("window.listedBefore = vinesim.viewer.world.listedAt, 0")
        page.resize(640, 240)
        wait(lambda: page.run("vinesim.viewer.world.listedAt !== listedBefore"), "a wider picture has its own list")
    assert 0 < found["seen"] < share * found["all"]
    assert found["least"] >= found["bound"]
    assert found["lost"] == 0
    assert found["straight"], "also what is right before the eyes, whatever is rounded"


@pytest.mark.long
@pytest.mark.xdist_group("browser")
def test_who_flies_on_in_a_large_vineyard_sees_what_grows_there(page):
    """Of 5,000 primitives that a page may have, all that are near; picked bunches stay where they are."""
    loaded = """(({ plantClusters: { ball, size }, plants, around, reach }) => {
      const { place } = vinesim.viewer.eyes;
      const away = (k) => Math.hypot(...place.map((x, axis) => ball[4 * k + axis] - x));
      return { within: size.reduce((sum, _, k) => sum + (away(k) < 0.4 * reach - 1e-6), 0), plants, reach,
        off: Math.hypot(around.x - place[0], around.y - place[1], around.z - place[2]) };
    })(vinesim.viewer.world)"""
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus, most=5000) as live:
        live.due.append(lambda: live.client.physics.pick(BUNCH))
        open_page(page, live)
        number = "vinesim.viewer.world.names.findIndex((name) => name.startsWith('bunch/'))"
        wait(lambda: page.run(number) >= 0, "the picked bunch")
        with live.paused():
            balls = decode(PageWorld(live.client).scene())[1]["ball"].reshape(-1, 4)
        assert page.run(loaded)["plants"] == 5000
        bunches = bunch_centres(live.client.model)
        there = bunches[np.argmax(np.linalg.norm(bunches - live.bunch, axis=1))] - [0.7, 0.0, 0.0]
        page.run(f"Object.assign(vinesim.viewer.eyes, {{ place: {there.tolist()} }}), 0")
        wait(lambda: page.run(loaded)["off"] < 1e-3, "the plants around another place")
        found = page.run(loaded)
        assert found["reach"] > 0.5
        assert (
            found["within"]
            == (np.linalg.norm(balls[:, :3] - there, axis=1) < min(LOADED.values()) * found["reach"] - 1e-6).sum()
        )
        carrier = f"vinesim.viewer.world.bodies + 1 + {number}"
        bunch = page.run(f"vinesim.viewer.world.place({carrier}).toArray()")
        np.testing.assert_allclose(bunch[:2], live.bunch[:2], atol=0.3)
        assert page.run("vinesim.viewer.world.rigidClusters.first.length") > 0
        assert page.errors == []


@pytest.mark.long
@pytest.mark.xdist_group("browser")
def test_names_stand_just_above_heads_near_and_far_and_stay_in_the_picture(page):
    """By projection: eyes at a known place that look along x, and the highest point of a hat above its eyes. One person
    has turned and tilted the head."""
    width = 480
    height = 360
    level = 1.65
    places = {"anna": (0.7, -0.1), "ben": (3.0, 0.8), "clara": (12.0, -3.0)}
    tilted = {"ben": frames.exp(np.array([0.5, 0.3, 0.4]))}
    shapes = appearance.load_human_model(1.75).parts["head"]
    hat = np.concatenate([shape.mesh.corners.reshape(-1, 3) for shape in shapes if shape.mesh is not None])
    focal = height / 2 / np.tan(np.radians(30.0))
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus) as live:
        x, y = live.client.pose[:2]
        for k, (name, (ahead, left)) in enumerate(places.items()):
            pose = standing_pose(frames.pose(np.array([x + ahead, y + left, 0.0]), frames.from_yaw(np.pi)))
            head = frames.compose(pose.head, frames.pose(np.zeros(3), tilted.get(name, frames.IDENTITY)))
            pose = dataclasses.replace(pose, head=head)
            live.due.append(lambda spec=HumanSpec(name, k + 1, pose): live.client.physics.add_human(spec))
        open_page(page, live)
        page.resize(width, height)
        page.run(f"Object.assign(vinesim.viewer.eyes, {{ place: [{x}, {y}, {level}], yaw: 0, pitch: 0 }}), 0")
        boxes = """Object.fromEntries([...vinesim.viewer.labels].map(([name, label]) => {
          const { left, right, top, bottom, height } = label.getBoundingClientRect();
          return [name, { middle: (left + right) / 2, left, right, top, bottom, height }];
        }))"""
        wait(lambda: page.run(boxes).keys() == places.keys(), "three names")
        is_drawn_anew(page)
        shown = page.run(boxes)
        for name, (ahead, left) in places.items():
            head = standing_pose(frames.pose(np.array([ahead, left, 0.0]), frames.from_yaw(np.pi))).head
            scale = focal / head[0]
            top = head[2] + frames.rotate(tilted.get(name, frames.IDENTITY), hat)[:, 2].max()
            assert shown[name]["middle"] == pytest.approx(width / 2 - left * scale, abs=2.0), name
            above = height / 2 - (top - level) * scale - shown[name]["bottom"]
            assert 0.0 < above < 0.06 * scale + 2.0, (name, "less than 6 cm above the hat [px]", above)
            assert 14.0 < shown[name]["height"] < 26.0, name
        assert shown["anna"]["height"] > shown["ben"]["height"] > shown["clara"]["height"]
        plants = "vinesim.viewer.world.draws.slice(1, 3).flat().reduce((sum, { triangles }) => sum + triangles, 0)"
        assert page.run("vinesim.viewer.world.triangles") > 10_000, "people have more triangles than the page may draw"
        assert 2_000 < page.run(plants) <= 5_000, "but berries and leaves are drawn, too"

        page.run("vinesim.viewer.eyes.pitch = -0.5, 0")  # the tops of near heads are above the picture
        is_drawn_anew(page)
        bar = page.run("document.getElementById('top').getBoundingClientRect().bottom")
        shown = page.run(boxes)
        assert "anna" in shown
        assert all(bar <= box["top"] and box["bottom"] <= height for box in shown.values())
        page.run("vinesim.viewer.eyes.yaw = 2.5, 0")
        wait(lambda: page.run(boxes) == {}, "the picture shows no actor")
        assert page.errors == []


@pytest.mark.long
@pytest.mark.xdist_group("browser")
def test_the_timeline_of_a_recording(page, tmp_path):
    """Buttons and slider of the page: the recording plays, pauses, goes back to before a pick and on to after it."""
    replay, _ = replay_of_a_pick(tmp_path / "run.mcap")
    stop = threading.Event()

    def run(server):
        while not stop.wait(0.005):
            replay.step(server)

    def go_to(seconds):
        page.run(f"""(({{ slider }}) => {{
          slider.value = {seconds};
          slider.dispatchEvent(new Event("input"));
          slider.dispatchEvent(new Event("change"));
        }})(vinesim.viewer.timeline)""")

    def is_at(seconds):
        shown, told = page.run(
            "[Number(vinesim.viewer.timeline.slider.value), vinesim.viewer.timeline.status.position]"
        )
        return abs(shown - told) < 0.11 and abs(told - seconds) < 0.05

    with PageServer(replay.world) as server:
        thread = threading.Thread(target=run, args=(server,))
        thread.start()
        try:
            page.resize(640, 320)
            page.open(server.address + "?triangles=10000&rate=10&shadows=0")
            wait(lambda: page.run("window.vinesim?.drawn >= 1 || window.vinesim?.failure"), "a state is drawn")
            assert page.run("vinesim.failure") is None
            picked = "vinesim.viewer.world.picked.size"
            button = "document.querySelector('#timeline button')"
            page.run(f"if ({button}.textContent === 'pause') {button}.click()")  # a slow machine may be at the end
            wait(lambda: page.run(f"{button}.textContent") == "play", "it pauses")
            go_to(PICKED_AT + 0.6)
            wait(lambda: is_at(PICKED_AT + 0.6) and page.run(picked) == 1, "the bunch is picked there")
            go_to(PICKED_AT - 0.6)
            wait(lambda: is_at(PICKED_AT - 0.6) and page.run(picked) == 0, "it hangs there")
            assert page.run("vinesim.viewer.absence.told.length") == 0, "nothing passed unseen: it was asked for"
            page.run(f"{button}.click()")
            wait(lambda: page.run(picked) == 1, "it plays on to the pick")
            assert page.errors == []
        finally:
            stop.set()
            thread.join()
