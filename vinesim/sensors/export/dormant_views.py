"""Views of dormant vines for data sets, and the ground truth of their nodes and buds."""

from __future__ import annotations

from typing import Any

import numpy as np

from vinesim.core import frames
from vinesim.scene.camera_geometry import project_points
from vinesim.scene.ids import LABEL_STRIDE, Organ
from vinesim.scene.model import Model
from vinesim.scene.values import CameraInfo, Snapshot
from vinesim.sensors import ground_truth
from vinesim.sensors.export.mix import ViewEntry, draw_number
from vinesim.sensors.export.views import ViewError, ViewFinder
from vinesim.sensors.ground_truth import PixelBuffers

LOWEST_NODES = 6
"""Views look at one of so many nodes from the base of a cane, where pruning cuts."""
_TRIES = 200


def view_of_node(
    finder: ViewFinder, rng: np.random.Generator, entry: ViewEntry, info: CameraInfo
) -> tuple[PixelBuffers, dict[str, Any]]:
    """Returns a view from a free place, within the limits of a mix, of a random node near the base of a dormant cane,
    which is visible; and the drawn values.

    Raises :class:`~vinesim.sensors.export.views.ViewError` if there is none.
    """
    nodes = finder.primitives.model.nodes
    places = nodes.positions(finder.snapshot.body_q)
    candidates = np.flatnonzero((nodes.bud >= 0) & (nodes.rank < LOWEST_NODES))
    for _ in range(_TRIES):
        node = int(candidates[rng.integers(len(candidates))])
        side = 1.0 if rng.random() < 0.5 else -1.0
        values = {name: draw_number(rng, getattr(entry, name)) for name in ("pitch", "turn", "roll", "across", "down")}
        values["distance"] = draw_number(rng, entry.distance)
        pose = finder.pose_at(places[node], side, values, info)
        if not finder.is_free(pose, entry, values["distance"]):
            continue
        seen = ground_truth.render_buffers(finder.primitives, info, pose)
        organ = seen.labels // LABEL_STRIDE
        index = seen.labels % LABEL_STRIDE
        shown = (organ == Organ.NODE) & (index == node) | (organ == Organ.BUD) & (index == nodes.bud[node])
        if shown.any() and not finder.is_obstructed(seen):
            return seen, {"node": node, "side": side, **values}
    raise ViewError(
        f"scene {finder.name!r} has no open place near its canes for views {entry.name!r} of the mix, in {_TRIES} "
        "tries; widen the ranges of the mix"
    )


def node_records(model: Model, snapshot: Snapshot, seen: PixelBuffers) -> list[dict[str, Any]]:
    """Returns, for JSON, the nodes of dormant wood of which a picture shows a pixel of the node or of its bud: ids,
    rank from the base of the cane, position [m] in the world, pixel [column, row] of the node, and numbers of pixels.
    """
    nodes = model.nodes
    organ = seen.labels // LABEL_STRIDE
    index = seen.labels % LABEL_STRIDE
    node_pixels = np.bincount(index[organ == Organ.NODE], minlength=len(nodes.body))
    bud_pixels = np.bincount(index[organ == Organ.BUD], minlength=int(nodes.bud.max(initial=-1)) + 1)
    has = nodes.bud >= 0
    of_bud = np.zeros(len(nodes.body), int)
    of_bud[has] = bud_pixels[nodes.bud[has]]
    shown = np.flatnonzero(node_pixels + of_bud)
    places = nodes.positions(snapshot.body_q)[shown]
    local = frames.rotate(frames.conjugate(seen.pose[3:]), places - seen.pose[:3])
    pixels = project_points(local, seen.info)
    return [
        {
            "node": int(node),
            "bud": int(nodes.bud[node]),
            "cane": int(nodes.cane[node]),
            "rank": int(nodes.rank[node]),
            "year": int(model.canes.year[nodes.cane[node]]),
            "position": place.tolist(),
            "pixel": pixel.tolist(),
            "node_pixels": int(node_pixels[node]),
            "bud_pixels": int(of_bud[node]),
        }
        for node, place, pixel in zip(shown, places, pixels, strict=True)
    ]
