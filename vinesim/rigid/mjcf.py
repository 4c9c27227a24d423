"""Converts robots in MuJoCo's format (MJCF) to URDF. MuJoCo compiles the file; the URDF describes the compiled model.

A body with several joints becomes a chain of links, a ball joint three hinges, a free joint a floating base. Joint
positions of the URDF are 0 in the pose in which the file draws the robot.
"""

from __future__ import annotations

import math
import pathlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator

import mujoco
import numpy as np

from vinesim.core import frames
from vinesim.rigid.urdf_writer import Part, Solid, capsule, link_frame, roll_pitch_yaw, write_urdf
from vinesim.scene.appearance.mesh_files import store_stl

COLLISION_GROUP = 3
"""Number of the first group of geoms that MuJoCo's viewer hides. By custom these are shapes for contacts only."""
HOME_KEYS = ("home", "stand", "ready", "neutral")
"""Names of keyframes whose pose is the home pose of a robot, the best one first."""
DEFAULT_VELOCITY = {"revolute": math.pi, "continuous": math.pi, "prismatic": 0.5}
"""[rad/s or m/s] Velocity limit of a joint, which MJCF does not have. GUESSED"""
DEFAULT_SLIDE = 1.0
"""[m] Range to either side of a sliding joint without limits. GUESSED"""
DEFAULT_SIZE = (640, 480)
"""[px] Size of the picture of a camera without a resolution."""
BETWEEN_MASS = 1e-3
"""[kg] Mass of a link between two joints of one body. GUESSED"""
BETWEEN_RADIUS = 0.05
"""[m] Radius of gyration of a link between two joints of one body. GUESSED"""
_BALL = 3
"""Number of hinges that stand for a ball joint."""


class MjcfError(ValueError):
    """A file that MuJoCo cannot compile, or that has no robot. The message contains the reason."""


def urdf_of_mjcf(file: pathlib.Path, content: bytes) -> tuple[str, dict[str, float], tuple[str, ...]]:
    """Returns the URDF of the robot in a MJCF ``file`` with ``content`` (a binary model if its name ends with
    ``.mjb``), the home position [rad or m] of each joint, and notes on the conversion.

    Raises :class:`MjcfError` if MuJoCo cannot compile it or there is no robot.
    """
    said: list[str] = []
    mujoco.set_mju_user_warning(said.append)  # otherwise MuJoCo writes a log into the working folder
    try:
        if file.suffix.lower() == ".mjb":
            m = mujoco.MjModel.from_binary_path(str(file))
        elif file.is_file():
            m = mujoco.MjModel.from_xml_path(str(file))
        else:  # a pipe
            m = mujoco.MjModel.from_xml_string(content.decode("utf-8-sig"))
    except (ValueError, UnicodeDecodeError) as error:
        raise MjcfError(f"MuJoCo cannot read it: {' '.join(str(error).split())}") from error
    finally:
        mujoco.set_mju_user_warning(None)
    urdf, home, notes = _Conversion(m, file.stem).result()
    return urdf, home, (*notes, *(f"MuJoCo: {' '.join(text.split())}" for text in said))


class _Conversion:
    """The conversion of one compiled model."""

    def __init__(self, m: mujoco.MjModel, stem: str) -> None:
        self.m = m
        self.d = mujoco.MjData(m)
        mujoco.mj_resetData(m, self.d)
        mujoco.mj_kinematics(m, self.d)
        mujoco.mj_comPos(m, self.d)
        name = m.names[: m.names.find(b"\0")].decode()
        self.name = name if name and name != "MuJoCo Model" else stem
        self.notes: list[str] = []
        self.parts: list[Part] = []
        self.link_of: dict[int, str] = {0: "world"}
        """Name of the link that carries the shapes of each body."""
        self.home: dict[str, float] = {}
        self.mimics = self._mimics()
        self.efforts = self._efforts()
        self.key = self._key()

    def result(self) -> tuple[str, dict[str, float], tuple[str, ...]]:
        """Returns URDF, home positions and notes."""
        bodies, is_free = self._robot_bodies()
        self.parts.append(Part("world", frames.pose([0.0, 0.0, 0.0])))
        for body in bodies:
            self._add_body(body, is_free)
        by_name = {part.name: part for part in self.parts}
        for geom in range(self.m.ngeom):
            link = self.link_of.get(int(self.m.geom_bodyid[geom]))
            if link is not None and link != "world":
                by_name[link].solids.extend(self._solids(geom))
        extras = [*self._excluded_pairs(), *self._sensors(by_name)]
        loops = np.isin(self.m.eq_type, [int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)])
        if loops.any():
            self.notes.append(f"{int(loops.sum())} loops of the mechanism are open: a URDF is a tree")
        return write_urdf(self.name, self.parts, extras), self.home, tuple(self.notes)

    # ------------------------------------------------------------------ links and joints

    def _robot_bodies(self) -> tuple[list[int], bool]:
        """Returns the bodies of the robot, parents first, and whether its root moves freely.

        The robot is what has joints besides free ones. With several such trees, those with actuators count; with a free
        root, only the first of them.
        """
        m = self.m
        free = int(mujoco.mjtJoint.mjJNT_FREE)
        roots = [body for body in range(1, m.nbody) if m.body_parentid[body] == 0 and m.body_mocapid[body] < 0]
        of_root = {root: [b for b in range(1, m.nbody) if m.body_rootid[b] == root] for root in roots}
        joints = {
            root: [j for j in range(m.njnt) if m.body_rootid[m.jnt_bodyid[j]] == root and m.jnt_type[j] != free]
            for root in roots
        }
        moving = [root for root in roots if joints[root]]
        driven = [root for root in moving if any(j in self.efforts for j in joints[root])] or moving
        if not driven:  # a platform without joints, or an object
            driven = sorted(roots, key=lambda root: -float(m.body_subtreemass[root]))[:1]
        if not driven:
            raise MjcfError("it has no bodies")
        is_free = any(m.jnt_type[j] == free for j in range(m.njnt) if m.jnt_bodyid[j] == driven[0])
        chosen = driven[:1] if is_free else driven
        if left := len(roots) - len(chosen):
            self.notes.append(f"{left} other bodies of the scene are left out")
        return sorted(body for root in chosen for body in of_root[root]), is_free

    def _add_body(self, body: int, is_free: bool) -> None:
        """Add the links and joints of a body."""
        m = self.m
        name = m.body(body).name or f"body_{body}"
        pose = frames.pose(self.d.xpos[body], frames.from_wxyz(self.d.xquat[body]))
        parent = self.link_of[int(m.body_parentid[body])]
        first = int(m.body_jntadr[body])
        joints = list(self._axes(range(first, first + int(m.body_jntnum[body]))))
        if not joints:
            floats = is_free and parent == "world"
            self.parts.append(Part(name, pose, parent, f"{name}_joint", "floating" if floats else "fixed"))
        for number, (joint, kind, anchor, axis, limit, mimic) in enumerate(joints):
            is_last = number == len(joints) - 1
            link = name if is_last else f"{joint}_link"
            part = Part(link, pose, parent, joint, kind, anchor, axis, limit, mimic)
            if not is_last:  # a link between two joints of one body, which needs a mass in physics
                part.mass = BETWEEN_MASS
                part.centre = frames.pose(anchor)
                part.inertia = np.eye(3) * BETWEEN_MASS * BETWEEN_RADIUS**2
            self.parts.append(part)
            parent = link
        part = self.parts[-1]
        self.link_of[body] = part.name
        part.mass = float(m.body_mass[body])
        turn = frames.from_matrix(self.d.ximat[body].reshape(3, 3))
        part.centre = frames.pose(self.d.xipos[body], turn)
        part.inertia = np.diag(m.body_inertia[body])

    def _axes(
        self, joints: range
    ) -> Iterator[tuple[str, str, np.ndarray, np.ndarray, dict[str, float], tuple[str, float, float] | None]]:
        """Yields name, type, anchor, axis, limits and mimic of each axis of a body's joints."""
        m = self.m
        for j in joints:
            kind = int(m.jnt_type[j])
            name = self._joint_name(j)
            anchor = self.d.xanchor[j].copy()
            limit = {"velocity": DEFAULT_VELOCITY["revolute"]}
            if j in self.efforts:
                limit["effort"] = self.efforts[j]
            if kind == int(mujoco.mjtJoint.mjJNT_FREE):
                continue
            if kind == int(mujoco.mjtJoint.mjJNT_BALL):
                body = frames.from_wxyz(self.d.xquat[m.jnt_bodyid[j]])
                reach = float(m.jnt_range[j, 1]) if m.jnt_limited[j] else math.pi
                for k in range(_BALL):
                    axis = frames.rotate(body, np.eye(3)[k])
                    own = f"{name}_{'xyz'[k]}"
                    self.home[own] = 0.0
                    yield own, "revolute", anchor, axis, limit | {"lower": -reach, "upper": reach}, None
                continue
            zero = float(m.qpos0[m.jnt_qposadr[j]])
            low, high = (float(value) - zero for value in m.jnt_range[j])
            is_slide = kind == int(mujoco.mjtJoint.mjJNT_SLIDE)
            if not m.jnt_limited[j]:
                low, high = -DEFAULT_SLIDE, DEFAULT_SLIDE
            urdf_kind = "prismatic" if is_slide else ("revolute" if m.jnt_limited[j] else "continuous")
            if urdf_kind != "continuous":
                limit |= {"lower": low, "upper": high}
            limit["velocity"] = DEFAULT_VELOCITY[urdf_kind]
            home = float(self.key[m.jnt_qposadr[j]]) - zero
            self.home[name] = home if urdf_kind == "continuous" else min(max(home, low), high)
            yield name, urdf_kind, anchor, self.d.xaxis[j].copy(), limit, self.mimics.get(j)

    def _joint_name(self, joint: int) -> str:
        return self.m.joint(joint).name or f"joint_{joint}"

    def _key(self) -> np.ndarray:
        """Returns the joint positions qpos of the home pose."""
        m = self.m
        names = {m.key(k).name: k for k in range(m.nkey)}
        wanted = next((names[name] for name in HOME_KEYS if name in names), 0 if m.nkey else None)
        return m.qpos0 if wanted is None else m.key_qpos[wanted]

    def _mimics(self) -> dict[int, tuple[str, float, float]]:
        """Returns for each joint that follows another one by an equality: that joint's name, multiplier and offset."""
        m = self.m
        found = {}
        for e in np.flatnonzero((m.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)) & (m.eq_active0 != 0)):
            follower, source = int(m.eq_obj1id[e]), int(m.eq_obj2id[e])
            if source >= 0 and np.allclose(m.eq_data[e, 2:5], 0.0) and m.eq_data[e, 1] != 0.0:
                found[follower] = self._joint_name(source), float(m.eq_data[e, 1]), float(m.eq_data[e, 0])
        return found

    def _efforts(self) -> dict[int, float]:
        """Returns the largest effort [N m or N] of each joint that has an actuator; 0 if it is unknown."""
        m = self.m
        found: dict[int, float] = {}
        on_joint = [int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)]
        for a in range(m.nu):
            if int(m.actuator_trntype[a]) not in on_joint:
                continue
            joint = int(m.actuator_trnid[a, 0])
            gear = float(np.abs(m.actuator_gear[a]).max())
            effort = 0.0
            if m.actuator_forcelimited[a]:
                effort = gear * float(np.abs(m.actuator_forcerange[a]).max())
            elif m.actuator_ctrllimited[a] and not m.actuator_biasprm[a, 1]:
                effort = gear * float(np.abs(m.actuator_gainprm[a, 0] * m.actuator_ctrlrange[a]).max())
            if m.jnt_actfrclimited[joint]:
                limit = float(np.abs(m.jnt_actfrcrange[joint]).max())
                effort = min(effort, limit) if effort else limit
            found[joint] = max(found.get(joint, 0.0), effort)
        return found

    # ------------------------------------------------------------------ shapes

    def _solids(self, geom: int) -> list[Solid]:
        """Returns the shapes of a geom."""
        m = self.m
        kinds = mujoco.mjtGeom
        kind = int(m.geom_type[geom])
        pose = frames.pose(self.d.geom_xpos[geom], frames.from_matrix(self.d.geom_xmat[geom].reshape(3, 3)))
        collides = bool(m.geom_contype[geom] or m.geom_conaffinity[geom])
        rgba, material = self._color(geom)
        common = {
            "is_visible": int(m.geom_group[geom]) < COLLISION_GROUP and rgba[3] > 0.0,
            "collides": collides,
            "rgba": rgba,
            "material": material,
        }
        size = m.geom_size[geom]
        if kind == int(kinds.mjGEOM_BOX):
            return [Solid("box", tuple(2.0 * size), pose, **common)]
        if kind == int(kinds.mjGEOM_SPHERE):
            return [Solid("sphere", (float(size[0]),), pose, **common)]
        if kind == int(kinds.mjGEOM_CYLINDER):
            return [Solid("cylinder", (float(size[0]), 2.0 * float(size[1])), pose, **common)]
        if kind == int(kinds.mjGEOM_CAPSULE):
            return capsule(float(size[0]), 2.0 * float(size[1]), pose, **common)
        if kind == int(kinds.mjGEOM_ELLIPSOID):
            corners = ellipsoid(size)
        elif kind == int(kinds.mjGEOM_MESH):
            mesh = int(m.geom_dataid[geom])
            vertices = m.mesh_vert[m.mesh_vertadr[mesh] :][: m.mesh_vertnum[mesh]]
            corners = vertices[m.mesh_face[m.mesh_faceadr[mesh] :][: m.mesh_facenum[mesh]]]
        else:  # planes and height fields belong to the scene
            return []
        if not len(corners):
            return []
        return [Solid("mesh", (1.0, 1.0, 1.0), pose, **common, file=str(store_stl(corners)))]

    def _color(self, geom: int) -> tuple[tuple[float, ...], str]:
        """Returns colour and material name of a geom; of a texture, the mean colour."""
        m = self.m
        material = int(m.geom_matid[geom])
        if material < 0:
            return tuple(float(value) for value in m.geom_rgba[geom]), ""
        rgba = m.mat_rgba[material].astype(float)
        textures = [int(texture) for texture in m.mat_texid[material] if texture >= 0]
        if textures:
            channels = int(m.tex_nchannel[textures[0]])
            count = int(m.tex_width[textures[0]]) * int(m.tex_height[textures[0]])
            start = int(m.tex_adr[textures[0]])
            data = m.tex_data[start : start + count * channels].reshape(-1, channels)
            if channels >= 3:
                rgba[:3] *= data[:, :3].mean(axis=0) / 255.0
        return tuple(rgba.tolist()), m.mat(material).name

    # ------------------------------------------------------------------ pairs and sensors

    def _excluded_pairs(self) -> Iterator[ElementTree.Element]:
        """Yields elements for the pairs of bodies that never collide."""
        for signature in self.m.exclude_signature:
            pair = [self.link_of.get(int(body)) for body in (int(signature) >> 16, int(signature) & 0xFFFF)]
            if None not in pair:
                yield ElementTree.Element("disable_collisions", link1=str(pair[0]), link2=str(pair[1]))

    def _sensors(self, parts: dict[str, Part]) -> Iterator[ElementTree.Element]:
        """Yields the cameras and inertial sensors of the robot, as Gazebo describes them in a URDF."""
        m = self.m
        for c in range(m.ncam):
            link = self.link_of.get(int(m.cam_bodyid[c]))
            if link is None or link == "world" or int(m.cam_mode[c]) != int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED):
                continue
            turn = self.d.cam_xmat[c].reshape(3, 3) @ np.array([[0, -1, 0], [0, 0, 1], [-1, 0, 0]], float)
            pose = frames.pose(self.d.cam_xpos[c], frames.from_matrix(turn))
            width, height = (int(n) for n in m.cam_resolution[c])
            if min(width, height) < 16:
                width, height = DEFAULT_SIZE
            field = 2.0 * math.atan(math.tan(math.radians(float(m.cam_fovy[c])) / 2.0) * width / height)
            sensor, holder = _sensor(link, m.cam(c).name or f"camera_{c}", "rgbd_camera", pose, parts)
            camera = ElementTree.SubElement(sensor, "camera")
            ElementTree.SubElement(camera, "horizontal_fov").text = f"{field:.6g}"
            image = ElementTree.SubElement(camera, "image")
            ElementTree.SubElement(image, "width").text = str(width)
            ElementTree.SubElement(image, "height").text = str(height)
            yield holder
        inertial = [int(mujoco.mjtSensor.mjSENS_ACCELEROMETER), int(mujoco.mjtSensor.mjSENS_GYRO)]
        for site in dict.fromkeys(int(s) for s in m.sensor_objid[np.isin(m.sensor_type, inertial)]):
            link = self.link_of.get(int(m.site_bodyid[site]))
            if link is not None and link != "world":
                turn = frames.from_matrix(self.d.site_xmat[site].reshape(3, 3))
                pose = frames.pose(self.d.site_xpos[site], turn)
                yield _sensor(link, m.site(site).name or f"imu_{site}", "imu", pose, parts)[1]


def ellipsoid(half: np.ndarray) -> np.ndarray:
    """Returns the triangles [face, 3, 3] m of an ellipsoid with the ``half`` axes [3] m."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=3)
    return (np.asarray(ball.vertices) * half)[np.asarray(ball.faces)].astype(np.float32)


def _sensor(
    link: str, name: str, kind: str, pose: np.ndarray, parts: dict[str, Part]
) -> tuple[ElementTree.Element, ElementTree.Element]:
    """Returns a sensor element and the element of its link. ``pose`` [7]: pose of the sensor in the common frame."""
    local = frames.compose(frames.inverse(link_frame(parts[link])), pose)
    holder = ElementTree.Element("gazebo", reference=link)
    sensor = ElementTree.SubElement(holder, "sensor", name=name, type=kind)
    numbers = (*local[:3], *roll_pitch_yaw(local[3:]))
    ElementTree.SubElement(sensor, "pose").text = " ".join(f"{number:.9g}" for number in numbers)
    return sensor, holder
