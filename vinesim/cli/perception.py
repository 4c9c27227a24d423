"""``vinesim fuse`` and ``vinesim view``: surfaces from RGB-D tours, and pictures of clouds and surfaces."""

from __future__ import annotations

import pathlib
import re
import time
from collections.abc import Sequence

import numpy as np

from vinesim.cli.render import parse_point, parse_size
from vinesim.core.errors import UsageError, writing
from vinesim.core.progress import ProgressLine
from vinesim.perception import fusion, viewing
from vinesim.perception.open3d_library import load_open3d
from vinesim.perception.tour import open_tour
from vinesim.sensors.export.images import write_png

_OPTIONS = {"voxel": "--voxel", "farthest": "--far", "least_views": "--views"}
"""Option of each argument of :func:`vinesim.perception.fuse` that its errors name."""


def fuse(
    tour: pathlib.Path, *, out: pathlib.Path, voxel: float, far: float, depth: str, ids: bool, views: int | None
) -> int:
    """Fuse the pictures of a tour, write a PLY file, and print its size. Returns the exit code."""
    if depth not in ("exact", "measured"):
        raise UsageError(f"--depth is {depth!r}; give exact or measured")
    if out.suffix.lower() != ".ply":
        raise UsageError(f"--out is {out}; give a file with the suffix .ply")
    _check_folder_of(out)
    began = time.monotonic()
    try:
        load_open3d()  # before the first picture is read
        pictures = open_tour(tour)
        count = f"{len(pictures)} picture{'s' if len(pictures) > 1 else ''}"
        with ProgressLine() as line:
            surface = fusion.fuse(
                pictures,
                voxel=voxel,
                farthest=far,
                exact=depth == "exact",
                ids=ids,
                least_views=views,
                advance=lambda done: line.show(f"fused {done} of {count}"),
            )
        with writing(out):
            surface.write(out)
    except KeyboardInterrupt:
        print(f"stopped; {out} was not written")
        return 130
    except UsageError as bad:
        raise UsageError(
            re.sub(r"\b(voxel|farthest|least_views)\b", lambda name: _OPTIONS[name[1]], str(bad))
        ) from None
    print(
        f"{out}: {len(surface.vertices)} vertices, {len(surface.triangles)} triangles of {count}, "
        f"voxels of {1000.0 * voxel:g} mm, {time.monotonic() - began:.0f} s"
    )
    return 0


def _check_folder_of(out: pathlib.Path) -> None:
    if not out.absolute().parent.is_dir():
        raise UsageError(f"--out is {out}: its folder is not there; make it first")


def view(
    files: Sequence[pathlib.Path],
    *,
    out: pathlib.Path | None,
    picture: int,
    at: str | None,
    look: str | None,
    size: str | None,
    image: str | None = None,
    depth: str | None = None,
) -> int:
    """Show a file in Open3D's viewer, or write a picture of it. Returns the exit code."""
    if len(files) != 1:
        raise UsageError(f"view shows one file, not {len(files)}; call it once for each")
    (file,) = files
    if out is None and (at is not None or look is not None or size is not None):
        raise UsageError("--at, --look and --size belong to a picture; give --out picture.png, too")
    if out is not None and out.suffix.lower() != ".png":
        raise UsageError(f"--out is {out}; give a file with the suffix .png")
    if out is not None:
        _check_folder_of(out)
    eye: np.ndarray | None = None if at is None else parse_point("--at", at)
    target: np.ndarray | None = None if look is None else parse_point("--look", look)
    width, height = (960, 720) if size is None else parse_size(size)
    if not (min(width, height) >= 16 and max(width, height) <= 4096):
        raise UsageError(f"--size is {size!r}; give width and height from 16 to 4096 px")
    if out is None and not viewing.has_display():
        raise viewing.NoDisplay("there is no display for Open3D's viewer; give --out picture.png, or set DISPLAY")
    shape = viewing.read_shape(file, picture, image, depth)
    print(f"{file}: {shape.text}", flush=True)
    if out is None:
        viewing.show(shape, f"vinesim: {file.name}")
    else:
        with writing(out):
            write_png(out, viewing.draw(shape, width, height, eye, target))
        print(f"picture: {out}")
    return 0
