"""The common part of the processes of all client roles: bus, loop, status lines, report, and an orderly end."""

from __future__ import annotations

import contextlib
import gc
import json
import os
import pathlib
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Self, TypeVar

import msgspec

from vinesim.avatar.tracked_human import TrackedHuman
from vinesim.cli.client_options import ClientOptions, check_options
from vinesim.cli.signals import stop_at_signals
from vinesim.client.client import Client
from vinesim.client.rate_loop import RateLoop, paced_loop
from vinesim.client.recording.bunch_trace import Trace
from vinesim.client.remote.stranger import StrangerLoader
from vinesim.client.status import Status
from vinesim.client.tasks.free_places import choose_places
from vinesim.client.tasks.start_poses import with_start_pose
from vinesim.core import allocator
from vinesim.core.errors import writing
from vinesim.kernels.compilation import PHYSICS_PACKAGES, SENSOR_PACKAGES, compile_kernels
from vinesim.net.pace import describe
from vinesim.net.transport.bus import Bus
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.plants.device_buffers import DeviceLost, device_fault
from vinesim.robot.tasks.task import Task
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene, with_seed
from vinesim.web import page_files

if TYPE_CHECKING:
    from vinesim.web.page_server import PageServer

SWITCH_INTERVAL = 2e-4
"""Longest time for which another thread may hold the interpreter lock when the loop needs it [s]. Python's default is 5
ms."""
STATUS_PERIOD = 1.0
"""Wall time between two status lines [s]."""
FIRST_STATUS = 0.1
"""Wall time from the first step to the first status line [s]: shows early that the client runs."""
ENOUGH = 0.95
"""Share of the requested rate of pictures and scans below which the status line shows both rates [1]."""
CLOCK_TIMEOUT = 2.0
"""Longest time for which the first step waits for the server's clock [s]."""
VIEWER_PERIOD = 0.05
"""Time between two looks whether a browser has opened the page [s]."""
TRACE_CAPACITY = 1 << 17
"""Number of steps that a trace of one bunch can hold: 22 minutes."""

T = TypeVar("T")


class ClientSession:
    """One client process: its scene, its buses and its loop. A context manager that closes all of them in order."""

    def __init__(self, options: ClientOptions, model: Model | None = None) -> None:
        """Check the options and generate the vineyard, unless a ``model`` replaces it. Raises errors of the scene and
        :class:`UsageError`."""
        check_options(options)
        # The loop releases the interpreter lock at every kernel launch and needs it back within a fraction of a step.
        sys.setswitchinterval(SWITCH_INTERVAL)
        self.options = options
        # a client without a server has the same name in every run, because names seed the noise of sensors
        self.name = options.name or (options.role if options.connect is None else f"{options.role}-{os.getpid()}")
        self.scene = with_seed(load_scene(options.scene), options.seed)
        self.spawn = options.spawn
        """Index of the start pose in the scene; None: the first one that is free."""
        if options.pose is not None:
            self.scene = with_start_pose(self.scene, *options.pose)
            self.spawn = 0
        # the loop starts before the kernels of cameras and lidars are compiled; sensor processes wait for those kernels
        sensors = SENSOR_PACKAGES if options.role == "robot" else ()
        compile_kernels(PHYSICS_PACKAGES, options.device, then=sensors)
        self.model = generate(self.scene) if model is None else model
        self._hub = MemoryHub()
        self._stack = contextlib.ExitStack()
        self._stop = threading.Event()
        self._page: PageServer | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: Any) -> None:
        self._stack.__exit__(*exception)

    def enter(self, context: contextlib.AbstractContextManager[T]) -> T:
        """Enter a context manager that is left at the end of the session."""
        return self._stack.enter_context(context)

    def bus(self, name: str) -> Bus:
        """Returns a member of the world on the server, or of a network in memory if there is no server."""
        options = self.options
        if options.connect is None:
            return self.enter(self._hub.bus(name))
        from vinesim.net.transport.zenoh_bus import ZenohBus

        return self.enter(ZenohBus(name, connect=options.connect, world=options.world, certificates=options.tls))

    def client_options(self, name: str | None = None) -> dict[str, Any]:
        """Returns the keyword arguments of :class:`Client` for every role; ``name`` replaces the session's name."""
        options = self.options
        return {
            "name": name or self.name,
            "interest_radius": options.interest_radius,
            "jitter_buffer": 1e-3 * options.jitter_buffer,
            "device": options.device,
            "executor": self.enter(ThreadPoolExecutor(1, "spawner")),
            "loader": self.enter(StrangerLoader()),
        }

    def choose_places(self, bus: Bus, count: int = 1) -> list[int]:
        """Returns the ``queue`` numbers of the start places of this client's ``count`` actors, see
        :func:`vinesim.client.tasks.free_places.choose_places`."""
        return choose_places(self.scene, self.model, bus, number=self.spawn, count=count)

    def leave_at_end(self, client: Client) -> None:
        """At the end of the session, let a client announce that it leaves, before its buses close."""
        self._stack.callback(client.leave)

    def trace(self, client: Client, bunch: int) -> Trace:
        """Start to record the force on a bunch and the displacement of the bunch."""
        client.trace = start_trace(client, self.model, bunch)
        return client.trace

    def show_page(self, client: Client, person: TrackedHuman | None = None) -> None:
        """Show the vineyard in browsers until the session ends, if ``--page`` is given or the client is used through
        its page only.

        The first page controls a spectator's eyes, or the ``person``.
        """
        port = self.options.page
        if port is None:
            if not self.options.is_for_page:
                return
            if (missing := page_files.missing()) is not None:
                print(f"no page: {missing}", file=sys.stderr, flush=True)
                return
            port = 0
        page_files.check()
        from vinesim.client.page.page_sound import PageSound
        from vinesim.client.page.page_world import PageWorld
        from vinesim.web.page_server import PageServer

        world = PageWorld(client, person)
        sound = PageSound(client)
        if self.options.page_lan:
            from vinesim.client.page.page_access import network_access, print_code

            access = network_access()
            server = self.enter(PageServer(world, port, access.host, tls=access.tls, token=access.token, sound=sound))
            print_code(server.address)
        else:
            server = self.enter(PageServer(world, port, sound=sound))
        print(f"the vineyard in a browser: {server.address}", file=sys.stderr, flush=True)
        self._page = server
        client.post_step.append(lambda _: world.collect(server))
        client.other_faults.append(lambda: {"page_messages_refused": server.refused_messages})

    def wait_for_viewer(self) -> None:
        """Wait until a browser has opened the page. Returns at once if there is no page."""
        if self._page is not None:
            print("the task begins when a browser has opened the page", file=sys.stderr, flush=True)
            while not self._page.has_viewers:
                time.sleep(VIEWER_PERIOD)

    def run(
        self,
        client: Client,
        *,
        task: Task | None = None,
        sent: Callable[[], dict[str, int]] = dict,
        sensors: Callable[[], dict[str, Any]] = dict,
        publish: Callable[[dict[str, Any]], Any] = lambda _: None,
    ) -> Status:
        """Step by the world's clock until a signal, the time limit, or until the ``task`` is done and no browser shows
        the page any more; return the final status.

        ``sent``: returns the numbers of ROS messages by topic. ``sensors``: returns the status of sensors. ``publish``:
        is called with every status, for /diagnostics.
        """
        is_shared = self.options.connect is not None
        if is_shared:
            client.wait_for_clock(CLOCK_TIMEOUT)
        loop = paced_loop(client, is_shared=is_shared, factor=self.options.real_time_factor)
        if is_shared and client.slows_the_world:
            client.replicator.report_pace(loop.report)
        loop.is_stopping = self._stop.is_set
        status = Status(client, loop, sent, task, sensors)
        reporter = threading.Thread(
            target=report_status, args=(status, publish, self.options.status, self._stop), name="status"
        )
        reporter.start()
        self._stack.callback(reporter.join)
        self._stack.callback(self._stop.set)
        page = self._page
        is_done = (lambda: False) if task is None else (lambda: task.is_done and not (page and page.has_viewers))
        try:
            run_loop(self._stop, client.tick, loop, self.options.seconds, client.physics.dt, is_done)
        except RuntimeError as failure:
            device = self.options.device
            if device == "cpu" or (fault := device_fault(device)) is None:
                raise
            raise DeviceLost(f"{device} failed after {client.physics.time:.1f} s: {fault}") from failure
        if self.options.tick_log is not None:
            with writing(self.options.tick_log):
                loop.log().save(self.options.tick_log)
        return status


def start_trace(client: Client, model: Model, bunch: int) -> Trace:
    """Returns an empty trace of a bunch that hangs at rest."""
    body = int(model.bunch_body[bunch])
    return Trace(model, bunch, client.physics.state.body_q[body].copy(), TRACE_CAPACITY)


def run_loop(
    stop: threading.Event,
    step: Callable[[], None],
    loop: RateLoop,
    seconds: float | None,
    dt: float,
    is_done: Callable[[], bool] = lambda: False,
) -> None:
    """Step at the loop's rate until ``stop`` is set (by SIGINT, SIGTERM), for ``seconds`` of simulated time, or until
    ``is_done()``. ``dt``: duration of a step [s].
    """
    allocator.release_free_memory()
    gc.freeze()  # all objects that exist now live to the end; the collector need not visit them during a step
    gc.enable()
    # before this line Ctrl-C interrupts the process; after it, Ctrl-C ends the run in order
    stop_at_signals(stop)
    limit = None if seconds is None else round(seconds / dt)
    while not (stop.is_set() or loop.ticks == limit or is_done()):
        loop.begin()
        step()
        loop.end()


def save_report(out: pathlib.Path, report: dict[str, Any]) -> None:
    """Write ``report.json`` atomically. A number that is not finite becomes null, as JSON has none."""
    with writing(out / "report.json"):
        partial = out / "report.json.part"
        plain = msgspec.json.encode(report, enc_hook=lambda number: number.item())  # numbers of NumPy
        partial.write_bytes(msgspec.json.format(plain, indent=2) + b"\n")
        partial.replace(out / "report.json")


def report_status(status: Status, publish: Callable[[dict[str, Any]], Any], form: str, stop: threading.Event) -> None:
    """Every second, pass the status to ``publish`` and print it as text or JSON. Returns when ``stop`` is set."""
    period = FIRST_STATUS
    try:
        while not stop.wait(period):
            period = STATUS_PERIOD
            values = status.current()
            publish(values)
            if form == "json":
                print(json.dumps(values), flush=True)
            elif form == "text":
                print(status_line(values), flush=True)
    except BrokenPipeError:  # the reader of standard output has closed it: the run ends without an error
        stop.set()


def status_line(values: dict[str, Any]) -> str:
    """Returns a status as one line of text."""
    counts = {
        "messages": values["messages_dropped"],
        "frames of sound": values["sound_lost"] + values["sound_dropped"],
    }
    parts = [
        f"{values['time']:7.1f} s",
        f"{values['tick_hz']:6.2f} Hz",
        f"p99 {values['tick_p99_ms']:5.2f} ms",
        f"{values['awake']:3d} plants awake",
        f"force {values['force']:6.2f} N",
        f"in {1e-3 * values['bytes_in']:.1f} kB",
        f"out {1e-3 * values['bytes_out']:.1f} kB",
        f"with {', '.join(values['others'])}" if values["others"] else "alone",
    ]
    if pace := describe(values["target_real_time_factor"], values["pace_cause"]):
        parts.insert(1, pace)
    if values["network"]:
        parts.append(f"NETWORK: {values['network']}")
    restarts = {"sensor processes": values["sensor_restarts"], "ROS processes": values["ros_restarts"]}
    if restarted := ", ".join(f"{count} {kind}" for kind, count in restarts.items() if count):
        parts.append(f"restarted: {restarted}")
    reached, asked = values["frame_rate"], values["frame_rate_asked"]
    if reached < ENOUGH * asked:  # usual where sensors are rendered without a graphics card: no fault
        parts.append(f"pictures and scans: {reached:.0f} of the {asked:.0f} a second that subscribers ask for")
    if dropped := ", ".join(f"{count} {kind}" for kind, count in counts.items() if count):
        parts.append(f"dropped: {dropped}")
    if faults := ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in values["faults"].items()):
        parts.append(f"FAULTS: {faults}")
    return "  ".join(parts)
