"""``vinesim render``: one picture of a scene with its ground truth."""

from __future__ import annotations

import pathlib
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from vinesim.errors import UsageError

if TYPE_CHECKING:
    from vinesim.client.composition.scene_composer import SceneComposer


def run(
    scene: str,
    *,
    camera: str,
    at: str,
    look: str,
    size: str | None,
    seed: int | None,
    out: pathlib.Path,
    robots: Sequence[str] = (),
    people: Sequence[str] = (),
    crates: Sequence[str] = (),
    hour: float | None = None,
    renderer: str = "warp",
    device: str = "cpu",
) -> int:
    """Render and write ``rgb``, ``depth``, ``measured``, ``labels``, ``overlay`` PNGs, ``camera``, ``truth`` JSON."""
    from vinesim.physics.plants.device_buffers import find_device
    from vinesim.scene.camera_geometry import depth_millimetres
    from vinesim.scene.generation.vineyard import generate
    from vinesim.scene.ids import unlabel
    from vinesim.scene.spec import load_scene, with_seed
    from vinesim.sensors.camera.camera import Camera, CameraSpec
    from vinesim.sensors.export import annotations as formats
    from vinesim.sensors.export import images as picture
    from vinesim.sensors.export.dataset import resized_intrinsics
    from vinesim.sensors.raster import renderer_selection
    from vinesim.sensors.scene.primitives import Primitives
    from vinesim.sensors.scene.ray_caster import enclosing_primitive
    from vinesim.sensors.truth import ground_truth

    find_device(device)
    renderer_selection.check_renderer(renderer, device)
    eye, target = parse_point("--at", at), parse_point("--look", look)
    if np.linalg.norm(target - eye) < 1e-6:
        raise UsageError(f"--look {look} is where the camera stands; look at another point")
    if eye[2] <= 0.0:
        raise UsageError(f"--at {at} lies in the ground; give a height above 0")
    spec = CameraSpec.load(camera)
    info = resized_intrinsics(spec, None if size is None else parse_size(size))
    plan, staged = with_seed(load_scene(scene), seed), parse_composition(robots, people, crates)
    sun = plan.sun if hour is None else msgspec.structs.replace(plan.sun, hour=hour)
    model = generate(plan)
    view = staged.compose(model)
    primitives = Primitives(model, renderer=renderer, device=device)
    primitives.update(view)
    inside = enclosing_primitive(primitives, eye)
    if inside >= 0:
        organ, index = unlabel(int(primitives.label[inside]))
        raise UsageError(f"--at {at} lies inside {organ.name.lower()} {index}; move the camera out of it")
    pose = picture.look_at(eye, target)
    seen = ground_truth.render_buffers(primitives, info, pose)
    truths = ground_truth.bunch_truths(primitives, view, seen)
    frame = Camera(spec, info, "camera", sun.direction(), quality="still", device=device).render(primitives, pose)
    assert frame.exact_depth is not None, "a camera that renders by itself gives exact depth"
    images = {
        "rgb": frame.rgb,
        "depth": depth_millimetres(frame.exact_depth),
        "measured": depth_millimetres(frame.depth),
        "labels": formats.encode_labels(frame.labels),
        "overlay": formats.draw_overlay(frame.rgb, truths),
    }
    actors = formats.actor_records(staged.actor_records(model), seen.labels)
    described = {"scene": plan.name, "seed": plan.seed, "digest": model.digest(), "actors": actors}
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, image in images.items():
            picture.write_png(out / f"{name}.png", image)
        formats.write_json(out / "camera.json", formats.camera_record(spec.model, info, pose))
        formats.write_json(out / "truth.json", {**described, "bunches": formats.bunch_records(truths, info)})
    except OSError as bad:
        raise UsageError(f"--out {out} cannot be written: {bad.strerror or bad}") from None
    in_sight = [one for one in truths if one.pixels]
    print(
        f"{out}: {len(in_sight)} bunches, {sum(t.berries_seen for t in in_sight)} of "
        f"{sum(t.berries for t in in_sight)} berries and {sum(t.cut_seen for t in in_sight)} cut points in sight"
    )
    return 0


def parse_composition(robots: Sequence[str], people: Sequence[str], crates: Sequence[str]) -> SceneComposer:
    """The actors and crates of ``--robot``, ``--person`` and ``--crate``; :class:`UsageError` if one is wrong."""
    from vinesim.client.composition.scene_composer import CratePlacement, PersonPlacement, RobotPlacement, SceneComposer
    from vinesim.robot.description.loader import load_description
    from vinesim.scene import appearance

    placed_robots, placed_people, placed_crates = [], [], []
    for text in robots:
        name, mark, where = text.rpartition("@")
        if not (mark and name):
            raise UsageError(f"--robot is {text!r}; give NAME@X,Y,YAW, such as vinebot@1.5,0.8,3.14")
        load_description(name)  # raises DescriptionError
        placed_robots.append(RobotPlacement(name, *_parse_place("--robot", where, 3)))
    for text in people:
        parts = text.split(",")
        posture = parts.pop() if len(parts) > 1 and parts[-1].strip().isidentifier() else "stand"
        if posture not in appearance.posture_names():
            raise UsageError(f"--person {text}: posture {posture!r} is none of {', '.join(appearance.posture_names())}")
        x, y, yaw = (*_parse_place("--person", ",".join(parts), 3), 0.0)[:3]
        placed_people.append(PersonPlacement(x, y, yaw, posture))
    for text in crates:
        x, y, yaw, fill = (*_parse_place("--crate", text, 4), 0.0, 0.0)[:4]
        crate = CratePlacement(x, y, yaw, fill)
        if not 0.0 <= crate.fill <= 1.0:
            raise UsageError(f"--crate {text}: the fill is {crate.fill:g}; give 0 (empty) to 1 (full)")
        placed_crates.append(crate)
    return SceneComposer(tuple(placed_robots), tuple(placed_people), tuple(placed_crates))


def _parse_place(option: str, text: str, most: int) -> list[float]:
    """``X,Y[,YAW[,...]]`` as two to ``most`` numbers."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if not 2 <= len(values) <= most or not np.isfinite(values).all() or max(map(abs, values)) > 1e4:
        fields = ",".join(("X", "Y", "YAW", "FILL")[:most])
        raise UsageError(f"{option} is at {text!r}; give {fields} in metres and radians, such as 1.5,0.8,3.14")
    return values


def parse_point(option: str, text: str) -> np.ndarray:
    """``X,Y,Z`` as a point [3] m."""
    try:
        value = np.array([float(part) for part in text.split(",")])
    except ValueError:
        value = np.zeros(0)
    if value.shape != (3,) or not np.isfinite(value).all() or np.abs(value).max() > 1e4:
        raise UsageError(f"{option} is {text!r}; give X,Y,Z in metres, such as 1.2,0.8,1.4")
    return value


def parse_size(text: str) -> tuple[int, int]:
    """``WxH`` as width and height [px]."""
    match = re.fullmatch(r"(\d{1,6})x(\d{1,6})", text)
    if match is None:
        raise UsageError(f"--size is {text!r}; give WxH in pixels, such as 640x480")
    return int(match[1]), int(match[2])
