"""``vinesim record``: write the messages of a world to a file."""

from __future__ import annotations

import contextlib
import datetime
import os
import pathlib
import sys
import threading
import time

from vinesim.cli.signals import stop_at_signals
from vinesim.client.recording.recorder import CHOICES, Observer, Recorder, observer_grid
from vinesim.core.errors import UsageError
from vinesim.net.recording.mcap_writer import RecordingWriter, free_path
from vinesim.net.transport.zenoh_bus import ZenohBus

POLL = 0.004
"""Wall time between two checks for new messages [s]."""


def run(
    *,
    file: pathlib.Path,
    connect: str,
    world: str,
    name: str | None,
    tls: pathlib.Path | None,
    scene: str | None,
    seed: int | None,
    area: tuple[float, float, float, float] | None,
    only: str | None,
    seconds: float | None,
) -> int:
    """Record until a signal or the time limit. Returns 0 if the file is complete."""
    families = CHOICES if only is None else tuple(filter(None, only.split(",")))
    if unknown := [family for family in families if family not in CHOICES] or ([] if families else [only]):
        raise UsageError(f"--only {','.join(map(str, unknown))}: give some of {','.join(CHOICES)}")
    stands = observer_grid(area) if area is not None else []
    about = {"world": world, "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")}
    about["asked"] = (
        "only messages that are sent anyway" if area is None else "area " + " ".join(f"{edge:g}" for edge in area)
    )
    about |= _vineyard(scene, seed)

    stop = stop_at_signals(threading.Event())
    with contextlib.ExitStack() as stack:
        name = name or f"recorder-{os.getpid()}"
        bus = stack.enter_context(ZenohBus(name, connect=connect, world=world, certificates=tls, live=False))
        path = free_path(file)
        recording = stack.enter_context(RecordingWriter(path, about))
        recorder = Recorder(bus, recording, only=families, everything=area is not None, digest=about.get("digest", ""))
        other = f" ({file} is there already and stays as it is)" if path != file else ""
        print(f"recording world {world} at {connect} into {path}{other}", file=sys.stderr, flush=True)
        standing: list[Observer] = []
        begun = said = time.monotonic()
        while not stop.wait(POLL):
            now = time.monotonic()
            if seconds is not None and now - begun >= seconds:
                break
            if recorder.digest and len(standing) < len(stands):
                own = f"{name}-{len(standing) + 1}"
                recorder.observers.add(own)
                there = stack.enter_context(ZenohBus(own, connect=connect, world=world, certificates=tls))
                scene_name = recording.metadata.get("scene", "")
                standing.append(Observer(there, stands[len(standing)], scene_name, recorder.digest, now))
            recorder.step()
            for stand in standing:
                stand.step(now)
            if now - said >= 1.0:
                said = now
                _progress(recorder, now - begun, alone=area is None and len(recorder.actors) < 2)
        recorder.close()
    if sys.stderr.isatty():
        print(file=sys.stderr)
    print(f"{path}: {recording.count} messages, {recording.size} B, {time.monotonic() - begun:.1f} s", file=sys.stderr)
    return 0


def _vineyard(scene: str | None, seed: int | None) -> dict[str, str]:
    """Returns scene name, seed and digest of the only vineyard that may be recorded, from a scene file."""
    if scene is None:
        if seed is not None:
            raise UsageError(f"--seed {seed} without a scene: give --scene as well")
        return {}
    from vinesim.scene.generation.vineyard import generate
    from vinesim.scene.spec import load_scene, with_seed

    plan = with_seed(load_scene(scene), seed)
    return {"scene": plan.name, "seed": str(plan.seed), "digest": generate(plan).digest()}


def _progress(recorder: Recorder, elapsed: float, alone: bool) -> None:
    """Show progress in one line that is overwritten on a terminal. Nothing is written if the output is a file."""
    if not sys.stderr.isatty():
        return
    trouble = recorder.bus.status_message
    company = ", ".join(sorted(recorder.actors)) or "no actors"
    hint = "  (with fewer than two actors nothing is sent; --area requests messages)" if alone else ""
    line = f"{elapsed:7.1f} s  {recorder.recording.count} messages  {recorder.recording.size / 1e6:.2f} MB  {company}"
    width = os.get_terminal_size(sys.stderr.fileno()).columns - 1
    print(f"\r{(trouble or line + hint)[:width]:<{width}}", end="", file=sys.stderr, flush=True)
