"""``python -m benchmarks sensors``: how well the modelled sensors measure a vineyard whose truth is known, with plots.

Four things are measured: depth error and fill rate of a D435 against range (plane, leaves, bunches), compared with the
maker's formula; ranges of lidars; the share of berries that are visible against the hidden share of their bunch; and
the rasteriser, compared with the ray caster. Everything is seeded: the figures are the same every time.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Iterator

import cv2
import msgspec
import numpy as np

from vinesim.core import frames
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import LABEL_STRIDE, Organ
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.scene.values import CameraFrame, Measurement, RigidVisual, Shape, Snapshot
from vinesim.sensors import ground_truth
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export.images import depth_colours, look_at, write_png
from vinesim.sensors.lidar.lidar import Lidar, LidarSpec
from vinesim.sensors.primitives.ray_caster import RayCaster
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot
from vinesim.sensors.raster.camera_rasterizer import CameraRasterizer, pinhole

RANGES = (0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0)
"""Ranges at which depth is measured [m]; pixels within a tenth of a range count for it."""
VIEWS_PER_RANGE = 8
"""Number of bunches that are looked at from each range."""
LIDARS = ("vlp16", "os1_64")
MIXED_RETURN_ERROR = 0.05
"""A return counts as mixed if its range differs by more than this from the range on the axis of its beam [m]."""
SEED = 7
RASTERIZER_VIEW = np.array([1.15, 0.95, 1.45]), np.array([2.1, 0.6, 1.72])
"""Camera position and target [m] for the comparison of rasteriser and ray caster."""


@dataclasses.dataclass
class DepthStatistics:
    """Depth measured by a camera on one kind of surface, by range."""

    error: dict[float, float] = dataclasses.field(default_factory=dict)
    """Standard deviation of depth by range, from the median of absolute errors [m]."""
    fill: dict[float, float] = dataclasses.field(default_factory=dict)
    """Share of the pixels with a measured depth, by range."""

    def add(self, away: float, exact: np.ndarray, measured: np.ndarray) -> None:
        """Add the pixels [k] at the range ``away`` [m], if there are enough for statistics.

        ``exact``, ``measured``: depths [k] m; NaN or infinite where nothing was measured.
        """
        if len(exact) > 500:
            found = np.isfinite(measured)
            self.fill[away] = float(found.mean())
            self.error[away] = float(1.4826 * np.median(np.abs(measured[found] - exact[found])))


def depth_noise_formula(spec: CameraSpec, depth: np.ndarray) -> np.ndarray:
    """Returns the maker's standard deviation of depth [m]: z^2 sigma_d / (f B)."""
    assert spec.stereo is not None
    return np.asarray(depth) ** 2 * spec.stereo.noise.value / (spec.stereo.focal.value * spec.stereo.baseline.value)


def _exact_depth(frame: CameraFrame) -> np.ndarray:
    """Returns the exact depth [height, width] m of a picture."""
    assert frame.exact_depth is not None
    return frame.exact_depth


def measure_plane(spec: CameraSpec) -> DepthStatistics:
    """Measure a grey plane that faces the camera and is lit by the sun."""
    found = DepthStatistics()
    for number, away in enumerate(RANGES):
        wall = Shape("box", (0.05, 20.0, 20.0), frames.pose(np.array([away + 0.05, 0.0, 1.0])))
        nothing = Model.allocate(tree=0, body=0, bunch=0, leaf=0, fixed=0, tie=0, box=0)
        snapshot = rest_snapshot(
            nothing, (RigidVisual("wall", Organ.ROBOT, 0, (wall,)),), frames.pose(np.zeros(3))[None]
        )
        primitives = Primitives(nothing, grass=0.0)
        primitives.update(snapshot)
        camera = Camera(spec, spec.info("optical"), seed=SEED, image_index=number)
        frame = camera.render(primitives, look_at(np.array([0, 0, 1.0]), np.array([1.0, 0, 1.0])))
        exact = _exact_depth(frame)
        mine = (frame.labels // LABEL_STRIDE == int(Organ.ROBOT)) & (exact < 1.1 * away)
        found.add(away, exact[mine], frame.depth[mine])
    return found


def measure_plants(
    spec: CameraSpec, model: Model, primitives: Primitives, snapshot: Snapshot
) -> dict[str, DepthStatistics]:
    """Measure leaves and bunches from all ranges around some bunches."""
    rng = np.random.default_rng(SEED)
    camera = Camera(spec, spec.info("optical"), seed=SEED)
    seen: dict[tuple[str, float], list[tuple[np.ndarray, np.ndarray]]] = {}
    for away in RANGES:
        for _ in range(VIEWS_PER_RANGE):
            frame = camera.render(primitives, _towards_a_bunch(rng, model, snapshot, away))
            organ = frame.labels // LABEL_STRIDE
            exact = _exact_depth(frame)
            for name, number in (("leaves", Organ.LEAF), ("bunches", Organ.BUNCH)):
                for at in RANGES:
                    mine = (organ == int(number)) & (np.abs(exact / at - 1.0) < 0.1)
                    seen.setdefault((name, at), []).append((exact[mine], frame.depth[mine]))
    found = {"leaves": DepthStatistics(), "bunches": DepthStatistics()}
    for (name, at), parts in seen.items():
        exact, measured = (np.concatenate(column) for column in zip(*parts, strict=True))
        found[name].add(at, exact, measured)
    return found


def _towards_a_bunch(rng: np.random.Generator, model: Model, snapshot: Snapshot, away: float) -> np.ndarray:
    """Returns the pose [7] of an optical frame that looks at a random bunch from ``away`` [m], at the height of a
    robot."""
    bunch = int(rng.integers(len(model.bunch_body)))
    pose = snapshot.body_q[model.bunch_body[bunch]].astype(float)
    middle = pose[:3] + frames.rotate(pose[3:], np.array([0.5 * model.bunch_length[bunch], 0.0, 0.0]))
    around = rng.uniform(0.0, 2.0 * np.pi)
    rise = float(np.clip(rng.uniform(1.2, 1.7) - middle[2], -0.4 * away, 0.4 * away))
    level = np.sqrt(away**2 - rise**2)
    return look_at(middle + np.array([level * np.cos(around), level * np.sin(around), rise]), middle)


def measure_berries(spec: CameraSpec, model: Model, primitives: Primitives, snapshot: Snapshot) -> np.ndarray:
    """Returns, for each whole bunch in a picture, the hidden share of the bunch and the visible share of its berries
    [k, 2]."""
    rng = np.random.default_rng(SEED)
    info = spec.info("optical")
    rows = []
    for away in (0.6, 0.8, 1.0, 1.3):
        for _ in range(VIEWS_PER_RANGE):
            seen = ground_truth.render_buffers(primitives, info, _towards_a_bunch(rng, model, snapshot, away))
            for one in ground_truth.bunch_truths(primitives, snapshot, seen):
                left, top, right, bottom = one.amodal_box
                whole = left > 0 and top > 0 and right < info.width - 1 and bottom < info.height - 1
                if whole and one.amodal_pixels > 1500:
                    rows.append((one.occlusion, one.berries_seen / one.berries))
    return np.array(rows)


@dataclasses.dataclass(frozen=True)
class RangeStatistics:
    """Ranges of one revolution of a lidar in the vineyard."""

    exact: np.ndarray
    """Exact ranges of thin beams [point] m."""
    real: np.ndarray
    """Ranges that the modelled lidar measures [point] m."""
    returned: float
    """Share of the shots with a target in range that returned."""
    mixed: float
    """Share of the returns, before noise, that differ by more than :data:`MIXED_RETURN_ERROR` from the range on the
    beam's axis."""


def measure_ranges(name: str, primitives: Primitives) -> RangeStatistics:
    """Measure with the lidar ``name`` between two rows of the demo scene, 1 m above the ground."""
    pose = frames.pose(np.array([3.7, 1.25, 1.0]))
    spec = LidarSpec.load(name)

    def but(**values: float) -> LidarSpec:
        return msgspec.structs.replace(
            spec, **{k: msgspec.structs.replace(getattr(spec, k), value=v) for k, v in values.items()}
        )

    steady = but(noise=0.0, weak_noise=0.0, step=0.0)
    thin, real, wide = (Lidar(s, seed=SEED).scan(primitives, pose) for s in (spec.ideal(), spec, steady))
    exact, noisy, mean = (np.linalg.norm(s.xyz.astype(float), axis=1) for s in (thin, real, wide))
    shots = [{(o, r): k for k, (o, r) in enumerate(zip(s.offset, s.ring, strict=True))} for s in (thin, wide)]
    both = sorted(shots[0].keys() & shots[1].keys())
    first, second = (np.array([which[shot] for shot in both]) for which in shots)
    mixed = float((np.abs(exact[first] - mean[second]) > MIXED_RETURN_ERROR).mean())
    return RangeStatistics(exact, noisy, len(noisy) / len(exact), mixed)


@dataclasses.dataclass
class PixelView:
    """Depth and primitive in each pixel of one view [height, width]."""

    depth: np.ndarray
    """Depth [m], infinite where there is nothing."""
    primitive: np.ndarray


def compare_with_rays(spec: CameraSpec, model: Model, snapshot: Snapshot) -> dict[str, PixelView]:
    """Returns one view by the rasteriser, ``warp``, and by the ray caster, ``rays``, which is the reference."""
    info = spec.info("optical")
    pose = look_at(*RASTERIZER_VIEW)
    lens = pinhole(info, pose)
    primitives = Primitives(model)
    primitives.update(snapshot)
    seen = CameraRasterizer(info.width, info.height)
    seen.draw(primitives, lens)
    depth, primitive = (a.numpy().reshape(info.height, info.width) for a in (seen.depth, seen.primitive))
    return {"warp": PixelView(depth, primitive), "rays": PixelView(*RayCaster(primitives).cast_camera(lens))}


def sensors(plot: pathlib.Path | None = None) -> Iterator[Measurement]:
    """Measure all sensor models. ``plot``: folder for the pictures."""
    model = generate(load_scene("demo"))
    primitives = Primitives(model)
    snapshot = rest_snapshot(model)
    spec = CameraSpec.load("d435")
    depths = {"plane": measure_plane(spec), **measure_plants(spec, model, primitives, snapshot)}
    for name, one in depths.items():
        for away, error in one.error.items():
            law = float(depth_noise_formula(spec, np.array(away)))
            peer = "formula z^2 s / (f B)"
            yield Measurement(
                "sensors", f"d435, {name} at {away:g} m: error", 1e3 * error, "mm", peer, 1e3 * law, law / error
            )
            yield Measurement("sensors", f"d435, {name} at {away:g} m: fill rate", one.fill[away], "1")
    scans = {name: measure_ranges(name, primitives) for name in LIDARS}
    for name, scan in scans.items():
        yield Measurement("sensors", f"{name}: shots that come back, of those that hit", scan.returned, "1")
        yield Measurement("sensors", f"{name}: mixed returns", scan.mixed, "1")
    seen = measure_berries(spec, model, primitives, snapshot)
    for low, high in ((0.0, 0.1), (0.4, 0.6), (0.8, 0.95)):
        mine = (seen[:, 0] >= low) & (seen[:, 0] < high)
        if mine.any():
            case = f"berries seen, bunch hidden by {100 * low:.0f} to {100 * high:.0f} %"
            yield Measurement("sensors", case, float(np.median(seen[mine, 1])), "1")
    pictures = compare_with_rays(spec, model, snapshot)
    same = float((pictures["warp"].primitive == pictures["rays"].primitive).mean())
    yield Measurement("sensors", "warp: pixels that see what their rays meet", same, "1")
    if plot is not None:
        _draw(plot, spec, depths, scans, seen)
        _compare(plot, pictures)


def _compare(folder: pathlib.Path, pictures: dict[str, PixelView]) -> None:
    """Write ``sensors-rasterizer.png``: depth by the rasteriser, magenta where the primitive differs from the ray
    caster's, then depth by the ray caster."""
    tiles = []
    for look in pictures.values():
        image = depth_colours(look.depth, 5.0)
        wrong = (look.primitive != pictures["rays"].primitive).astype(np.uint8)
        image[cv2.dilate(wrong, np.ones((5, 5), np.uint8)) > 0] = (255, 0, 255)
        tiles.append(cv2.resize(image, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA))
    write_png(folder / "sensors-rasterizer.png", np.hstack(tiles))


def _draw(
    folder: pathlib.Path,
    spec: CameraSpec,
    depths: dict[str, DepthStatistics],
    scans: dict[str, RangeStatistics],
    seen: np.ndarray,
) -> None:
    """Write ``sensors-depth.png``, ``sensors-lidar.png`` and ``sensors-berries.png``."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    figure, (error, fill) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    line = np.geomspace(RANGES[0], RANGES[-1], 50)
    error.plot(line, 1e3 * depth_noise_formula(spec, line), "k--", label="maker's formula, z² · 0.08 px / (f B)")
    for (name, one), mark in zip(depths.items(), "os^", strict=False):
        error.plot(list(one.error), 1e3 * np.array(list(one.error.values())), mark, label=name)
        fill.plot(list(one.fill), 100.0 * np.array(list(one.fill.values())), mark + "-", label=name)
    error.set(xscale="log", yscale="log", xlabel="range [m]", ylabel="[mm]", title="D435 model: depth error (1 sigma)")
    fill.set(xscale="log", xlabel="range [m]", ylabel="[%]", ylim=(0, 104), title="D435 model: fill rate")
    for axis in (error, fill):
        axis.set_xticks(RANGES, [f"{r:g}" for r in RANGES], fontsize=8)
        axis.minorticks_off()
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    figure.savefig(folder / "sensors-depth.png", dpi=90)
    plt.close(figure)

    figure, axes = plt.subplots(1, len(scans), figsize=(11, 4), layout="constrained")
    for axis, (name, scan) in zip(axes, scans.items(), strict=True):
        bins = np.arange(0.0, 25.1, 0.25)
        axis.hist(scan.exact, bins, color="0.75", label="thin beams, exact")
        axis.hist(scan.real, bins, histtype="step", color="C0", label="as modelled")
        axis.set(yscale="log", xlabel="range [m]", ylabel="points of one revolution", title=name)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    figure.savefig(folder / "sensors-lidar.png", dpi=90)
    plt.close(figure)

    figure, axis = plt.subplots(figsize=(5.5, 4), layout="constrained")
    axis.plot(100.0 * seen[:, 0], 100.0 * seen[:, 1], ".", ms=4, alpha=0.5)
    axis.set(xlabel="bunch hidden [% of its pixels]", ylabel="berries seen [% of all]", title="Truth of the demo scene")
    axis.grid(alpha=0.3)
    figure.savefig(folder / "sensors-berries.png", dpi=90)
    plt.close(figure)
