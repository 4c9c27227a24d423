"""Canes, a bunch, a gripper and a bar, for the physics and for its MuJoCo reference."""

from __future__ import annotations

import numpy as np

from vinesim.core import frames
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble, segment_bunches
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.plant_parameters import load_plant
from vinesim.scene.values import Drive, RobotSpec

DOWN = frames.from_x_axis(np.array([0.0, 0.0, -1.0]))


def cane(
    at,
    *,
    bunch: float = 0.0,
    radius: float = 0.006,
    beta: float = 0.01,
    heading: float = 0.0,
    pieces: int = 16,
    clusters: bool = False,
) -> TreeBuilder:
    """A cane of 1 m in pieces (16 if it has a bunch), level when drawn.

    ``bunch`` [kg] hangs from its tip on a peduncle of 8 cm, as one body or with ``clusters`` that move near an actor.
    """
    tree = TreeBuilder(frames.pose(np.array(at, float), frames.from_yaw(heading)))
    wood = RodMaterial(
        5e9, 800.0, beta, shear_modulus=2.5e9
    )  # G = E/2 makes torsion as stiff as bending, as MuJoCo's ball wants
    last = tree.add_rod(-1, 1.0, (radius, radius), wood, pieces)[-1]
    if bunch:
        mass = 800.0 * np.pi * 0.002**2 * 0.04
        stiffness = 1e9 * np.pi * 0.002**4 / 4 / 0.04
        across = mass * (0.04**2 / 12 + 0.002**2 / 4)
        for i in range(2):
            last = tree.add_body(
                last,
                offset=(0.0625 if i == 0 else 0.04, 0, 0),
                rest=DOWN if i == 0 else frames.IDENTITY,
                organ=int(Organ.PEDUNCLE),
                mass=mass,
                com=(0.02, 0, 0),
                length=0.04,
                radius=(0.002, 0.002),
                inertia=(0.5 * mass * 0.002**2, across, across),
                stiffness=np.full(3, stiffness),
                damping=np.full(3, 0.01 * stiffness + 1e-3),
            )
        _hang_bunch(tree, last, bunch, stiffness, clusters)
    tree.solve_rest_pose()
    return tree


def _hang_bunch(tree: TreeBuilder, parent: int, mass: float, stiffness: float, clusters: bool) -> None:
    """A bunch of 17 cm on a joint of ``stiffness`` [N m/rad]: one body, or a head and five clusters.

    The clusters' springs are isotropic, as MuJoCo's ball joint wants them.
    """
    fields: dict = {"mass": mass, "com": (0.085, 0, 0), "inertia": mass * np.array([0.00064, 0.00174, 0.00174])}
    bunch: dict = {"length": 0.17, "radius": 0.045, "berries": 80}
    if clusters:
        vine = load_plant("vine")
        one = segment_bunches(
            np.array([mass]),
            np.array([0.17]),
            np.array([0.045]),
            np.array([80]),
            np.array([0]),
            np.array([0]),
            vine.rachis,
            vine.bunch.stem_share.value,
        )
        whole, com, inertia = (value[0] for value in one.compound())
        fields = {"mass": whole, "com": com, "inertia": inertia}
        bunch |= {
            "clusters": int(one.count[0]) - 1,
            "head_mass": one.mass[0, 0],
            "head_com": one.com[0, 0],
            "head_inertia": one.inertia[0, 0],
        }
    body = tree.add_body(
        parent,
        offset=(0.04, 0, 0),
        organ=int(Organ.BUNCH),
        length=0.17,
        radius=(0.04, 0.04),
        stiffness=np.full(3, stiffness),
        damping=np.full(3, 0.01 * stiffness + 2e-3),
        **fields,
    )
    tree.bunches.append({"body": body} | bunch)
    for i in range(1, bunch.get("clusters", 0) + 1):
        bends = float(one.stiffness[0, i, 1])
        tree.clusters.append(
            {
                "parent": None if i > 1 else body,
                "offset": np.array([one.length[0], 0.0, 0.0]),
                "rest": frames.IDENTITY,
                "organ": int(Organ.BUNCH),
                "mass": one.mass[0, i],
                "com": one.com[0, i],
                "inertia": one.inertia[0, i],
                "length": one.length[0],
                "radius": one.radius[0, i],
                "stiffness": np.full(3, bends),
                "damping": np.full(3, vine.rachis.damping.value * bends),
            }
        )


def _inertial(mass: float) -> str:
    i = 0.004 * mass
    return (
        f'<inertial><mass value="{mass}"/><inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def _slide(name: str, parent: str, child: str, axis: str, origin: str = "0 0 0") -> str:
    return (
        f'<joint name="{name}" type="prismatic"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{origin}"/>'
        f'<axis xyz="{axis}"/><limit lower="-2" upper="2" effort="1000" velocity="5"/></joint>'
    )


GRIPPER = f"""<robot name="gripper"><link name="base_footprint">{_inertial(50)}</link>
<link name="carriage">{_inertial(1)}</link><link name="hand">{_inertial(4)}</link>
{_slide("shift", "base_footprint", "carriage", "0 1 0")}{_slide("lift", "carriage", "hand", "0 0 1")}
<link name="left">{_inertial(0.1)}<collision><geometry><box size="0.04 0.02 0.07"/></geometry></collision></link>
<link name="right">{_inertial(0.1)}<collision><geometry><box size="0.04 0.02 0.07"/></geometry></collision></link>
{_slide("close_left", "hand", "left", "0 -1 0", "0 0.085 0")}
{_slide("close_right", "hand", "right", "0 1 0", "0 -0.085 0")}
</robot>"""


def gripper(bunch: np.ndarray, name: str = "grip", effort: float = 40.0, mimic: bool = False) -> RobotSpec:
    """Two box fingers, open about the point ``bunch`` [3]; drives: shift (y), lift (z), both fingers.

    ``mimic``: the right finger is not driven, it copies the left one.
    """
    drives = (
        Drive("shift", 5000.0, 300.0, 1000.0, 5.0, -1.0, 1.0),
        Drive("lift", 5000.0, 300.0, 1000.0, 5.0, -1.0, 1.0),
        Drive("close_left", 4000.0, 80.0, effort, 5.0, -1.0, 1.0),
        Drive("close_right", 4000.0, 80.0, effort, 5.0, -1.0, 1.0),
    )
    urdf = GRIPPER
    if mimic:
        drives = drives[:3]
        urdf = urdf.replace('<child link="right"/>', '<child link="right"/><mimic joint="close_left"/>')
    return RobotSpec(name, 0, urdf, "base_footprint", frames.pose(bunch), drives, np.zeros(len(drives)))


BAR = f"""<robot name="bar"><link name="base_footprint">{_inertial(50)}</link>
<link name="bar">{_inertial(3)}
<collision><geometry><cylinder radius="0.03" length="0.6"/></geometry></collision></link>
{_slide("sweep", "base_footprint", "bar", "0 1 0")}</robot>"""


def bar(at, name: str = "bar", stiffness: float = 0.0, damping: float = 0.0) -> RobotSpec:
    """An upright bar of 3 kg that slides along y; without gains it coasts."""
    drives = (Drive("sweep", stiffness, damping, 1000.0, 5.0, -5.0, 5.0),)
    return RobotSpec(name, 1, BAR, "base_footprint", frames.pose(np.array(at, float)), drives, np.zeros(1))


def probe(at, name: str = "probe", mass: float = 3.0, drives: tuple[Drive, ...] | None = None) -> RobotSpec:
    """A level rod of 20 cm along y that moves along x (drive ``along``) and up and down (``press``).

    By default ``along`` is held and ``press`` coasts.
    """
    urdf = f"""<robot name="probe"><link name="base_footprint">{_inertial(500)}</link>
<link name="carriage">{_inertial(1)}</link><link name="rod">{_inertial(mass)}
<collision><origin rpy="1.5707963267948966 0 0"/><geometry><cylinder radius="0.02" length="0.2"/></geometry></collision>
</link>
{_slide("along", "base_footprint", "carriage", "1 0 0")}{_slide("press", "carriage", "rod", "0 0 1")}</robot>"""
    if drives is None:
        drives = (
            Drive("along", 5000.0, 300.0, 1000.0, 5.0, -5.0, 5.0),
            Drive("press", 0.0, 2.0, 1000.0, 5.0, -5.0, 5.0),
        )
    return RobotSpec(name, 2, urdf, "base_footprint", frames.pose(np.array(at, float)), drives, np.zeros(2))


def bunch_scene(mass: float = 0.5, *, clusters: bool = False) -> tuple[Model, int, np.ndarray]:
    """A model with one hanging bunch, the body that a hand holds, and the world position of the bunch's centre.

    That body is the bunch, or with ``clusters`` the cluster that begins at its centre, see :func:`held_point`.
    """
    model = assemble([cane((0.0, 0.0, 2.0), bunch=mass, clusters=clusters)])
    body = int(model.bunch_cluster[0]) + 2 if clusters else int(model.bunch_body[0])
    return model, body, held_point(model, model.forward_kinematics(model.joint_settled)[body], body)


def held_point(model: Model, pose: np.ndarray, body: int) -> np.ndarray:
    """The point [3] m of a bunch that a hand holds: the middle of it, or where the cluster ``body`` begins."""
    arm = 0.085 if body == model.bunch_body[0] else 0.0
    return pose[:3] + frames.rotate(pose[3:].astype(float), np.array([arm, 0.0, 0.0]))


def grasp(t: float) -> tuple[np.ndarray, float]:
    """Commands of a grasp at time t [s]: set-points of the gripper's drives, and an extra force on the hand [N].

    Close, lift 10 cm, move 20 cm sideways, be pulled down, release.
    """

    def ramp(a: float, b: float) -> float:
        return float(np.clip((t - a) / (b - a), 0.0, 1.0))

    def smooth(u: float) -> float:
        return u * u * (3.0 - 2.0 * u)

    fingers = 0.05 * ramp(0.3, 0.8) if t < 6.5 else 0.05 * (1.0 - ramp(6.5, 6.8))
    pull = -15.0 * ramp(4.5, 4.8) * (t < 6.0)
    return np.array([0.20 * smooth(ramp(3.0, 4.0)), 0.10 * smooth(ramp(1.5, 2.5)), fingers, fingers]), pull
