"""``vinesim server``: carries the messages of a world."""

from __future__ import annotations

import json
import pathlib
import threading
from typing import Any

from vinesim.audio.hearing import SpectatorsSpeakTo
from vinesim.cli.signals import stop_at_signals
from vinesim.core.errors import UsageError
from vinesim.net.pace import describe
from vinesim.net.server.admission import JoinLimits, SceneId
from vinesim.net.server.journal import JournalError
from vinesim.net.server.retained_store import Quota
from vinesim.net.server.server import Server
from vinesim.net.transport.endpoints import check_exposure, default_listen

STATUS_PERIOD = 1.0
"""Wall time between two status lines [s]."""


def run(
    *,
    listen: list[str] | None,
    connect: list[str] | None,
    state_dir: pathlib.Path | None,
    scene: str | None,
    seed: int | None,
    max_clients: int | None,
    max_clients_per_address: int,
    max_sessions: int | None,
    quota: tuple[float, float],
    tls: pathlib.Path | None,
    insecure: bool,
    status: str,
    spectators_speak_to: str = "people",
    real_time_factor: float | None = None,
) -> int:
    """Carry messages until SIGINT or SIGTERM. Returns the exit code: 4 if records could not be written."""
    if status not in ("text", "json", "none"):
        raise UsageError(f"--status {status!r}: give text, json or none")
    if spectators_speak_to not in tuple(SpectatorsSpeakTo):
        raise UsageError(f"--spectators-speak-to {spectators_speak_to!r}: give nobody, people or all")
    if min(quota) <= 0.0:
        raise UsageError(f"--quota {quota[0]:g} {quota[1]:g}: give values above zero")
    if seed is not None and scene is None:
        raise UsageError(f"--seed {seed} without a scene: give --scene as well")
    places = listen or default_listen(secured=tls is not None, insecure=insecure)
    check_exposure(places, secured=tls is not None, insecure=insecure)
    plan = None if scene is None else _plan(scene, seed)
    stop = stop_at_signals(threading.Event())
    with Server(
        places,
        connect=connect or (),
        state_folder=state_dir,
        scene=plan,
        max_actors=max_clients,
        limits=JoinLimits(actors_per_address=max_clients_per_address),
        max_sessions=max_sessions,
        quota=Quota(*quota),
        certificates=tls,
        spectators_speak_to=SpectatorsSpeakTo(spectators_speak_to),
        real_time_factor=real_time_factor,
    ) as server:
        if status != "json":
            print(f"listening on {', '.join(map(str, server.endpoints))}", flush=True)
        try:
            while not stop.wait(STATUS_PERIOD):  # not for ever: another thread may have got the signal
                if status == "none":
                    continue
                figures = server.figures()
                print(json.dumps(figures) if status == "json" else _line(figures), flush=True)
        except BrokenPipeError:  # the reader of standard output has closed it: the run ends without an error
            pass
    return JournalError.exit_code if server.unwritten else 0


def _plan(scene: str, seed: int | None) -> SceneId:
    from vinesim.scene.generation.vineyard import generate
    from vinesim.scene.spec import load_scene, with_seed

    plan = with_seed(load_scene(scene), seed)
    return SceneId(plan.name, generate(plan).digest())


def _line(figures: dict[str, Any]) -> str:
    company = ", ".join(figures["actors"]) or "no actors"
    counts = ", ".join(f"{value} {name.replace('_', ' ')}" for name, value in figures.items() if isinstance(value, int))
    for world, clock in figures["clocks"].items():
        if text := describe(clock["real_time_factor"], clock["cause"]):
            counts += f", {world} at {text}"
    trouble = f"; {figures['trouble']}" if figures.get("trouble") else ""
    return f"{company}: {counts}{trouble}"
