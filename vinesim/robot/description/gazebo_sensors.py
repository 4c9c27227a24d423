"""Sensors of a robot as Gazebo describes them in a URDF: ``<gazebo reference="link"><sensor type="...">``.

Rates, sizes, angles, ranges and noise become those of vinesim's sensors. A camera of Gazebo looks along x of its link;
one of vinesim has an optical frame, which is added unless the URDF has it.
"""

from __future__ import annotations

import math

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.core import frames
from vinesim.robot.description.names import valid_names
from vinesim.robot.description.urdf import parse_origin
from vinesim.scene.values import CameraMount, GnssMount, ImuMount, LidarMount, RenderedMount, SensorMount

COLOR_CAMERAS = ("camera", "wideanglecamera", "wide_angle_camera", "multicamera")
DEPTH_CAMERAS = ("depth", "depth_camera", "rgbd", "rgbd_camera")
LIDARS = ("ray", "gpu_ray", "lidar", "gpu_lidar")
RECEIVERS = ("gps", "navsat")
"""Types of sensors in Gazebo that become GNSS receivers. ``COLOR_CAMERAS``, ``DEPTH_CAMERAS``: those that become
cameras; ``LIDARS``: lidars."""
FRAME_TAGS = ("optical_frame_id", "gz_frame_id", "ignition_frame_id", "frame_name", "frameName")
"""Elements of a sensor or of its plugin that name the frame of its messages."""
EXACT_CAMERA = "pinhole"
"""Data file on which cameras of Gazebo are based: as in Gazebo, depth is exact."""
LIDAR = "vlp16"
"""Data file on which lidars of Gazebo are based, without its width of beams and losses."""
OPTICAL = (-0.5 * math.pi, 0.0, -0.5 * math.pi)
"""[rad] Roll, pitch and yaw of an optical frame (z ahead, x right) in the frame of a camera (x ahead, z up)."""
RECEIVER = "rtk"
"""Data file on which GNSS receivers of Gazebo are based."""
FIX_LIMITS = (0.1, 0.8)
"""[m] Standard deviation of Gazebo's horizontal noise from which a receiver has float, and single, fixes. Receivers
without noise have fixed ones. GUESSED: between the errors of the kinds in the data file."""
MAX_LIDAR_RANGE = 200.0
"""[m] Largest range of a lidar; Gazebo's is often infinite."""
MAX_CAMERA_RANGE = 300.0
"""[m] Largest depth of a camera."""
MAX_BEAMS = 128
"""Largest number of lasers of a lidar; of more, every n-th is kept."""


def read_sensors(
    root: etree._Element, notes: list[str], assumed: list[str]
) -> tuple[list[RenderedMount], list[ImuMount], list[SensorMount]]:
    """Returns cameras, lidars and GNSS receivers, inertial sensors, and force-torque sensors of a URDF.

    Adds the frames that they need to ``root``, the sensors that were found to ``notes``, and sensors that vinesim does
    not have to ``assumed``.
    """
    links = {link.get("name") for link in root.iterfind("link")}
    rendered: list[RenderedMount] = []
    imus: list[ImuMount] = []
    wrenches: list[SensorMount] = []
    child_of = {joint.get("name"): joint.find("child").get("link") for joint in root.iterfind("joint/child/..")}
    unknown: list[str] = []
    taken: set[str] = set()
    found = [
        (gazebo.get("reference"), sensor) for gazebo in root.iterfind("gazebo") for sensor in gazebo.iterfind("sensor")
    ]
    found += [(_owner(sensor), sensor) for sensor in root.iterfind("sensor")]
    for link, sensor in found:
        kind = (
            sensor.get("type") or next((one for one in ("camera", "ray") if sensor.find(one) is not None), "")
        ).lower()
        if kind == "force_torque":  # of a joint: it measures at the joint's child
            link = child_of.get(link, link)
        if link not in links:
            unknown.append(f"{kind} of the link {link!r}, which does not exist")
            continue
        name = _free_name(sensor.get("name") or kind or "sensor", taken)
        frame = _frame(root, link, sensor, name)
        if kind in (*COLOR_CAMERAS, *DEPTH_CAMERAS):
            rendered.append(_camera(root, name, frame, sensor))
        elif kind in LIDARS:
            rendered.append(_lidar(name, frame, sensor))
        elif kind in RECEIVERS:
            rendered.append(_receiver(name, frame, sensor))
        elif kind == "imu":
            imus.append(_imu(name, frame, sensor))
        elif kind == "force_torque":
            wrenches.append(SensorMount(name, frame))
        else:
            taken.discard(name)
            unknown.append(f"{kind or 'a sensor'} of the link {link!r}")
    if rendered or imus or wrenches:
        notes.append(f"sensors by Gazebo's tags: {', '.join(one.name for one in (*rendered, *imus, *wrenches))}")
    if unknown:
        more = f" (and {len(unknown) - 1} more)" if len(unknown) > 1 else ""
        kinds = "cameras, lidars, GNSS receivers, IMUs and force-torque sensors"
        assumed.append(f"no sensor for {unknown[0]}{more}: vinesim has {kinds}")
    return rendered, imus, wrenches


def _owner(sensor: etree._Element) -> str | None:
    """Returns the link or joint of a ``<sensor>`` that is an element of the robot itself."""
    parent = sensor.find("parent")
    return (parent.get("link") or parent.get("joint")) if parent is not None else None


def _free_name(name: str, taken: set[str]) -> str:
    """Returns a name for topics that no other sensor has."""
    name = valid_names([name.rsplit("::", 1)[-1].replace("/", "_")], "sensor").get(name, name)
    name = valid_names([name], "sensor").get(name, name)
    number = 1
    free = name
    while free in taken:
        number += 1
        free = f"{name}_{number}"
    taken.add(free)
    return free


def _frame(root: etree._Element, link: str, sensor: etree._Element, name: str) -> str:
    """Returns the link at which a sensor is: ``link``, or a new one if the sensor has a pose in it."""
    pose = sensor.find("pose")
    origin = sensor.find("origin")
    numbers = [float(word) for word in (pose.text or "").split()] if pose is not None else []
    if origin is not None:
        numbers = [float(word) for key in ("xyz", "rpy") for word in (origin.get(key) or "0 0 0").split()]
    if len(numbers) != 6 or not np.any(numbers):
        return link
    return _add_frame(root, link, f"{name}_frame", numbers[:3], numbers[3:])


def _add_frame(root: etree._Element, link: str, name: str, xyz: object, rpy: object) -> str:
    """Add a link that is fixed to ``link``, and return its name."""
    links = {one.get("name", "") for one in root.iterfind("link")}
    free = name
    number = 1
    while free in links:
        if root.xpath("joint[@type='fixed'][parent/@link=$link][child/@link=$free]", link=link, free=free):
            return free  # it was added when the robot was loaded before
        number += 1
        free = f"{name}_{number}"
    etree.SubElement(root, "link", name=free)
    joint = etree.SubElement(root, "joint", name=f"{free}_joint", type="fixed")
    etree.SubElement(joint, "parent", link=link)
    etree.SubElement(joint, "child", link=free)
    texts = [" ".join(f"{float(value):.9g}" for value in values) for values in (xyz, rpy)]  # pyright: ignore
    etree.SubElement(joint, "origin", xyz=texts[0], rpy=texts[1])
    return free


def _optical_frame(root: etree._Element, frame: str, sensor: etree._Element, name: str) -> str:
    """Returns the optical frame of a camera that looks along x of ``frame``: the one that the URDF has for it, or a new
    one."""
    named = [one.text.strip() for tag in FRAME_TAGS for one in sensor.iter(tag) if one.text]
    fixed = {
        joint.find("child").get("link"): joint
        for joint in root.iterfind("joint")
        if joint.get("type") == "fixed" and joint.find("parent").get("link") == frame
    }
    wanted = frames.to_matrix(_turn(OPTICAL))
    for child in sorted(fixed, key=lambda one: one not in named):
        origin = parse_origin(fixed[child].find("origin"))
        if origin is not None and np.allclose(origin[:3, :3], wanted, atol=1e-2) and np.allclose(origin[:3, 3], 0.0):
            return child
    return _add_frame(root, frame, f"{name}_optical_frame", (0.0, 0.0, 0.0), OPTICAL)


def _turn(angles: tuple[float, float, float]) -> np.ndarray:
    origin = parse_origin(etree.Element("origin", rpy=" ".join(map(repr, angles))))
    assert origin is not None
    return frames.from_matrix(origin[:3, :3])


def _number(element: etree._Element, path: str, default: float) -> float:
    """Returns the number at a path below an element; ``default`` if it is missing or no finite number."""
    try:
        value = float(element.findtext(path) or "")
    except ValueError:
        return default
    return value if math.isfinite(value) else default


def _rate(sensor: etree._Element, default: float, largest: float = 100.0) -> float:
    rate = _number(sensor, "update_rate", 0.0) or float(sensor.get("update_rate") or 0.0)
    return min(max(rate, 0.1), largest) if rate > 0.0 else default


def _camera(root: etree._Element, name: str, frame: str, sensor: etree._Element) -> CameraMount:
    frame = _optical_frame(root, frame, sensor, name)
    camera = sensor.find("camera")
    if camera is None:
        return CameraMount(name, frame, EXACT_CAMERA, rate=_rate(sensor, 30.0))
    image = camera.find("image")
    attributes = image.attrib if image is not None else {}
    width = int(_number(camera, "image/width", float(attributes.get("width", 320))))
    height = int(_number(camera, "image/height", float(attributes.get("height", 240))))
    field = _number(camera, "horizontal_fov", float(attributes.get("hfov", 1.047)))
    clip = "depth_camera/clip" if camera.find("depth_camera/clip") is not None else "clip"
    near = _number(camera, f"{clip}/near", float(attributes.get("near", 0.1)))
    far = min(_number(camera, f"{clip}/far", float(attributes.get("far", 100.0))), MAX_CAMERA_RANGE)
    return CameraMount(
        name,
        frame,
        EXACT_CAMERA,
        rate=_rate(sensor, 30.0),
        size=(min(max(width, 16), 4096), min(max(height, 16), 4096)),
        field_of_view=min(max(field, 0.05), 3.0),
        range=(max(near, 0.0), max(far, near + 0.01)),
        noise=min(max(_number(camera, "noise/stddev", 0.0), 0.0), 1.0),
    )


def _lidar(name: str, frame: str, sensor: etree._Element) -> LidarMount:
    ray = next((one for tag in ("lidar", "ray") if (one := sensor.find(tag)) is not None), None)
    rate = _rate(sensor, 10.0, 50.0)
    if ray is None:
        return LidarMount(name, frame, LIDAR, rate=rate, columns=360, elevations=(0.0,), range=(0.1, 30.0), noise=0.0)
    first, last, samples = _angles(ray, "horizontal", (-math.pi, math.pi), 640)
    width = min(last - first, 2.0 * math.pi)
    low, high, count = _angles(ray, "vertical", (0.0, 0.0), 1)
    count = min(max(count, 1), MAX_BEAMS) if high > low else 1
    elevations = tuple(float(angle) for angle in np.linspace(max(low, -1.57), min(high, 1.57), count))
    columns = 360 if samples < 2 or width <= 0.0 else round((samples - 1) * 2.0 * math.pi / width)
    near = max(_number(ray, "range/min", 0.05), 0.0)
    far = min(_number(ray, "range/max", MAX_LIDAR_RANGE), MAX_LIDAR_RANGE)
    return LidarMount(
        name,
        frame,
        LIDAR,
        rate=rate,
        columns=min(max(columns, 8), 4000),
        elevations=elevations if count > 1 else (0.5 * (low + high),),
        sector=None if width >= 2.0 * math.pi - 0.02 or width <= 0.0 else (first, last),
        range=(near, max(far, near + 0.1)),
        noise=min(max(_number(ray, "noise/stddev", _number(sensor, "noise/stddev", 0.0)), 0.0), 1.0),
    )


def _angles(ray: etree._Element, which: str, default: tuple[float, float], count: int) -> tuple[float, float, int]:
    """Returns first and last angle [rad] and number of the shots of a scan, across or up."""
    scan = ray.find(f"scan/{which}")
    scan = ray.find(which) if scan is None else scan
    if scan is None:
        return *default, count

    def read(key: str, otherwise: float) -> float:
        return _number(scan, key, float(scan.get(key) or otherwise))

    samples = read("samples", count) * max(read("resolution", 1.0), 0.0)
    return read("min_angle", default[0]), read("max_angle", default[1]), max(int(samples), 1)


def _receiver(name: str, frame: str, sensor: etree._Element) -> GnssMount:
    paths = (f"{tag}/position_sensing/horizontal/noise/stddev" for tag in RECEIVERS)
    noise = max(_number(sensor, path, 0.0) for path in paths)
    low, high = FIX_LIMITS
    fix = "fixed" if noise < low else "float" if noise < high else "single"
    return GnssMount(name, frame, RECEIVER, rate=_rate(sensor, 10.0, 50.0), fix=fix)


def _imu(name: str, frame: str, sensor: etree._Element) -> ImuMount:
    def noise(what: str) -> float:
        found = [
            _number(sensor, path, 0.0)
            for path in (f"imu/{what}/x/noise/stddev", f"imu/{what}/noise/stddev", f"imu/noise/{short[what]}/stddev")
        ]
        return min(max(*found, 0.0), 100.0)

    short = {"angular_velocity": "rate", "linear_acceleration": "accel"}
    return ImuMount(
        name,
        frame,
        angular_velocity_noise=noise("angular_velocity"),
        acceleration_noise=noise("linear_acceleration"),
    )
