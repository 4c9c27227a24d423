"""Robots and people of other clients on their way in: a thread reads and compiles them, and no tick waits for it."""

from __future__ import annotations

import concurrent.futures
import logging
import tempfile
from collections.abc import Callable
from pathlib import Path

from vinesim.client.remote.remote_human import RemoteHuman, human_spec
from vinesim.net.codec.messages import Hello, is_valid_name
from vinesim.physics.rigid.rigid_world import RigidWorld
from vinesim.physics.rigid.world_core import CompiledWorld
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.errors import DescriptionError
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.remote_robot import RemoteRobot
from vinesim.scene.values import HumanUpdate, RobotUpdate

log = logging.getLogger(__name__)

Prepared = tuple[RobotDescription | None, CompiledWorld]
"""A robot's description, or None for a person, and the world with it."""


class RemoteSpawner:
    """Who is expected, and how far that is."""

    def __init__(
        self, rigid: RigidWorld, own: RobotDescription | None, executor: concurrent.futures.Executor | None = None
    ) -> None:
        """``own``: a description that needs not be read again, if any; without ``executor`` all is done at once."""
        self.rigid, self.own = rigid, own
        self._executor = executor
        self._expected: dict[str, Hello] = {}
        self._coming: dict[str, concurrent.futures.Future[Prepared]] = {}

    def __contains__(self, name: str) -> bool:
        return name in self._expected

    def enqueue(self, hello: Hello) -> None:
        """Somebody has introduced itself; where it is will be known with its first pose."""
        self._expected[hello.name] = hello

    def cancel(self, name: str) -> None:
        """It has gone again."""
        self._expected.pop(name, None)
        self._coming.pop(name, None)

    def spawn(self, name: str, update: RobotUpdate | HumanUpdate) -> RemoteRobot | RemoteHuman | None:
        """The copy of whoever is expected, standing where ``update`` says; None as long as it is not ready.

        Who cannot be shown is named in the log and no more expected.
        """
        hello = self._expected[name]
        if name not in self._coming:
            self._coming[name] = self._start(lambda: self._prepare(hello, update))
        if not self._coming[name].done():
            return None
        try:
            description, draft = self._coming.pop(name).result()
        except ValueError as error:
            log.warning("the %s of %s cannot be shown: %s", hello.kind, name, error)
            self.cancel(name)
            return None
        if not self.rigid.adopt(draft):
            return None  # somebody else came or went meanwhile: once more, from the next tick on
        self.cancel(name)
        if description is None or not isinstance(update, RobotUpdate):
            return RemoteHuman(self.rigid, name)
        other = RemoteRobot(self.rigid, description, name, hello.index, update.base_q, is_in_world=True)
        self.rigid.place_robot(name, update.base_q, update.position)
        return other

    def _start(self, work: Callable[[], Prepared]) -> concurrent.futures.Future[Prepared]:
        if self._executor is not None:
            return self._executor.submit(work)
        done: concurrent.futures.Future[Prepared] = concurrent.futures.Future()
        try:
            done.set_result(work())
        except ValueError as error:
            done.set_exception(error)
        return done

    def _prepare(self, hello: Hello, update: RobotUpdate | HumanUpdate) -> Prepared:
        if isinstance(update, HumanUpdate):
            return None, self.rigid.compile_with(human_spec(hello, update), is_remote=True)
        description = resolve_description(hello, self.own)
        if hello.joints not in (-1, len(description.drives)):
            raise DescriptionError(f"it announces {hello.joints} joints, its URDF drives {len(description.drives)}")
        return description, self.rigid.compile_with(description.to_spec(hello.name, hello.index, update.base_q))


def resolve_description(hello: Hello, own: RobotDescription | None) -> RobotDescription:
    """The robot another client introduced: one that is known here by the same text, or read from the text it sent."""
    if own is not None and hello.urdf == own.urdf:
        return own
    name = hello.robot if is_valid_name(hello.robot) else "robot"  # a stranger's word, and it becomes a file's name
    try:
        known = load_description(name)
        if known.urdf == hello.urdf:
            return known
    except DescriptionError:
        pass
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{name}.urdf"
        file.write_text(hello.urdf)
        return load_description(file)
