"""``vinesim render``: one picture of a scene from one place, and all that is true of it."""

from __future__ import annotations

import pathlib
import re

import numpy as np


def run(scene: str, *, camera: str, at: str, look: str, size: str | None, seed: int | None, out: pathlib.Path) -> int:
    """Draw it and write ``rgb``, ``depth``, ``measured``, ``labels``, ``overlay`` PNGs, ``camera``, ``truth`` JSON."""
    from vinesim.cli.join import WrongUse
    from vinesim.sensors import formats, picture, truth
    from vinesim.sensors.camera import Camera, CameraSpec
    from vinesim.sensors.dataset import sized
    from vinesim.sensors.primitives import Primitives, still_view
    from vinesim.sensors.raycast import enclosing
    from vinesim.world.generate import generate
    from vinesim.world.ids import unlabel
    from vinesim.world.scene import load, reseeded

    eye, target = point("--at", at), point("--look", look)
    if np.linalg.norm(target - eye) < 1e-6:
        raise WrongUse(f"--look {look} is where the camera stands; look at another point")
    if eye[2] <= 0.0:
        raise WrongUse(f"--at {at} lies in the ground; give a height above 0")
    spec = CameraSpec.load(camera)
    info = sized(spec, None if size is None else pixels(size))
    plan = reseeded(load(scene), seed)
    model = generate(plan)
    view, primitives = still_view(model), Primitives(model)
    primitives.update(view)
    inside = enclosing(primitives, eye)
    if inside >= 0:
        organ, index = unlabel(int(primitives.label[inside]))
        raise WrongUse(f"--at {at} lies inside {organ.name.lower()} {index}; move the camera out of it")
    pose = picture.looking(eye, target)
    seen = truth.look(primitives, info, pose)
    truths = truth.of_bunches(primitives, view, seen)
    frame = Camera(spec, info, "camera", plan.sun.direction(), taps=16, shadow_period=0.0).render(primitives, pose)
    images = {
        "rgb": frame.rgb,
        "depth": picture.depth_millimetres(frame.exact_depth),
        "measured": picture.depth_millimetres(frame.depth),
        "labels": formats.ids(frame.labels),
        "overlay": formats.overlay(frame.rgb, truths),
    }
    described = {"scene": plan.name, "seed": plan.seed, "digest": model.digest()}
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, image in images.items():
            picture.write_png(out / f"{name}.png", image)
        formats.write_json(out / "camera.json", formats.camera(spec.model, info, pose))
        formats.write_json(out / "truth.json", {**described, "bunches": formats.record(truths, info)})
    except OSError as bad:
        raise WrongUse(f"--out {out} cannot be written: {bad.strerror or bad}") from None
    in_sight = [one for one in truths if one.pixels]
    print(
        f"{out}: {len(in_sight)} bunches, {sum(t.berries_seen for t in in_sight)} of "
        f"{sum(t.berries for t in in_sight)} berries and {sum(t.cut_seen for t in in_sight)} cut points in sight"
    )
    return 0


def point(option: str, text: str) -> np.ndarray:
    """``X,Y,Z`` as a point [3] m."""
    from vinesim.cli.join import WrongUse

    try:
        value = np.array([float(part) for part in text.split(",")])
    except ValueError:
        value = np.zeros(0)
    if value.shape != (3,) or not np.isfinite(value).all() or np.abs(value).max() > 1e4:
        raise WrongUse(f"{option} is {text!r}; give X,Y,Z in metres, such as 1.2,0.8,1.4")
    return value


def pixels(text: str) -> tuple[int, int]:
    """``WxH`` as width and height [px]."""
    from vinesim.cli.join import WrongUse

    match = re.fullmatch(r"(\d{1,6})x(\d{1,6})", text)
    if match is None:
        raise WrongUse(f"--size is {text!r}; give WxH in pixels, such as 640x480")
    return int(match[1]), int(match[2])
