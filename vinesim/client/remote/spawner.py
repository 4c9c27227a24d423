"""Adds and removes robots and humans of other clients. An executor loads and compiles, so no step waits."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import logging
from collections.abc import Callable, Mapping, Set

import numpy as np

from vinesim.client.remote.mesh_exchange import MeshExchange
from vinesim.client.remote.remote_human import RemoteHuman, human_spec
from vinesim.client.remote.stranger import StrangerLoader, load_sent
from vinesim.net.codec.control import Hello
from vinesim.net.codec.header import is_valid_name
from vinesim.rigid.mujoco_world import CompiledWorld
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.sidecar import encode_sidecar
from vinesim.robot.description.source import is_shipped
from vinesim.robot.description.urdf import DescriptionError
from vinesim.robot.drives.robot_instance import RemoteRobot
from vinesim.scene.values import HumanSpec, HumanUpdate, RobotSpec, RobotUpdate

log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Prepared:
    """A compiled world with actors that have joined."""

    actors: tuple[tuple[Hello, RobotDescription | None], ...]
    """Actors in the world, each with its description; None for a human."""
    refused: tuple[tuple[Hello, ValueError | OSError], ...]
    """Actors that cannot be compiled, each with the reason."""
    world: CompiledWorld | None
    """The compiled world; None if all actors were refused."""


class RemoteSpawner:
    """Compiles worlds for near remote actors that have no body on this client yet.

    It also compiles a world when the bodies for free bunches run out, and when meshes of robots arrive after their
    bodies were made.
    """

    def __init__(
        self,
        rigid: RigidWorld,
        own: RobotDescription | None,
        executor: concurrent.futures.Executor | None = None,
        meshes: MeshExchange | None = None,
        loader: StrangerLoader | None = None,
    ) -> None:
        """``own``: a description that is already loaded, if any. ``executor``: runs the compilation; None: the caller's
        thread does.

        ``meshes``: exchange of meshes of remote robots; without it boxes replace their meshes. ``loader``: loads
        robots of strangers in processes; None: ``executor`` loads them itself.
        """
        self.meshes = meshes or MeshExchange()
        self._spawned: dict[str, Hello] = {}
        """Remote robots that have bodies on this client, by name."""
        self._outdated: set[str] = set()
        """Robots with meshes that arrived after their last compilation began."""
        self._renewing: concurrent.futures.Future[Prepared] | None = None
        self.rigid = rigid
        self.own = own
        self._executor = executor
        self._loader = loader
        self._loading: dict[str, tuple[Hello, concurrent.futures.Future[RobotDescription]]] = {}
        """Robots of enqueued strangers that are being loaded, or are loaded, by name."""
        self._enqueued: dict[str, Hello] = {}
        self._refused: set[str] = set()
        """Names of enqueued actors that cannot be compiled."""
        self._leaving: dict[str, RemoteRobot | RemoteHuman] = {}
        """Copies of actors that have left or are far away, kept until the world without them is compiled."""
        self._removed: list[str] = []
        self._compiling: concurrent.futures.Future[Prepared] | None = None

    def __contains__(self, name: str) -> bool:
        """Whether the body of an actor is being made."""
        return name in self._enqueued

    def may_enqueue(self, name: str) -> bool:
        """Whether the body of an actor is neither being made or removed nor refused."""
        return name not in self.waiting and name not in self._leaving

    @property
    def waiting(self) -> Set[str]:
        """Names of the near actors without a body, because it is being made or cannot be made."""
        return self._enqueued.keys() | self._refused

    def enqueue(self, hello: Hello) -> None:
        """Add an actor that has come near. It is spawned at its first pose."""
        self._enqueued[hello.name] = hello
        if self._loader is not None and hello.kind == "robot":
            work = functools.partial(resolve_description, hello, self.own, load=self._loader.load)
            self._loading[hello.name] = (hello, self._loader.submit(work))

    def cancel(self, name: str) -> None:
        """Forget an actor that has left or is far away."""
        self._enqueued.pop(name, None)
        self._refused.discard(name)
        if (loading := self._loading.pop(name, None)) is not None:
            loading[1].cancel()
        self._spawned.pop(name, None)
        self._outdated.discard(name)

    def remove(self, name: str, copy: RemoteRobot | RemoteHuman) -> None:
        """Start to remove the copy of an actor that has left or is far away. :meth:`removed` returns the actor's name
        when this is done."""
        if self._executor is None:
            copy.remove()
            self._removed.append(name)
        else:
            self._leaving[name] = copy

    def removed(self) -> list[str]:
        """Returns the actors whose copies were removed since the last call."""
        names = self._removed
        self._removed = []
        return names

    def spawn(self, updates: Mapping[str, RobotUpdate | HumanUpdate]) -> dict[str, RemoteRobot | RemoteHuman]:
        """Returns the copies of enqueued actors that became ready, at their poses in ``updates``. Call it between
        steps.

        All waiting actors are compiled together. An actor that cannot be compiled is logged and removed.
        """
        if self._compiling is None:
            arrived = [
                (hello, updates[name])
                for name, hello in self._enqueued.items()
                if name in updates and (name not in self._loading or self._loading[name][1].done())
            ]
            room_is_short = (
                self._executor is not None and 2 * self.rigid.bunch_room < self.rigid.parameters.bunch_pool_size
            )
            without = tuple(self._leaving)
            if not arrived and not room_is_short and not without:
                return {}
            self._compiling = self._submit(lambda: self._prepare(arrived, without))
        if not self._compiling.done():
            return {}
        done = self._compiling
        self._compiling = None
        prepared = done.result()
        for hello, error in prepared.refused:
            if self._enqueued.get(hello.name) is hello:
                log.warning("the %s of %s cannot be shown: %s", hello.kind, hello.name, error)
                self.cancel(hello.name)
                self._refused.add(hello.name)
        hellos = [hello for hello, _ in prepared.actors]
        if any(self._enqueued.get(hello.name) is not hello or hello.name not in updates for hello in hellos):
            return {}  # an actor has left meanwhile, so compile again from the next step on
        if prepared.world is None or not self.rigid.adopt(prepared.world):
            return {}  # another actor joined or left meanwhile, so compile again
        for actor in prepared.world.removed:
            self._leaving.pop(actor.spec.name)
            self._removed.append(actor.spec.name)
        spawned: dict[str, RemoteRobot | RemoteHuman] = {}
        for hello, description in prepared.actors:
            self.cancel(hello.name)
            spawned[hello.name] = self._body_of(hello, description, updates[hello.name])
        return spawned

    def _body_of(
        self, hello: Hello, description: RobotDescription | None, update: RobotUpdate | HumanUpdate
    ) -> RemoteRobot | RemoteHuman:
        """Returns the copy of an actor that is in the rigid world now."""
        if description is None or not isinstance(update, RobotUpdate):
            return RemoteHuman(self.rigid, hello.name)
        self._spawned[hello.name] = hello
        if description.urdf != hello.urdf:  # otherwise it is an installed robot with mesh files
            self.meshes.want(hello.name, hello.urdf)
        other = RemoteRobot(self.rigid, description, hello.name, hello.index, update.base_q, is_in_world=True)
        self.rigid.place_robot(hello.name, update.base_q, update.position)
        return other

    def renewed(self) -> list[RemoteRobot]:
        """Returns the robots whose boxes were replaced by received meshes; their states are unchanged."""
        self._outdated.update(self.meshes.changed())
        if self._renewing is None:
            hellos = [self._spawned[name] for name in sorted(self._outdated & self._spawned.keys())]
            if not hellos:
                return []
            self._outdated -= {hello.name for hello in hellos}
            self._renewing = self._submit(lambda: self._prepare_again(hellos))
        if not self._renewing.done():
            return []
        done = self._renewing
        self._renewing = None
        prepared = done.result()
        for hello, error in prepared.refused:
            log.warning("the meshes of %s cannot be used, boxes replace them: %s", hello.name, error)
            self.meshes.refuse(hello.name)
        is_current = all(self._spawned.get(hello.name) is hello for hello, _ in prepared.actors)
        if prepared.world is None or not is_current or not self.rigid.adopt(prepared.world):
            # another actor joined or left meanwhile, so compile again from the next step on
            self._outdated |= {hello.name for hello, _ in prepared.actors} & self._spawned.keys()
            return []
        return [
            RemoteRobot(
                self.rigid, description, hello.name, hello.index, self.rigid.base_state(hello.name)[0], is_in_world=True
            )
            for hello, description in prepared.actors
            if description is not None
        ]

    def _prepare_again(self, hellos: list[Hello]) -> Prepared:
        """Compile a world in which present robots have their received meshes."""
        specs = []
        actors = []
        refused = []
        world = None
        for hello in hellos:
            try:
                description = resolve_description(hello, self.own, self.meshes.received(hello.name))
                spec = description.to_spec(hello.name, hello.index)
                world = self.rigid.compile_with(*specs, spec, replaces=True)
            except (ValueError, OSError) as error:
                refused.append((hello, error))
            else:
                specs.append(spec)
                actors.append((hello, description))
        return Prepared(tuple(actors), tuple(refused), world)

    def _submit(self, work: Callable[[], Prepared]) -> concurrent.futures.Future[Prepared]:
        if self._executor is not None:
            return self._executor.submit(work)
        done: concurrent.futures.Future[Prepared] = concurrent.futures.Future()
        done.set_result(work())
        return done

    def _prepare(self, arrived: list[tuple[Hello, RobotUpdate | HumanUpdate]], without: tuple[str, ...]) -> Prepared:
        """Compile a world with all actors that can be compiled, except the actors ``without`` that leave."""
        refused: list[tuple[Hello, ValueError | OSError]] = []
        loaded: list[tuple[Hello, RobotDescription | None, RobotSpec | HumanSpec]] = []
        for hello, update in arrived:
            try:
                loaded.append((hello, *self._load(hello, update)))
            except (ValueError, OSError) as error:  # OSError: no room for the file of its URDF
                refused.append((hello, error))
        try:
            world = self._compile(loaded, without)
        except ValueError:  # MuJoCo does not say which actor is at fault
            fine = []
            for one in loaded:
                try:
                    self._compile([one], without)
                    fine.append(one)
                except ValueError as error:
                    refused.append((one[0], error))
            loaded = fine
            world = self._compile(fine, without) if fine or without else None
        return Prepared(tuple((hello, description) for hello, description, _ in loaded), tuple(refused), world)

    def _compile(
        self, loaded: list[tuple[Hello, RobotDescription | None, RobotSpec | HumanSpec]], without: tuple[str, ...]
    ) -> CompiledWorld:
        return self.rigid.compile_with(*(spec for _, _, spec in loaded), is_remote=True, without=without)

    def _load(
        self, hello: Hello, update: RobotUpdate | HumanUpdate
    ) -> tuple[RobotDescription | None, RobotSpec | HumanSpec]:
        """Returns description (None for a human) and specification of an actor. Raises ValueError if the actor cannot
        be loaded."""
        if isinstance(update, HumanUpdate):
            return None, human_spec(hello, update)
        loading = self._loading.get(hello.name)
        if loading is not None and loading[0] is hello:
            description = loading[1].result()
        else:
            description = resolve_description(hello, self.own)
        if hello.joints not in (-1, len(description.drives)):
            raise DescriptionError(f"it announces {hello.joints} joints, its URDF drives {len(description.drives)}")
        return description, description.to_spec(hello.name, hello.index, update.base_q)


def resolve_description(
    hello: Hello,
    own: RobotDescription | None,
    received: Mapping[str, np.ndarray] | None = None,
    load: Callable[[Hello], RobotDescription] | None = None,
) -> RobotDescription:
    """Returns the description of another client's robot: an installed robot with equal URDF text and sidecar, or the
    sent URDF.

    ``received``: corners [face, 3, 3] m of its meshes by digest; boxes replace missing meshes. ``load``: loads a
    sent URDF; None: this thread does.
    """

    def is_same(known: RobotDescription) -> bool:
        return known.urdf == hello.urdf and encode_sidecar(known.base_limits, known.groups) == hello.sidecar

    if own is not None and is_same(own):
        return own
    name = hello.robot if is_valid_name(hello.robot) else "robot"  # untrusted input that becomes a file name
    try:
        if is_shipped(name):  # no other name: it could be that of a pipe, or of any file
            known = load_description(name)
            if is_same(known):
                return known
    except DescriptionError:
        pass
    return load_sent(hello, received) if load is None else load(hello)
