"""Controls of the page in a real browser: contrast of their text, focus that is seen, a gamepad."""

import json

import numpy as np
import pytest

from tests.support.live_page import CONTROLS, LiveVineyard, is_drawn_anew, open_page, touch_screen
from tests.support.waiting import wait
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.human_posture import standing_pose
from vinesim.scene.values import HumanSpec

LEAST_CONTRAST = 4.5
LEAST_OF_LARGE = 3.0
"""Of text, and of large text (WCAG 2.2, 1.4.3)."""
COLOURS = """
const linear = (c) => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4;
const luminance = (rgb) => [0.2126, 0.7152, 0.0722].reduce((sum, share, k) => sum + share * linear(rgb[k] / 255), 0);
const contrast = (a, b) => {
  const [dark, light] = [luminance(a), luminance(b)].sort((x, y) => x - y);
  return (light + 0.05) / (dark + 0.05);
};
const parse = (text) => {
  const [r, g, b, alpha = 1] = text.match(/[\\d.]+/g).map(Number);
  return { rgb: [r, g, b], alpha };
};
const over = ({ rgb, alpha }, below) => rgb.map((c, k) => alpha * c + (1 - alpha) * below[k]);
"""
"""WCAG's relative luminance and contrast of sRGB colours, and what a translucent colour is over another one."""
CONTRASTS = (
    "(() => {"
    + COLOURS
    + """
  const picture = document.getElementById("view");
  // the picture, which is drawn in between, hides the backgrounds of what contains it
  const layers = (element) => element === null || element.contains(picture) ? []
    : [...layers(element.parentElement), parse(getComputedStyle(element).backgroundColor)];
  const isShown = (one) => one.checkVisibility({ visibilityProperty: true });
  const shown = [...document.querySelectorAll("body *")].filter(isShown);
  return shown.filter((one) => one.localName === "option" || one.localName === "select"
      || [...one.childNodes].some((node) => node.nodeType === Node.TEXT_NODE && node.textContent.trim()))
    .map((element) => {
      const { color, fontSize, fontWeight, backgroundImage, opacity } = getComputedStyle(element);
      const backgrounds = element.localName === "option" ? layers(element).slice(-1) : layers(element);
      let least = Infinity;
      for (let grey = 0; grey < 256; ++grey) {
        const below = backgrounds.reduce((under, layer) => over(layer, under), [grey, grey, grey]);
        least = Math.min(least, contrast(over(parse(color), below), below));
      }
      const size = parseFloat(fontSize), isLarge = size >= 24 || size >= 18.66 && fontWeight >= 700;
      return { text: element.textContent.trim().slice(0, 40), tag: element.localName, least, isLarge,
        isPlain: backgroundImage === "none" && opacity === "1" };
    });
})()
"""
)
"""Of all elements with text of their own: the least contrast over pictures of any grey. Of colours there is no worse:
contrast is of luminances, and the greys have all that pictures have."""
FOCUS = (
    "(() => {"
    + COLOURS
    + """
  const one = document.activeElement, { outlineStyle, outlineWidth, outlineColor, boxShadow } = getComputedStyle(one);
  one.isReached = true;
  const ring = boxShadow === "none" ? null : parse(boxShadow.match(/rgba?\\([^)]*\\)/)[0]);
  return { control: one.outerHTML.slice(0, 60), style: outlineStyle, width: parseFloat(outlineWidth),
    contrast: ring === null ? 1 : contrast(parse(outlineColor).rgb, ring.rgb), alpha: ring?.alpha };
})()
"""
)
"""Outline of what has the focus, and its contrast to the ring around it, which is seen before any picture."""
PAD = """
window.pads = [null, { id: "scripted pad", index: 1, connected: true, mapping: "standard", timestamp: 0,
  axes: [0, 0, 0, 0], buttons: Array.from({ length: 17 }, () => ({ pressed: false, touched: false, value: 0 })) }];
navigator.getGamepads = () => window.pads;
"""
"""A gamepad whose sticks and buttons a test moves."""


FLOWN = """
((pad, seconds) => {
  const { eyes } = vinesim.viewer, { place, yaw, pitch } = eyes, before = window.pads;
  Object.assign(eyes, { place: [1, 2, 3], yaw: 0, pitch: 0 });
  window.pads = pad;
  const moved = eyes.update(seconds);
  const way = eyes.place.map((value, axis) => value - [1, 2, 3][axis]);
  const found = { moved, way, yaw: eyes.yaw, pitch: eyes.pitch };
  window.pads = before;
  Object.assign(eyes, { place, yaw, pitch });
  return found;
})
"""
"""How far eyes that look along x fly and turn by gamepads in a time [s]."""


def show_everything(page, live):
    """Show all that the page may show: names and owners of what is there, sentences, a failure, the timeline."""
    x, y = live.bunch[:2]
    pose = standing_pose(frames.pose(np.array([x + 1.5, y, 0.0])))
    live.due.append(lambda: live.client.physics.add_human(HumanSpec("anna", 1, pose)))
    wait(lambda: page.run("vinesim.viewer.labels.has('anna')"), "a name is shown")
    page.run("""Object.assign(document.getElementById('names').appendChild(document.createElement('div')),
      { className: 'owner', textContent: 'tree/1: anna' }), 0""")
    page.run(
        "import(new URL('notices.js', location)).then(({ say }) => say('A sentence.', { stays: true })).then(() => 0)"
    )
    page.run("""['timeline', 'failure', 'enter'].forEach((id) => { document.getElementById(id).hidden = false; });
      document.querySelector('#timeline select').append(new Option('1 x', 1));
      document.querySelector('#timeline span').textContent = '1.0 / 2.0 s';
      document.querySelector('#timeline button').textContent = 'pause';
      document.querySelector('#sound span').textContent = 'no microphone';
      document.getElementById('failure').textContent = 'A failure.';
      document.querySelectorAll('details').forEach((one) => { one.open = true; })""")


@pytest.mark.long
@pytest.mark.xdist_group("browser")
@pytest.mark.parametrize("is_person", [False, True], ids=["spectator", "person"])
def test_text_has_contrast_before_any_picture_and_focus_is_seen(page, is_person):
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus, is_person=is_person) as live:
        open_page(page, live)
        show_everything(page, live)
        texts = {}

        def weak():
            found = page.run(CONTRASTS)
            texts.update((one["text"], one) for one in found)
            assert all(one["isPlain"] for one in found), "what the script cannot tell the contrast of"
            return [one for one in found if one["least"] < (LEAST_OF_LARGE if one["isLarge"] else LEAST_CONTRAST)]

        assert weak() == []
        page.run("document.querySelectorAll('button').forEach((one) => one.setAttribute('aria-pressed', 'true'))")
        assert weak() == [], "pressed"
        page.run("document.querySelector('#guide button').click(); document.getElementById('keys').click()")
        assert weak() == [], "with the list of keys instead of the first steps"
        assert {
            "A sentence.",
            "A failure.",
            "anna",
            "show",
            "hear",
            "M",
            "H",
            "1 x",
            "pause",
            "enter VR",
        } <= texts.keys()
        if is_person:
            assert {"grasp", "Space", "I am going to"} <= {text.strip() for text in texts}
        with touch_screen(page, 390, 844):
            wait(lambda: page.run("matchMedia('(pointer: coarse)').matches"), "the screen is touched")
            assert weak() == [], "on a phone"
        assert any("with two fingers" in text for text in texts)

        page.resize(1280, 720)
        for _ in range(page.run(f"{CONTROLS}.length")):
            page.call("Input.dispatchKeyEvent", type="keyDown", key="Tab", code="Tab", windowsVirtualKeyCode=9)
            focus = page.run(FOCUS)
            assert focus["style"] not in ("none", "auto"), focus
            assert focus["width"] >= 2.0, focus
            assert focus["contrast"] >= 3.0, focus
            assert focus["alpha"] == 1.0, focus
        assert page.run(f"{CONTROLS}.filter((one) => !one.isReached).map((one) => one.outerHTML)") == []
        assert page.errors == []


def pad_of(axes=(0.0, 0.0, 0.0, 0.0), *, sinks=0.0, rises=0.0, mapping="standard", connected=True):
    """A gamepad with its left stick, its right stick and its triggers pushed."""
    values = [0.0] * 17
    values[6:8] = sinks, rises
    buttons = [{"pressed": value > 0.0, "value": value} for value in values]
    return {"connected": connected, "mapping": mapping, "axes": axes, "buttons": buttons}


@pytest.mark.long
@pytest.mark.xdist_group("browser")
def test_a_spectator_flies_by_gamepad(page):
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus) as live:
        open_page(page, live, PAD)
        speed = page.run("vinesim.viewer.eyes.speed")

        def flown(*pads):
            return page.run(f"{FLOWN}({json.dumps(pads)}, 0.1)")

        right, back, turn, nod = np.eye(4)
        still = {"moved": False, "way": [0, 0, 0], "yaw": 0, "pitch": 0}
        for axes, way in ((-back, (1, 0, 0)), (back, (-1, 0, 0)), (-right, (0, 1, 0)), (right, (0, -1, 0))):
            found = flown(None, pad_of(axes.tolist()))
            assert found["moved"]
            np.testing.assert_allclose(found["way"], 0.1 * speed * np.array(way), atol=1e-9)
            assert found["yaw"] == found["pitch"] == 0.0
        np.testing.assert_allclose(flown(pad_of(rises=1.0))["way"], [0.0, 0.0, 0.1 * speed], atol=1e-9)
        np.testing.assert_allclose(flown(pad_of(sinks=1.0))["way"], [0.0, 0.0, -0.1 * speed], atol=1e-9)
        assert flown(pad_of(turn.tolist()))["yaw"] < -0.1, "the right stick to the right turns to the right"
        assert flown(pad_of((-nod).tolist()))["pitch"] > 0.1, "pushed ahead it looks up"
        assert not flown(pad_of(turn.tolist()))["moved"], "who only looks follows an actor still"

        assert flown(pad_of([0.14, -0.14, 0.14, -0.14], sinks=0.1)) == still, "sticks and triggers that rest"
        slow, half = (flown(pad_of((-share * back).tolist()))["way"][0] for share in (0.16, 0.575))
        assert 0.0 < slow < 0.02 * 0.1 * speed, "it starts slowly"
        assert half == pytest.approx(0.05 * speed), "half of its way beyond rest"
        assert flown(pad_of([0, -1, 1, 1], connected=False)) == still, "a pad that is gone, as some browsers keep it"
        other = flown(pad_of([0, -1, -1, -1], rises=1.0, mapping=""))
        np.testing.assert_allclose(other["way"], [0.1 * speed, 0.0, 0.0], atol=1e-9)
        assert other["yaw"] == other["pitch"] == 0.0, "axes of unknown meaning"

        # picture by picture, and as the client knows it
        start = live.client.pose.copy()
        page.run("pads[1].axes[1] = -1, 0")
        wait(lambda: live.client.pose[0] > start[0] + 0.3, "the eyes fly ahead")
        np.testing.assert_allclose(live.client.pose[1:3], start[1:3], atol=1e-6)
        page.run("pads[1].axes[1] = 0, 0")
        is_drawn_anew(page)
        place = page.run("vinesim.viewer.eyes.place")
        is_drawn_anew(page)
        assert page.run("vinesim.viewer.eyes.place") == place, "they stop"
        page.run("pads[1].axes[2] = 1, 0")
        wait(lambda: frames.to_yaw(live.client.pose[3:]) < -0.3, "they turn to the right")
        page.run("pads[1].axes = [0, -1, 0, 0], 0")
        wait(lambda: np.linalg.norm(live.client.pose[:3] - place) > 0.1, "they fly where they look")
        assert live.client.pose[1] < place[1]
        page.run("pads[1] = null, 0")
        is_drawn_anew(page)
        place = page.run("vinesim.viewer.eyes.place")
        is_drawn_anew(page)
        assert page.run("vinesim.viewer.eyes.place") == place, "without the pad they stop"
        assert page.errors == []
