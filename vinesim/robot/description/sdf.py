"""Converts robots in Gazebo's format (SDF) to URDF: links, joints, poses, geometry, colours and sensors.

Models that a file includes or contains become part of its links. Plugins are not read.
"""

from __future__ import annotations

import copy
import math
import pathlib
from collections.abc import Iterator

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.core import frames
from vinesim.rigid.mjcf import ellipsoid
from vinesim.rigid.urdf_writer import Part, Solid, capsule, link_frame, roll_pitch_yaw, write_urdf
from vinesim.robot.description.packages import MODEL_PATHS, find_resource
from vinesim.robot.description.urdf import DescriptionError, description_error, parse_xml
from vinesim.scene.appearance.mesh_files import store_stl

KINDS = {"revolute": "revolute", "continuous": "continuous", "prismatic": "prismatic", "fixed": "fixed"}
"""Types of SDF joints that a URDF also has. Joints of other types are fixed."""
UNLIMITED = 1e15
"""[rad or m] Magnitude from which a limit of SDF means that there is none."""
DEFAULT_SLIDE = 1.0
"""[m] Range to either side of a sliding joint without limits. GUESSED"""
MAX_DEPTH = 8
"""Largest number of models inside each other."""


def urdf_of_sdf(root: etree._Element, file: pathlib.Path) -> tuple[etree._Element, tuple[str, ...]]:
    """Returns the root of a URDF of the robot in a SDF ``file``, and notes on the conversion. Raises
    :class:`DescriptionError` if it has no model with links or its poses are malformed."""
    models = [root] if root.tag == "model" else root.findall("model") + root.findall("world/model")
    for include in root.findall("include") + root.findall("world/include"):
        if (found := _included(include, file)) is not None:
            models.append(found[0])
    models = [model for model in models if model.find(".//link") is not None]
    if not models:
        raise description_error(file, "it has no model with links", "give a SDF file of a robot")
    model = max(models, key=lambda one: (not _is_true(one.findtext("static")), len(one.findall(".//joint"))))
    version = root.get("version", "1.6") if root.tag != "model" else "1.6"
    try:
        return _Conversion(model, file, version, len(models)).result()
    except DescriptionError:
        raise
    except ValueError as error:
        raise description_error(file, f"not an SDF: {error}", "correct this element") from error


class _Conversion:
    """The conversion of one model."""

    def __init__(self, model: etree._Element, file: pathlib.Path, version: str, models: int) -> None:
        self.file = file
        self.name = model.get("name") or file.stem
        self.is_static = _is_true(model.findtext("static"))
        self.is_old = version in ("1.0", "1.2", "1.3", "1.4")
        """Whether axes of joints are in the frame of the model, as up to version 1.4."""
        self.notes: list[str] = []
        if models > 1:
            self.notes.append(f"{models - 1} other models of the file are left out")
        self.elements: dict[str, etree._Element] = {}
        """Links, joints, frames and models by full name."""
        self.files: dict[str, pathlib.Path] = {}
        """File of each element, for relative paths of meshes."""
        self.joints: list[str] = []
        self.links: list[str] = []
        self._places: dict[str, np.ndarray] = {}
        self._scopes: dict[str, str] = {}
        self._collect(model, "", file, 0)

    def result(self) -> tuple[etree._Element, tuple[str, ...]]:
        """Returns the root of the URDF, and notes."""
        parts = {name: Part(name, self._place(name)) for name in self.links}
        bolted = self.links[:1] if self.is_static else []
        for joint in self.joints:
            bolted += self._join(joint, parts)
        root = self._tree_root(parts, bolted)
        kept = [name for name in self.links if _is_below(name, root, parts)]
        if len(kept) < len(parts):
            self.notes.append(f"{len(parts) - len(kept)} links that no joint connects are left out")
        sensors = []
        for name in kept:
            self._fill(parts[name])
            sensors += self._sensors(parts[name])
        chosen = [parts[name] for name in kept]
        if root in bolted:
            parts[root].parent, parts[root].joint = "world", f"{root}_world_joint"
            chosen.insert(0, Part("world", frames.pose([0.0, 0.0, 0.0])))
        urdf = etree.fromstring(write_urdf(self.name, chosen).encode())
        urdf.extend(sensors)
        return urdf, tuple(self.notes)

    # ------------------------------------------------------------------ names and poses

    def _collect(self, model: etree._Element, scope: str, file: pathlib.Path, depth: int) -> None:
        """Store the elements of a model under their full names: ``scope`` and their own name."""
        for element in model:
            if element.tag in ("link", "joint", "frame"):
                name = scope + (element.get("name") or "")
                self.elements[name] = element
                self.files[name] = file
                self._scopes[name] = scope
                if element.tag == "link":
                    self.links.append(name)
                elif element.tag == "joint":
                    self.joints.append(name)
            elif element.tag in ("model", "include") and depth < MAX_DEPTH:
                inner, own_file = (
                    (element, file) if element.tag == "model" else _included(element, file) or (None, file)
                )
                if inner is None:
                    raise description_error(
                        file,
                        f"model {element.findtext('uri')!r} is missing",
                        f"add its folder to {MODEL_PATHS[0]}, or put it above the file",
                    )
                if element.get("merge") == "true":
                    self._collect(inner, scope, own_file, depth + 1)
                    continue
                name = scope + (element.findtext("name") or inner.get("name") or "model")
                own = copy.copy(inner) if element.tag == "include" else inner
                if element.tag == "include" and element.find("pose") is not None:
                    for old in own.findall("pose"):
                        own.remove(old)
                    own.insert(0, copy.deepcopy(element.find("pose")))
                self.elements[name] = own
                self._scopes[name] = scope
                self._collect(own, f"{name}::", own_file, depth + 1)

    def _full_name(self, name: str, scope: str) -> str:
        """Returns the full name of what an element in ``scope`` calls ``name``."""
        return scope + name if scope + name in self.elements or name == "world" else name

    def _place(self, name: str, seen: tuple[str, ...] = ()) -> np.ndarray:
        """Returns the pose [7] of a link, joint, frame or model in the frame of the whole model."""
        if name in self._places:
            return self._places[name]
        if name in seen or name not in self.elements:
            raise ValueError(f"pose relative to {name!r}, which does not exist or is relative to itself")
        element = self.elements[name]
        scope = self._scopes[name]
        pose = element.find("pose")
        above = (pose.get("relative_to") or pose.get("frame") or "") if pose is not None else ""
        if not above and element.tag == "joint":
            above = (element.findtext("child") or "").strip()
        if not above and element.tag == "frame":
            above = element.get("attached_to") or ""
        local = _read_pose(pose)
        if above and above not in ("__model__", "world"):
            base = self._place(self._full_name(above, scope), (*seen, name))
        elif scope:
            base = self._place(scope.removesuffix("::"), (*seen, name))
        else:
            base = frames.pose([0.0, 0.0, 0.0])
        self._places[name] = frames.compose(base, local)
        return self._places[name]

    def _link_of(self, name: str, scope: str) -> str:
        """Returns the full name of the link that a joint names directly, or by a frame or model."""
        name = self._full_name(name.strip(), scope)
        for _ in range(MAX_DEPTH):
            element = self.elements.get(name)
            if element is None or element.tag == "link":
                return name
            if element.tag == "frame":
                name = self._full_name(element.get("attached_to") or "", self._scopes[name])
            else:
                first = next((link for link in self.links if link.startswith(f"{name}::")), "")
                name = self._full_name(element.get("canonical_link") or "", f"{name}::") if first == "" else first
        return name

    # ------------------------------------------------------------------ links and joints

    def _join(self, name: str, parts: dict[str, Part]) -> list[str]:
        """Put a joint into the part of its child. Returns the child in a list if its parent is the world."""
        joint = self.elements[name]
        scope = self._scopes[name]
        kind = joint.get("type", "fixed")
        child = self._link_of(joint.findtext("child") or "", scope)
        parent = (joint.findtext("parent") or "").strip()
        if parent == "world" and kind == "fixed":
            return [child]
        parent = self._link_of(parent, scope)
        if kind == "gearbox" or child not in parts or parent not in parts:
            if kind != "gearbox" and parent != "world":
                raise ValueError(f"joint {name!r} connects {parent!r} and {child!r}, which are no links")
            return []
        part = parts[child]
        if part.parent is not None:
            self.notes.append(f"joint {name!r} closes a loop of the mechanism, and is left out")
            return []
        part.parent = parent
        part.joint = name
        part.kind = KINDS.get(kind, "fixed")
        if kind not in KINDS:
            self.notes.append(f"joint {name!r} of the type {kind!r} is fixed")
        place = self._place(name)
        if part.kind == "fixed":
            return []
        part.anchor = place[:3]
        axis = joint.find("axis")
        xyz = axis.find("xyz") if axis is not None else None
        direction = _numbers(xyz.text if xyz is not None else None, 3, "0 0 1")
        expressed_in = xyz.get("expressed_in") if xyz is not None else None
        if expressed_in and expressed_in != "__model__":
            place = self._place(self._full_name(expressed_in, scope))
        elif expressed_in or self.is_old or (axis is not None and _is_true(axis.findtext("use_parent_model_frame"))):
            place = self._place(scope.removesuffix("::")) if scope else frames.pose([0.0, 0.0, 0.0])
        part.axis = frames.rotate(place[3:], direction)
        part.limit = self._limits(part, axis.find("limit") if axis is not None else None)
        return []

    def _limits(self, part: Part, limit: etree._Element | None) -> dict[str, float]:
        """Returns the limits of a joint as in a URDF, and makes a revolute joint without a range continuous."""

        def read(key: str, default: float) -> float:
            text = limit.findtext(key) if limit is not None else None
            return default if text is None else float(text)

        found = {key: read(key, -1.0) for key in ("effort", "velocity")}
        found = {key: value for key, value in found.items() if 0.0 < value < UNLIMITED}
        low, high = read("lower", -math.inf), read("upper", math.inf)
        has_range = low > -UNLIMITED or high < UNLIMITED
        if part.kind == "revolute" and not has_range:
            part.kind = "continuous"
        elif part.kind == "prismatic" and not has_range:
            low, high = -DEFAULT_SLIDE, DEFAULT_SLIDE
        if part.kind != "continuous":
            found |= {"lower": max(low, -UNLIMITED), "upper": min(high, UNLIMITED)}
        return found

    def _tree_root(self, parts: dict[str, Part], bolted: list[str]) -> str:
        """Returns the root link: the one that is bolted down, else that of the first link."""
        name = bolted[0] if bolted else self.links[0]
        passed = {name}
        while (above := parts[name].parent) is not None:
            if above in passed:
                parts[name].parent = None  # a loop of joints: opened here
                break
            passed.add(above)
            name = above
        return name

    # ------------------------------------------------------------------ shapes and sensors

    def _fill(self, part: Part) -> None:
        """Read mass and shapes of a link."""
        link = self.elements[part.name]
        inertial = link.find("inertial")
        if inertial is not None:
            part.mass = float(inertial.findtext("mass") or 1.0)
            part.centre = frames.compose(part.pose, _read_pose(inertial.find("pose")))
            given = inertial.find("inertia")
            keys = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
            default = {key: float(key[1] == key[2]) for row in keys for key in row}
            part.inertia = np.array(
                [
                    [float((given.findtext(key) if given is not None else None) or default[key]) for key in row]
                    for row in keys
                ]
            )
        for element in (*link.findall("visual"), *link.findall("collision")):
            part.solids += self._solids(element, part)

    def _solids(self, element: etree._Element, part: Part) -> list[Solid]:
        pose = frames.compose(part.pose, _read_pose(element.find("pose")))
        geometry = element.find("geometry")
        form = next((one for one in geometry if one.tag != "empty"), None) if geometry is not None else None
        if form is None:
            return []
        text = element.findtext("material/diffuse") or element.findtext("material/ambient")
        rgba = None
        if text:
            values = [float(word) for word in text.split()]
            rgba = (*values[:3], values[3] if len(values) > 3 else 1.0)
        common = {"is_visible": element.tag == "visual", "collides": element.tag == "collision", "rgba": rgba}

        def number(key: str) -> float:
            return float(form.findtext(key) or 0.0)

        if form.tag == "box":
            return [Solid("box", tuple(_numbers(form.findtext("size"), 3, "1 1 1")), pose, **common)]
        if form.tag == "sphere":
            return [Solid("sphere", (number("radius"),), pose, **common)]
        if form.tag == "cylinder":
            return [Solid("cylinder", (number("radius"), number("length")), pose, **common)]
        if form.tag == "capsule":
            return capsule(number("radius"), number("length"), pose, **common)
        if form.tag == "ellipsoid":
            stored = store_stl(ellipsoid(_numbers(form.findtext("radii"), 3, "1 1 1")))
            return [Solid("mesh", (1.0, 1.0, 1.0), pose, **common, file=str(stored))]
        if form.tag == "mesh":
            uri = (form.findtext("uri") or "").strip()
            found = find_resource(uri, self.files[part.name])
            scale = tuple(_numbers(form.findtext("scale"), 3, "1 1 1"))
            return [Solid("mesh", scale, pose, **common, file=uri if found is None else found.as_uri())]
        self.notes.append(f"a {form.tag} of link {part.name!r} is left out")
        return []

    def _sensors(self, part: Part) -> Iterator[etree._Element]:
        """Yields the sensors of a link as a URDF has them, with their pose in the frame of the URDF's link."""
        for sensor in self.elements[part.name].findall("sensor"):
            own = copy.deepcopy(sensor)
            pose = frames.compose(part.pose, _read_pose(sensor.find("pose")))
            for old in own.findall("pose"):
                own.remove(old)
            local = frames.compose(frames.inverse(link_frame(part)), pose)
            numbers = (*local[:3], *roll_pitch_yaw(local[3:]))
            etree.SubElement(own, "pose").text = " ".join(f"{number:.9g}" for number in numbers)
            holder = etree.Element("gazebo", reference=part.name)
            holder.append(own)
            yield holder


def _included(include: etree._Element, file: pathlib.Path) -> tuple[etree._Element, pathlib.Path] | None:
    """Returns the model that an ``<include>`` names, and its file; None if it is missing."""
    uri = (include.findtext("uri") or "").strip()
    if uri.endswith((".sdf", ".urdf")):
        found = find_resource(uri, file)
    else:
        config = find_resource(f"{uri}/model.config", file)
        found = None
        if config is not None:
            names = [one.text or "" for one in parse_xml(config.read_bytes(), config).iterfind("sdf")]
            found = next((config.parent / name for name in reversed(names) if (config.parent / name).is_file()), None)
    if found is None:
        return None
    model = parse_xml(found.read_bytes(), found).find("model")
    return None if model is None else (model, found)


def _is_below(name: str, root: str, parts: dict[str, Part]) -> bool:
    """Returns whether a link is the ``root`` or is carried by it."""
    passed = set()
    while name != root:
        above = parts[name].parent
        if above is None or name in passed:
            return False
        passed.add(name)
        name = above
    return True


def _is_true(text: str | None) -> bool:
    return (text or "").strip().lower() in ("1", "true")


def _numbers(text: str | None, count: int, default: str) -> np.ndarray:
    values = np.array([float(word) for word in (text or default).split()])
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{text!r} is not {count} numbers")
    return values


def _read_pose(element: etree._Element | None) -> np.ndarray:
    """Returns the pose [7] of a ``<pose>`` element."""
    if element is None or not (element.text or "").strip():
        return frames.pose([0.0, 0.0, 0.0])
    if element.get("rotation_format") == "quat_xyzw":
        values = _numbers(element.text, 7, "")
        return frames.pose(values[:3], frames.normalize(values[3:]))
    values = _numbers(element.text, 6, "")
    angles = np.radians(values[3:]) if _is_true(element.get("degrees")) else values[3:]
    turn = frames.exp(np.array([0.0, 0.0, angles[2]]))
    for axis, angle in ((1, angles[1]), (0, angles[0])):
        turn = frames.multiply(turn, frames.exp(angle * np.eye(3)[axis]))
    return frames.pose(values[:3], turn)
