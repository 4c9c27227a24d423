"""A client in Python: joins a vineyard as a robot, steps, leaves.

    with Client("demo", "vinebot", connect="tcp/127.0.0.1:7377", name="picker") as client:
        client.robot.command_base(0.3, 0.0, client.time)
        client.run(0.4)

A base command expires after half a second unless it is repeated.
"""

from __future__ import annotations

import contextlib
import pathlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from vinesim.api.simulation import base_pose
from vinesim.client.client import Client as RobotClient
from vinesim.client.rate_loop import paced_loop
from vinesim.client.remote.stranger import StrangerLoader
from vinesim.client.tasks.free_places import choose_places
from vinesim.client.tasks.start_poses import start_pose
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import Scene, load_scene
from vinesim.scene.state import State
from vinesim.world import Physics

if TYPE_CHECKING:
    from vinesim.api.page import Page


class Client:
    """One robot in a vineyard that is shared with other clients through a server. A context manager; :meth:`close`
    leaves the shared world."""

    def __init__(
        self,
        scene: Scene | str | pathlib.Path,
        robot: str | pathlib.Path = "vinebot",
        *,
        name: str,
        connect: str | None = None,
        pose: Sequence[float] | np.ndarray | None = None,
        spawn: int | None = None,
        certificates: pathlib.Path | None = None,
        device: str = "cpu",
    ) -> None:
        """Join a world, which is a vineyard that several clients of one server simulate together.

        Args:
            scene: a scene, its name in ``data/scenes`` or the path of its file. Scene and seed must be equal for all
                clients of a world.
            robot: name from ``data/robots``, or the path of a URDF, xacro, SDF or MJCF file.
            name: unique name of this actor in the world.
            connect: endpoint of the server such as ``tcp/127.0.0.1:7377``; without it the client is alone in its own
                world.
            pose: (x, y, yaw) in m and rad, or pose [7] of the base; by default a start place of the scene.
            spawn: index of the start place in the scene; by default the first one where no other actor stands.
            certificates: folder of this actor's certificate, for a server with TLS.
            device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``, for stepping plants.

        Raises:
            NameTaken: the world has an actor of this name. The message explains what to do.
            Refused: the server refused the client. The message explains what to do.
        """
        self.scene: Scene = scene if isinstance(scene, Scene) else load_scene(scene)
        self.model: Model = generate(self.scene)
        described = load_description(robot)
        self._is_shared = connect is not None
        self._stack = contextlib.ExitStack()
        with contextlib.ExitStack() as stack:
            bus: Any
            if connect is None:
                bus = stack.enter_context(MemoryHub().bus(name))
            else:
                from vinesim.net.transport.zenoh_bus import ZenohBus

                bus = stack.enter_context(ZenohBus(name, connect=connect, certificates=certificates))
            if pose is None:
                (queue,) = choose_places(self.scene, self.model, bus, number=spawn)
                place = start_pose(self.scene, spawn or 0, queue=queue)
            else:
                place = base_pose(pose, self.model.terrain)
            executor = stack.enter_context(ThreadPoolExecutor(1, "spawner"))
            self._client = RobotClient(
                self.scene,
                self.model,
                described,
                bus,
                name=name,
                pose=place,
                executor=executor,
                loader=stack.enter_context(StrangerLoader()),
                device=device,
            )
            stack.callback(self._client.leave)
            self._stack = stack.pop_all()

    @property
    def robot(self) -> Robot:
        """The robot that this client controls."""
        return self._client.robot

    @property
    def physics(self) -> Physics:
        """Physics of this client's copy of the world."""
        return self._client.physics

    @property
    def state(self) -> State:
        """State of the plants in this client's copy of the world, at the current time."""
        self._client.physics.update_kinematics()
        return self._client.physics.state

    @property
    def received_bytes(self) -> int:
        """[B] Bytes received about plants and objects since joining: states of moving ones, events, and lasting records
        of what was cut, picked or put down.

        Poses of actors are not included.
        """
        counters = self._client.replicator.counters
        return sum(family.bytes_in for family in (counters.environment, counters.event, counters.retained))

    @property
    def time(self) -> float:
        """[s] Simulated time since this client joined."""
        return self._client.physics.time

    @property
    def remote_actors(self) -> tuple[str, ...]:
        """Names of the actors (robots and people) of other clients that have bodies in this client's simulation: those
        within 22 m, sorted. :attr:`far_actors` are the others."""
        return tuple(sorted(self._client.remote_actors))

    @property
    def far_actors(self) -> dict[str, np.ndarray]:
        """Last known positions [3] m of the robots and people of other clients that have no body in this client's
        simulation, by name, sorted. Each is known every 2 s, with more than 100 actors more rarely."""
        return self._client.far_actors()

    def actor_pose(self, name: str) -> np.ndarray:
        """Returns the pose [7] (m, quaternion xyzw) of the base of this client's robot or of a remote actor with a
        body, by its name. Raises ``KeyError`` for another name. :attr:`far_actors` has the places of all others."""
        if name != self._client.name and name not in self._client.remote_actors:
            raise KeyError(f"no actor {name!r}; there are: {', '.join((self._client.name, *self.remote_actors))}")
        return self._client.physics.rigid.base_state(name)[0]

    def step(self, count: int = 1) -> None:
        """Advance by ``count`` steps of 10 ms without waiting for real time. Each step receives messages, controls the
        robot, steps the physics, passes the result to pages, and sends messages."""
        for _ in range(count):
            self._client.tick()

    def run(self, seconds: float) -> None:
        """Step for ``seconds`` of simulated time at the pace of the world's clock.

        The clock runs slower than real time while a client in another program cannot keep up. It does not wait for a
        client of this class, because a Python program may pause between two calls.
        """
        loop = paced_loop(self._client, is_shared=self._is_shared)
        for _ in range(round(seconds / loop.dt)):
            loop.begin()
            self.step()
            loop.end()
        self._client.follow_steps(None)

    def page(self, port: int = 0) -> Page:
        """Show this client's vineyard in browsers on this machine, or in a cell of a notebook.

        The page is served until it is closed or the client leaves. ``port`` 0: any free port.
        """
        from vinesim.api.page import Page

        page = Page(self._client, port)
        self._stack.callback(page.close)
        return page

    def close(self) -> None:
        """Leave the world; further calls do nothing."""
        self._stack.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
