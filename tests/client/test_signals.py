"""Indicator lights of robots and intentions of people: in time, in pictures, and between clients."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from tests.support import sensor_scenes
from tests.support.contact_scenes import cane
from vinesim.avatar.gestures import GESTURES
from vinesim.client.client import Client
from vinesim.client.signals import GestureLog, IntentionLog
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.human_posture import standing_pose
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.scene.builder import assemble
from vinesim.scene.spec import load_scene
from vinesim.scene.values import HandGestures, Intention, LightPattern, Lights
from vinesim.scene.values.signals import UNLIT
from vinesim.sensors.camera.camera import Camera
from vinesim.sensors.export.images import look_at


@pytest.mark.parametrize(
    ("pattern", "band"),
    [
        (LightPattern.NOTIFICATION, (0.4, 0.8)),
        (LightPattern.WARNING, (0.4, 0.8)),
        (LightPattern.ALARM, (1.4, 2.8)),
    ],
)
def test_flashes_are_those_of_iec_60073(pattern, band):
    """Slow or normal, half of the time lit; equal for equal times of the world, and so the same on all clients."""
    lights = Lights(pattern, (1, 2, 3))
    shown = [lights.shown(time) for time in np.arange(0.0, 50.0, 0.01) + 1e-6]
    assert set(shown) == {UNLIT, (1, 2, 3)}
    flashes = sum(before == UNLIT != now for before, now in itertools.pairwise(shown))
    assert band[0] <= (flashes + 1) / 50.0 <= band[1]
    assert shown.count(UNLIT) / len(shown) == pytest.approx(0.5, abs=0.01)
    assert Lights().shown(3.0) is None


def test_a_robots_lights_flash_in_a_picture():
    """F40, F41: a warning is amber and dark in turn; an alarm is red; off, the picture is that of before."""
    rigid = RigidWorld(sensor_scenes.empty())
    robot = Robot(rigid, load_description("vinebot"), "bot")
    pose = look_at(np.array([-1.2, -0.5, 0.7]), np.array([-0.4, -0.15, 0.46]))

    def picture() -> np.ndarray:
        primitives, _ = sensor_scenes.world(*rigid.visuals(), at=rigid.visual_q())
        return Camera(sensor_scenes.IDEAL, sensor_scenes.SMALL, sun=(0.6, 0.3, 0.5)).render(primitives, pose).rgb

    def show(pattern: LightPattern, time: float, color: tuple[float, float, float] | None = None) -> np.ndarray:
        robot.command_lights(pattern, color)
        robot.show_lights(time)
        return picture().astype(int)

    off = picture().astype(int)
    tower = None
    for pattern, time, color in (
        (LightPattern.WARNING, 0.1, None),
        (LightPattern.ALARM, 0.1, None),
        (LightPattern.NOTIFICATION, 0.1, (0, 0, 1)),
    ):
        lit = show(pattern, time, color)
        dark = show(pattern, time + 0.5 / {1: 0.4, 2: 0.8, 3: 2.0}[pattern], color)
        tower = (np.abs(lit - dark).max(-1) > 60) if tower is None else tower
        assert tower.sum() > 20
        red, green, blue = np.median(lit[tower], axis=0)
        assert {
            LightPattern.WARNING: red > blue + 60 and green > blue + 20,
            LightPattern.ALARM: red > max(green, blue) + 60,
            LightPattern.NOTIFICATION: blue > max(red, green) + 60,
        }[pattern], (pattern, red, green, blue)
        assert np.median(dark[tower]) < np.median(lit[tower])
    np.testing.assert_array_equal(show(LightPattern.OFF, 0.0), off)
    with pytest.raises(CommandError, match="from 0 to 1"):
        robot.command_lights(LightPattern.ALARM, (2.0, 0.0, 0.0))


def test_other_clients_see_the_lights_and_know_the_intentions():
    hub = MemoryHub(delay=0.02)
    now = 100.0
    scene = load_scene("demo")
    model = assemble([cane((0.0, 30.0, 2.0))])
    at = {"bot": frames.pose(np.zeros(3)), "eva": frames.pose(np.array([3.0, 0.0, 0.0]))}
    bot, eva = (
        Client(
            scene,
            model,
            description,
            hub.bus(name),
            name=name,
            pose=at[name],
            clock=lambda: now,
        )
        for name, description in (("bot", load_description("vinebot")), ("eva", None))
    )
    bot.robot.command_lights(LightPattern.ALARM)
    eva.humans["eva"].indicate("pick")
    colors = set()
    for _ in range(120):
        for client in (bot, eva):
            client.tick()
        hub.advance(0.01)
        now += 0.01
        if "bot" in eva.remote_actors:
            colors.add(eva.physics.rigid.robot("bot").indicator_color)
    assert bot.remote_actors["eva"].intention == "pick"
    assert colors >= {UNLIT, (255, 0, 0)}
    with pytest.raises(ValueError, match="no intention 'fly'"):
        eva.humans["eva"].indicate("fly")


def test_what_hands_show_is_named_and_told_when_it_changes():
    standing = standing_pose(frames.pose(np.zeros(3)))
    anna, bert = (dataclasses.replace(standing, right_fingers=GESTURES[name]) for name in ("point", "fist"))
    log = GestureLog()
    assert not log.update({})
    assert log.update({"bert": bert, "anna": anna})
    assert log.gestures == (HandGestures("anna", "open_hand", "point"), HandGestures("bert", "open_hand", "fist"))
    nearly = dataclasses.replace(anna, right_fingers=(0.9, 0.1, 0.8, 1.0, 0.7))
    assert not log.update({"anna": nearly, "bert": bert}), "fingers are never quite where they were"
    odd = dataclasses.replace(anna, left_fingers=(0.5,) * 5)
    assert log.update({"anna": odd, "bert": bert})
    assert log.gestures[0] == HandGestures("anna", "", "point")
    assert log.update({"anna": odd})
    assert [one.person for one in log.gestures] == ["anna"]


def test_intentions_have_a_start_and_an_end():
    log = IntentionLog()
    assert not log.update({"anna": "", "bert": ""}, 1.0)
    assert log.update({"anna": "pick", "bert": ""}, 2.0)
    assert not log.update({"anna": "pick", "bert": ""}, 3.0)
    assert log.intentions == (Intention("anna", "pick", 2.0),)
    assert log.update({"anna": "", "bert": "walk"}, 4.0)
    assert log.intentions == (Intention("anna", "pick", 2.0, 4.0), Intention("bert", "walk", 4.0))
    assert log.update({"anna": "carry"}, 5.0)
    assert log.intentions == (Intention("anna", "carry", 5.0), Intention("bert", "walk", 4.0, 5.0))
