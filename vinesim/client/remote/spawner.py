"""Adds the robots and humans of other clients: an executor loads and compiles them, and no step waits for it."""

from __future__ import annotations

import concurrent.futures
import logging
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

from vinesim.client.remote.mesh_exchange import MeshExchange
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
    """Remote actors that have joined but have no body here yet, and robots whose meshes arrive after they have one."""

    def __init__(
        self,
        rigid: RigidWorld,
        own: RobotDescription | None,
        executor: concurrent.futures.Executor | None = None,
        meshes: MeshExchange | None = None,
    ) -> None:
        """``own``: a description that is loaded already, if any; without ``executor`` actors are compiled at once.
        ``meshes``: those of remote robots; without it they are boxes."""
        self.rigid, self.own = rigid, own
        self.meshes = meshes or MeshExchange()
        self._executor = executor
        self._enqueued: dict[str, Hello] = {}
        self._compiling: dict[str, concurrent.futures.Future[Prepared]] = {}
        self._spawned: dict[str, Hello] = {}
        """Robots that have a body here."""
        self._outdated: set[str] = set()
        """Robots of which meshes have arrived since their last compilation began."""

    def __contains__(self, name: str) -> bool:
        return name in self._enqueued

    def enqueue(self, hello: Hello) -> None:
        """Add an actor that has joined; it is spawned at its first pose."""
        self._enqueued[hello.name] = hello

    def cancel(self, name: str) -> None:
        """Remove an actor that has left."""
        for of_name in (self._enqueued, self._compiling, self._spawned):
            of_name.pop(name, None)
        self._outdated.discard(name)

    def spawn(self, name: str, update: RobotUpdate | HumanUpdate) -> RemoteRobot | RemoteHuman | None:
        """The body of an enqueued actor at the pose of ``update``; None until it is compiled.

        An actor that cannot be shown is logged and removed.
        """
        hello = self._enqueued[name]
        prepared = self._result(name, hello, lambda: self._prepare(hello, update))
        if prepared is None:
            return None
        del self._enqueued[name]
        description, _ = prepared
        if description is None or not isinstance(update, RobotUpdate):
            return RemoteHuman(self.rigid, name)
        self._spawned[name] = hello
        if description.urdf != hello.urdf:  # not the text of an installed robot, whose meshes are files
            self.meshes.want(name, hello.urdf)
        other = RemoteRobot(self.rigid, description, name, hello.index, update.base_q, is_in_world=True)
        self.rigid.place_robot(name, update.base_q, update.position)
        return other

    def renewed(self) -> Iterator[RemoteRobot]:
        """Robots whose meshes have arrived and now stand in the place of boxes, in the state that they were in."""
        self._outdated.update(self.meshes.changed())
        for name in sorted(self._outdated & self._spawned.keys() | self._compiling.keys() & self._spawned.keys()):
            hello = self._spawned[name]
            prepared = self._result(name, hello, lambda hello=hello: self._prepare(hello, None))
            if prepared is not None and (description := prepared[0]) is not None:
                pose, _ = self.rigid.base_state(name)
                yield RemoteRobot(self.rigid, description, name, hello.index, pose, is_in_world=True)

    def _result(self, name: str, hello: Hello, work: Callable[[], Prepared]) -> Prepared | None:
        """Compile an actor; its description when the world with it is in use, None until then."""
        if name not in self._compiling:
            self._outdated.discard(name)
            self._compiling[name] = self._submit(work)
        if not self._compiling[name].done():
            return None
        try:
            description, draft = self._compiling.pop(name).result()
        except ValueError as error:
            log.warning("the %s of %s cannot be shown: %s", hello.kind, name, error)
            if name not in self._spawned:
                self.cancel(name)
            return None
        if not self.rigid.adopt(draft):  # another actor joined or left meanwhile: compiled again from the next step on
            self._outdated.add(name)
            return None
        return description, draft

    def _submit(self, work: Callable[[], Prepared]) -> concurrent.futures.Future[Prepared]:
        if self._executor is not None:
            return self._executor.submit(work)
        done: concurrent.futures.Future[Prepared] = concurrent.futures.Future()
        try:
            done.set_result(work())
        except ValueError as error:
            done.set_exception(error)
        return done

    def _prepare(self, hello: Hello, update: RobotUpdate | HumanUpdate | None) -> Prepared:
        """Load and compile an actor at the pose of ``update``; None: again, as the robot that is here already."""
        if isinstance(update, HumanUpdate):
            return None, self.rigid.compile_with(human_spec(hello, update), is_remote=True)
        received = self.meshes.received(hello.name)
        if received:
            try:
                return self._prepare_robot(hello, update, received)
            except ValueError as error:
                log.warning("the meshes of %s cannot be used, boxes stay in their place: %s", hello.name, error)
                self.meshes.refuse(hello.name)
        return self._prepare_robot(hello, update, {})

    def _prepare_robot(self, hello: Hello, update: RobotUpdate | None, received: Mapping[str, np.ndarray]) -> Prepared:
        description = resolve_description(hello, self.own, received)
        if hello.joints not in (-1, len(description.drives)):
            raise DescriptionError(f"it announces {hello.joints} joints, its URDF drives {len(description.drives)}")
        pose = None if update is None else update.base_q
        spec = description.to_spec(hello.name, hello.index, pose)
        return description, self.rigid.compile_with(spec, replaces=update is None)


def resolve_description(
    hello: Hello, own: RobotDescription | None, received: Mapping[str, np.ndarray] | None = None
) -> RobotDescription:
    """The robot of another client: an installed one with the same URDF text, or one loaded from the text it sent.

    ``received``: corners [face, 3, 3] m of its meshes by digest; boxes stand in for those that are not there.
    """
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
        return load_description(file, is_remote=True, received=received)
