"""Draws the results of ``python -m benchmarks sync``: latencies, differences of copies, two robots that push one bunch,
and the effect of a jitter buffer."""

from __future__ import annotations

import pathlib
import re

import numpy as np

from vinesim.scene.values import Measurement


def _by_delay(lines: list[Measurement], case: str) -> tuple[list[float], list[float]]:
    """Returns the delays [ms] and values of all lines with the case ``<delay> ms: <case>``."""
    found = [(re.fullmatch(rf"(\d+) ms: {re.escape(case)}", line.case), line.value) for line in lines]
    pairs = sorted((float(match[1]), value) for match, value in found if match)
    return [x for x, _ in pairs], [y for _, y in pairs]


def draw(lines: list[Measurement], fights: dict[tuple[float, bool], np.ndarray], to: pathlib.Path) -> None:
    """Draw four panels into the file ``to``.

    ``fights``: displacement of the bunch [tick, 2] mm on both clients, by delay [s] and by whether every touch took the
    tree.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    (latency, copies), (fight, buffer) = axes

    own = "touch to motion, one's own"
    far = "touch to motion, seen by another"
    latency.plot(*_by_delay(lines, own), "o-", label="the touching client's own bunch")
    latency.plot(*_by_delay(lines, far), "s-", label="the same, seen by another client")
    asked = [(float(line.case.split()[0]), line.peer_value) for line in lines if line.case.endswith(own)]
    latency.plot(*zip(*asked, strict=True), "^-", label="if one authority far away moved it")
    latency.set(title="From touch to motion", xlabel="delay, one way [ms]", ylabel="[ms]")

    copies.plot(*_by_delay(lines, "copy of a pushed bunch, p95"), "o-", label="one pushes")
    copies.plot(*_by_delay(lines, "copy of a bunch that two push, p95"), "s-", label="two push")
    copies.plot(
        *_by_delay(lines, "the same if touching took it each time, p95"), "^-", label="two push, touching takes"
    )
    copies.set(title="Copy against owner, same instant, p95", xlabel="delay, one way [ms]", ylabel="[mm]", yscale="log")

    delay = max(delay for delay, _ in fights)
    for naive, style in ((False, "-"), (True, ":")):
        moved = fights[delay, naive]
        time = 0.01 * np.arange(len(moved))
        for who, colour in ((0, "C0"), (1, "C1")):
            name = f"{'first' if who == 0 else 'second'} client{', touching takes' if naive else ''}"
            fight.plot(time, moved[:, who], style, color=colour, lw=1.2, label=name)
    fight.set(title=f"Two push one bunch, {1e3 * delay:.0f} ms one way", xlabel="[s]", ylabel="displacement [mm]")
    fight.set_xlim(3.5)

    pattern = re.compile(r"50 ms, jitter (\d+) ms: buffer (\d+) ms, off (its path|where it is now)")
    found: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for line in lines:
        if match := pattern.fullmatch(line.case):
            found.setdefault((match[1], match[3]), []).append((float(match[2]), line.value))
    for number, jitter in enumerate(sorted({jitter for jitter, _ in found}, key=int)):
        for what, style in (("its path", "o-"), ("where it is now", "s--")):
            buffer.plot(
                *zip(*found[jitter, what], strict=True), style, color=f"C{number}", label=f"jitter {jitter} ms, {what}"
            )
    buffer.set(
        title="Jitter buffer, delay 50 ms: joints off, RMS", xlabel="buffer = added latency [ms]", ylabel="[mrad]"
    )
    for axis in axes.flat:
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    to.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(to, dpi=90)
    plt.close(figure)
