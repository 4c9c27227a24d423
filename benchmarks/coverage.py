"""Coverage of the intervals of ``vinesim tune``: the share of fits whose 90 % interval contains the true value.

The specimens are the canes and bunches of ``vinesim bench tune``, whose truth is drawn from a seed and differs from the
guess by a factor of up to five. If intervals are right, 86 to 94 % of 200 fits contain the truth with a probability of
95 %, and 82 to 98 % of 50 fits. The tracks are those of a marker with 2 mm of noise, or those of the bare plant in
pictures of a simulated D435.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from vinesim.bench.tuning import recover, recovery_rows
from vinesim.bench.tuning_cases import BUNCH_MODULUS_BAR, MODULUS_BAR, draw_bunch, draw_case
from vinesim.bench.tuning_pictures import film_bunch, film_cane
from vinesim.scene.values import Measurement
from vinesim.tune import measure

DRAWS = {"cane": (draw_case, film_cane, MODULUS_BAR), "bunch": (draw_bunch, film_bunch, BUNCH_MODULUS_BAR)}
"""Function that draws a case from a seed, function that films it, and largest accepted error of the modulus, of each
plant."""


def coverage(
    seeds: int, first: int, plants: str, tracks_from: str, announce: Callable[[str], None]
) -> Iterator[Measurement]:
    """Fit plants of the ``seeds`` seeds from ``first`` on to tracks.

    ``plants``: a key of :data:`DRAWS`, or "both". ``tracks_from``: "marker" or "rgbd". ``announce`` is called with
    a line of text about the progress.
    """
    for plant, (draw, film, bar) in DRAWS.items():
        if plants not in ("both", plant):
            continue
        cases = []
        tracks = []
        for seed in range(first, first + seeds):
            cases.append(draw(seed))
            case = cases[-1]
            tracks.append(film(case).track if tracks_from == "rgbd" else measure(case.truth, case.experiment))
            if len(cases) % 10 == 0:
                announce(f"{plant}: {len(cases)} of {seeds} tracks simulated")
        found = recover(cases, tracks, bar)
        yield from recovery_rows(f"{plant} from {tracks_from}, seeds {first} to {first + seeds - 1}", found)
