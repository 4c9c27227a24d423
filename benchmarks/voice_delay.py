"""``python -m benchmarks voice``: delay from the microphone of one page to the sound of another, in real browsers.

There are a server, two people 3 m apart on clients of their own, all started as users start them, and a browser for
each person. The microphone of the first browser plays bursts of a tone. In the audio thread of each page a probe notes
when a burst begins: in the samples of the microphone, and in the samples that the other page plays; both pages use the
clock of this machine. The second browser reports the delay of its output, which is added; the delay of a microphone
before its browser is not known. The pages draw only two small pictures a second, because the browsers have no graphics
card, and the browser's sound filters are off.
"""

from __future__ import annotations

import contextlib
import json
import pathlib
import tempfile
import time
from collections.abc import Callable, Iterator

import numpy as np

from benchmarks.support.browser import AS_RECORDED, Page, browser_page, microphone, write_sound
from vinesim.bench.live_client import own_processes
from vinesim.client.programs import START_TIMEOUT, ProgramFailed, ProgramGroup, free_port
from vinesim.scene.values import Measurement
from vinesim.web.page_token import lasting_address

_Frames = dict[str, list[tuple[float, str]]]
"""Times [ms] and data of frames, by event."""
BURSTS = 60
"""Number of measured bursts."""
FREQUENCY = 600.0
LENGTH = 0.12
LEVEL = 0.5
"""Amplitude of the tone of a burst [1]; ``FREQUENCY`` [Hz] and ``LENGTH`` [s] are its other properties."""
PERIOD = 0.7
VARIATION = 0.1
"""Largest random time [s] that is added to ``PERIOD`` [s] between bursts, so that bursts fall into all phases of the
frames."""
HEARD_LEVEL = 0.05
QUIET = 0.3
"""Silence [s] after which an amplitude of ``HEARD_LEVEL`` [1] counts as the beginning of a burst."""
LATEST = 0.6
"""A burst that is played later than this after it was spoken counts as lost [s]."""
FIRST = ("anna", "-6 -3.5 0")
SECOND = ("ben", "-3 -3.5 3.1")
"""Names of the two people, and their places x, y, yaw next to the vines [m, rad]."""
ADDRESS = "?triangles=100&rate=2&shadows=0"
TIMEOUT = 300.0
"""Longest wait for a page or for bursts [s]."""
BUDGET = 150.0
"""Budget of the 95th percentile of the delay from mouth to ear [ms]."""

PROBE = """(async () => {
  const { voice } = vinesim, { context } = voice, source = %s;
  const code = `registerProcessor("probe", class extends AudioWorkletProcessor {
    constructor() { super(); this.quiet = 0; }
    process([[samples]]) {
      for (const value of samples ?? []) {
        if (Math.abs(value) < %g) { this.quiet += 1; continue; }
        if (this.quiet > %g * sampleRate) this.port.postMessage(Date.now());
        this.quiet = 0;
      }
      return true;
    } })`;
  await context.audioWorklet.addModule(URL.createObjectURL(new Blob([code], { type: "text/javascript" })));
  const probe = new AudioWorkletNode(context, "probe", { numberOfOutputs: 0 });
  window.bursts = [];
  probe.port.onmessage = ({ data }) => bursts.push(data);
  source.connect(probe);
  return true;
})()"""
"""Script that notes the times at which bursts begin [ms]."""
NOTE = """(() => {
  const { voice } = vinesim, now = () => performance.timeOrigin + performance.now();
  const note = (object, method, times, data = () => []) => {
    const call = object[method].bind(object);
    object[method] = (...values) => { times.push([now(), data(...values).join()]); return call(...values); };
  };
  window.times = { full: [], sent: [], received: [], decoded: [] };
  %s
  return true;
})()"""
SENDS = """note(voice, 'send', times.sent, (_, data) => data);
  if (voice.encoder) note(voice.encoder, 'encode', times.full); else times.full = times.sent;"""
RECEIVES = "const one = %s; note(one, 'take', times.received, (_, __, data) => data); note(one, 'play', times.decoded);"
"""Part of the script ``NOTE`` for the page that hears: notes when frames are received and decoded [ms], with their
data. ``SENDS`` notes in the page that speaks when frames are full, encoded and sent."""
STAGES = ("the rest of its frame", "encoding", "network of two clients and a server", "decoding", "queue and output")
"""Stages on the way of the first frame of a burst."""


def voice() -> Iterator[Measurement]:
    """Measure the delay from microphone to ear, and the part of it that the browser's output causes."""
    with contextlib.ExitStack() as stack:
        folder = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        addresses = _start(stack.enter_context(own_processes()))
        speaks = microphone(write_sound(folder / "bursts.wav", _bursts()))
        pages = [stack.enter_context(browser_page(*options)) for options in (speaks, speaks[-1:])]
        for page, address in zip(pages, addresses, strict=True):
            page.call("Page.setBypassCSP", enabled=True)  # the probe comes from outside the page
            page.resize(160, 120)
            page.open(address + ADDRESS, before=AS_RECORDED)
            _wait(lambda page=page: page.run("window.vinesim?.drawn >= 2"), "a picture")
        said, heard, output, stalls, frames = _measure(*pages)
    took = np.array([next((1.0 * b - a for b in heard if 0 <= b - a < 1e3 * LATEST), np.nan) for a in said])
    yield Measurement("voice", f"bursts that were not heard, of {len(took)}", float(np.isnan(took).sum()), "")
    yield Measurement("voice", "gaps that the second page had to bridge", float(stalls), "")
    for stage, took_there in zip(STAGES, _stages(np.array(said), took, frames), strict=True):
        for share in (50, 95):
            value = float(np.nanpercentile(took_there, share))
            yield Measurement("voice", f"of this {stage}, percentile {share}", value, "ms")
    took = took[~np.isnan(took)]
    yield Measurement("voice", "output of the browser, as it says", output, "ms")
    for share in (50, 95):
        value = float(np.percentile(took, share))
        yield Measurement("voice", f"microphone to sound of the page, percentile {share}", value, "ms")
    mouth_to_ear = float(np.percentile(took, 95)) + output
    yield Measurement(
        "voice", "mouth to ear, percentile 95", mouth_to_ear, "ms", "budget", BUDGET, BUDGET / mouth_to_ear
    )


def _bursts() -> np.ndarray:
    """Returns 40 bursts of a tone, each after silence of random length; samples at 48 kHz."""
    rng = np.random.default_rng(1)
    rate = 48_000
    burst = LEVEL * np.sin(2.0 * np.pi * FREQUENCY * np.arange(round(LENGTH * rate)) / rate)
    pauses = (np.zeros(round((PERIOD - LENGTH + VARIATION * rng.random()) * rate)) for _ in range(40))
    return np.concatenate([part for pause in pauses for part in (pause, burst)])


def _start(group: ProgramGroup) -> list[str]:
    """Start a server and two people; return the addresses of their pages."""
    server = group.start("server", "-m", "vinesim", "server", "--listen", "tcp/127.0.0.1:0", "--status", "json")
    endpoint = json.loads(server.next_line(START_TIMEOUT))["endpoints"][0]
    ports = []
    people = []
    for name, pose in (FIRST, SECOND):
        ports.append(free_port())
        people.append(
            group.start(
                name,
                "-m",
                "vinesim",
                "client",
                "--role",
                "human",
                "--name",
                name,
                "--connect",
                endpoint,
                "--page",
                str(ports[-1]),
                "--pose",
                *pose.split(),
                "--status",
                "json",
            )
        )
    for person in people:
        while len(json.loads(person.next_line(START_TIMEOUT))["others"]) < 1:
            pass
    return [address for port in ports if (address := lasting_address(port)) is not None]


def _stages(said: np.ndarray, took: np.ndarray, times: _Frames) -> np.ndarray:
    """Returns the duration of each of :data:`STAGES` [stage, burst] ms; NaN where it is unknown.

    The followed frame is the first one that was full after the burst began and that was sent; silence is not sent.
    ``said``: beginnings of bursts at the microphone [ms]; ``took``: delays of the bursts [ms]; ``times``: frames by
    event.
    """
    sent = times["sent"]
    received = times["received"]
    decoded = times["decoded"]
    full = np.array([at for at, _ in times["full"]])
    full = full[np.maximum(np.searchsorted(full, [at for at, _ in sent], "right") - 1, 0)]
    stages = np.full((len(STAGES), len(said)), np.nan)
    for burst, began in enumerate(said):
        k = int(np.searchsorted(full, began))
        coming = enumerate(received[: len(decoded)])
        there = next((i for i, (at, data) in coming if k < len(sent) and data == sent[k][1] and at >= sent[k][0]), None)
        if there is not None:
            way = [began, full[k], sent[k][0], received[there][0], decoded[there][0], began + took[burst]]
            stages[:, burst] = np.diff(way)
    return stages


def _measure(first: Page, second: Page) -> tuple[list[float], list[float], float, int, _Frames]:
    """Let the first page speak and the second hear. Returns times at which bursts began in the first and in the second
    page [ms], delay of the second page's output [ms], number of its gaps, and frames by event."""
    second.run("vinesim.voice.hear()")
    first.run("vinesim.voice.toggleSpeaking()")
    speaker = f"vinesim.voice.speakers.get({FIRST[0]!r})"
    _wait(lambda: second.run(f"{speaker}?.received > 20"), f"the voice of {FIRST[0]}")
    for page, source in ((second, f"{speaker}.player"), (first, "vinesim.voice.microphone.source")):
        page.run(PROBE % (source, HEARD_LEVEL, QUIET))
    first.run(NOTE % SENDS)
    second.run(NOTE % (RECEIVES % speaker))
    before = int(second.run(f"{speaker}.counts.stalls"))
    _wait(lambda: first.run("bursts.length") > BURSTS, "bursts")
    time.sleep(LATEST)
    output = "1000 * (vinesim.voice.context.baseLatency + vinesim.voice.context.outputLatency)"
    stalls = int(second.run(f"{speaker}.counts.stalls")) - before
    frames = {name: at for page in (first, second) for name, at in page.run("times").items() if at}
    return first.run("bursts")[:BURSTS], second.run("bursts"), float(second.run(output)), stalls, frames


def _wait(condition: Callable[[], object], what: str) -> None:
    until = time.monotonic() + TIMEOUT
    while not condition():
        if time.monotonic() > until:
            raise ProgramFailed(f"a browser had not {what} within {TIMEOUT:.0f} s")
        time.sleep(0.1)
