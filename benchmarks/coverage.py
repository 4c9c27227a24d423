"""Coverage of the intervals of ``vinesim tune``: the share of fits whose 90 % interval contains the true value.

The specimens are the canes and bunches of ``vinesim bench tune``, whose truth is drawn from a seed and differs from the
guess by a factor of up to five. If intervals are right, 86 to 94 % of 200 fits contain the truth with a probability of
95 %, and 82 to 98 % of 50 fits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from vinesim.bench.tuning import recover, recovery_rows
from vinesim.bench.tuning_cases import BUNCH_MODULUS_BAR, MODULUS_BAR, draw_bunch, draw_case
from vinesim.scene.values import Measurement
from vinesim.tune import measure

DRAWS = {"cane": (draw_case, MODULUS_BAR), "bunch": (draw_bunch, BUNCH_MODULUS_BAR)}
"""Function that draws a case from a seed, and largest accepted error of the modulus, of each plant."""


def coverage(seeds: int, first: int, plants: str, announce: Callable[[str], None]) -> Iterator[Measurement]:
    """Fit plants of the ``seeds`` seeds from ``first`` on to tracks of a marker.

    ``plants``: a key of :data:`DRAWS`, or "both". ``announce`` is called with a line of text about the progress.
    """
    for plant, (draw, bar) in DRAWS.items():
        if plants not in ("both", plant):
            continue
        cases = []
        tracks = []
        for seed in range(first, first + seeds):
            cases.append(draw(seed))
            tracks.append(measure(cases[-1].truth, cases[-1].experiment))
            if len(cases) % 10 == 0:
                announce(f"{plant}: {len(cases)} of {seeds} tracks simulated")
        found = recover(cases, tracks, bar)
        yield from recovery_rows(f"{plant}, seeds {first} to {first + seeds - 1}", found)
