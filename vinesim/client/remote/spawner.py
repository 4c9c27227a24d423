"""Adds the robots and humans of other clients: an executor loads and compiles them, and no step waits for it."""

from __future__ import annotations

import concurrent.futures
import logging
import tempfile
from collections.abc import Callable
from pathlib import Path

from vinesim.client.remote.remote_human import RemoteHuman, human_spec
from vinesim.net.codec.messages import Hello, is_valid_name
from vinesim.physics.rigid.mujoco_world import CompiledWorld
from vinesim.physics.rigid.rigid_world import RigidWorld
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.errors import DescriptionError
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.remote_robot import RemoteRobot
from vinesim.scene.values import HumanUpdate, RobotUpdate

log = logging.getLogger(__name__)

Prepared = tuple[RobotDescription | None, CompiledWorld]
"""A robot's description, or None for a human, and the compiled rigid world with it."""


class RemoteSpawner:
    """Remote actors that have joined but have no body here yet."""

    def __init__(
        self, rigid: RigidWorld, own: RobotDescription | None, executor: concurrent.futures.Executor | None = None
    ) -> None:
        """``own``: a description that is loaded already, if any; without ``executor`` actors are compiled at once."""
        self.rigid, self.own = rigid, own
        self._executor = executor
        self._enqueued: dict[str, Hello] = {}
        self._compiling: dict[str, concurrent.futures.Future[Prepared]] = {}

    def __contains__(self, name: str) -> bool:
        return name in self._enqueued

    def enqueue(self, hello: Hello) -> None:
        """Add an actor that has joined; it is spawned at its first pose."""
        self._enqueued[hello.name] = hello

    def cancel(self, name: str) -> None:
        """Remove an actor that has left."""
        self._enqueued.pop(name, None)
        self._compiling.pop(name, None)

    def spawn(self, name: str, update: RobotUpdate | HumanUpdate) -> RemoteRobot | RemoteHuman | None:
        """The body of an enqueued actor at the pose of ``update``; None until it is compiled.

        An actor that cannot be shown is logged and removed.
        """
        hello = self._enqueued[name]
        if name not in self._compiling:
            self._compiling[name] = self._submit(lambda: self._prepare(hello, update))
        if not self._compiling[name].done():
            return None
        try:
            description, draft = self._compiling.pop(name).result()
        except (ValueError, OSError) as error:  # OSError: no room for the file of its URDF
            log.warning("the %s of %s cannot be shown: %s", hello.kind, name, error)
            self.cancel(name)
            return None
        if not self.rigid.adopt(draft):
            return None  # another actor joined or left meanwhile: compiled again from the next step on
        self.cancel(name)
        if description is None or not isinstance(update, RobotUpdate):
            return RemoteHuman(self.rigid, name)
        other = RemoteRobot(self.rigid, description, name, hello.index, update.base_q, is_in_world=True)
        self.rigid.place_robot(name, update.base_q, update.position)
        return other

    def _submit(self, work: Callable[[], Prepared]) -> concurrent.futures.Future[Prepared]:
        if self._executor is not None:
            return self._executor.submit(work)
        done: concurrent.futures.Future[Prepared] = concurrent.futures.Future()
        try:
            done.set_result(work())
        except (ValueError, OSError) as error:
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
    """The robot of another client: an installed one with the same URDF text, or one loaded from the text it sent."""
    if own is not None and hello.urdf == own.urdf:
        return own
    name = hello.robot if is_valid_name(hello.robot) else "robot"  # untrusted, and it becomes a file's name
    try:
        known = load_description(name)
        if known.urdf == hello.urdf:
            return known
    except DescriptionError:
        pass
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{name}.urdf"
        file.write_text(hello.urdf)
        return load_description(file, is_remote=True)
