"""Scenes of the physics benches: rows of canes with bunches, grippers that hold some bunches, a bar that lifts some
canes.

A cane is a metre of wood, 12 mm thick (5 GPa, 800 kg/m^3) in 16 bodies, level at rest. A bunch of 0.5 kg hangs from its
tip on a peduncle of 8 cm in two bodies.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from vinesim.core import frames
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.values import Drive, RobotSpec
from vinesim.world import Physics

SPACING = 0.15
"""[m] Distance between canes."""
HEIGHT = 2.0
"""[m] Height of the canes above ground."""
BUNCH_CENTER = 0.085
"""Distance from the upper end of a bunch's stalk to its middle [m]."""


def cane_with_bunch(side: float) -> TreeBuilder:
    """Returns a level cane along x, at y = ``side`` [m], with a bunch hanging from its tip."""
    tree = TreeBuilder(frames.pose(np.array([0.0, side, HEIGHT])))
    last = tree.add_rod(-1, 1.0, (0.006, 0.006), RodMaterial(5e9, 800.0, 0.01, shear_modulus=2.5e9), 16)[-1]
    down = frames.from_x_axis(np.array([0.0, 0.0, -1.0]))
    stalk = RodMaterial(1e9, 800.0, 0.02, shear_modulus=0.5e9)
    last = tree.add_rod(last, 0.08, (0.002, 0.002), stalk, 2, organ=Organ.PEDUNCLE, rest=down)[-1]
    spring = np.asarray(tree.bodies[last]["stiffness"])
    bunch = tree.add_body(
        last,
        offset=(0.04, 0, 0),
        organ=int(Organ.BUNCH),
        mass=0.5,
        com=(BUNCH_CENTER, 0, 0),
        length=0.17,
        radius=(0.04, 0.04),
        inertia=(3.2e-4, 8.7e-4, 8.7e-4),
        stiffness=spring,
        damping=0.01 * spring + 2e-3,
    )
    tree.bunches.append({"body": bunch, "length": 0.17, "radius": 0.045, "berries": 80, "pull": 500.0, "bend": 50.0})
    tree.solve_rest_pose()
    return tree


def cane_row(count: int) -> Model:
    """Returns a model of ``count`` canes side by side, the first at y = 0. All are copies of one cane, so ten thousand
    are built in seconds."""
    one = cane_with_bunch(0.0)
    trees = []
    for i in range(count):
        tree = TreeBuilder(frames.pose(np.array([0.0, SPACING * i, HEIGHT])))
        tree.bodies = one.bodies
        tree.bunches = one.bunches
        trees.append(tree)
    return assemble(trees)


def bunch_center(cane: int) -> np.ndarray:
    """Returns the centre [3] m of the bunch of one cane at rest."""
    return np.array([1.0, SPACING * cane, HEIGHT - 0.08 - BUNCH_CENTER])


def _inertial(mass: float) -> str:
    i = 0.004 * mass
    return (
        f'<inertial><mass value="{mass}"/><inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def _slide(name: str, parent: str, child: str, axis: str, origin: str = "0 0 0") -> str:
    return (
        f'<joint name="{name}" type="prismatic"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{origin}"/><axis xyz="{axis}"/><limit lower="-2" upper="2" effort="1000" velocity="5"/></joint>'
    )


def gripper(name: str, at: np.ndarray) -> RobotSpec:
    """Returns a gripper with two flat fingers, 17 cm apart around the point ``at`` [3] m.

    Drives [m]: lift, and one for each finger (0.05 is a firm grasp).
    """
    finger = "<collision><geometry><box size='0.02 0.04 0.07'/></geometry></collision>"
    urdf = (
        f'<robot name="hand"><link name="base_footprint">{_inertial(50.0)}</link>'
        f'<link name="palm">{_inertial(4.0)}</link>'
        f'<link name="left">{_inertial(0.1)}{finger}</link><link name="right">{_inertial(0.1)}{finger}</link>'
        f"{_slide('lift', 'base_footprint', 'palm', '0 0 1')}"
        f"{_slide('close_left', 'palm', 'left', '-1 0 0', '0.085 0 0')}"
        f"{_slide('close_right', 'palm', 'right', '1 0 0', '-0.085 0 0')}</robot>"
    )
    drives = (
        Drive("lift", 5000.0, 300.0, 1000.0, 5.0, -1.0, 1.0),
        Drive("close_left", 4000.0, 80.0, 40.0, 5.0, -1.0, 1.0),
        Drive("close_right", 4000.0, 80.0, 40.0, 5.0, -1.0, 1.0),
    )
    return RobotSpec(name, 0, urdf, "base_footprint", frames.pose(at), drives, np.zeros(3))


def bar(name: str, first: int, count: int) -> RobotSpec:
    """Returns a bar across ``count`` canes from the cane ``first`` on, 3 cm below them and 0.6 m from their clamps. Its
    drive lifts the bar [m]."""
    length = SPACING * count
    urdf = (
        f'<robot name="bar"><link name="base_footprint">{_inertial(50.0)}</link><link name="bar">{_inertial(6.0)}'
        f'<collision><origin rpy="1.5707963 0 0"/><geometry><cylinder radius="0.02" length="{length}"/></geometry>'
        f"</collision></link>{_slide('lift', 'base_footprint', 'bar', '0 0 1')}</robot>"
    )
    drives = (Drive("lift", 2e4, 2000.0, 1000.0, 5.0, -1.0, 1.0),)
    middle = np.array([0.6, SPACING * (first + 0.5 * (count - 1)), HEIGHT - 0.006 - 0.02 - 0.03])
    return RobotSpec(name, 1, urdf, "base_footprint", frames.pose(middle), drives, np.zeros(1))


def combs(name: str, bars: int, canes: int) -> RobotSpec:
    """Returns a robot of two combs: bars across the first ``canes``, 0.3 to 0.9 m from their clamps, in turns 2 mm
    below and 2 mm above the canes.

    Drives [m]: lift of the lower bars, and lowering of the upper bars; from 2 mm on each cane touches every bar.
    """
    cylinder = f'<geometry><cylinder radius="0.02" length="{SPACING * canes}"/></geometry>'
    height = 0.006 + 0.02 + 0.002
    collisions = [
        f'<collision><origin xyz="{x:.4f} 0 {z:.4f}" rpy="1.5707963 0 0"/>{cylinder}</collision>'
        for x, z in zip(np.linspace(-0.3, 0.3, bars), np.resize([-height, height], bars), strict=True)
    ]
    urdf = (
        f'<robot name="combs"><link name="base_footprint">{_inertial(50.0)}</link>'
        f'<link name="lower">{_inertial(20.0)}{"".join(collisions[::2])}</link>'
        f'<link name="upper">{_inertial(20.0)}{"".join(collisions[1::2])}</link>'
        f"{_slide('lift', 'base_footprint', 'lower', '0 0 1')}{_slide('sink', 'base_footprint', 'upper', '0 0 -1')}"
        "</robot>"
    )
    drives = tuple(Drive(joint, 2e5, 2e4, 1e4, 5.0, -1.0, 1.0) for joint in ("lift", "sink"))
    middle = np.array([0.6, 0.5 * SPACING * (canes - 1), HEIGHT])
    return RobotSpec(name, 1, urdf, "base_footprint", frames.pose(middle), drives, np.zeros(2))


def keep_awake(physics: Physics, trees: np.ndarray) -> Physics:
    """Wake some trees [k] and let no tree fall asleep again; return the physics."""
    physics.sleep_monitor.rate = -1.0
    physics.plants.wake(trees)
    return physics


def interleaved_medians(*works: Callable[[], object], rounds: int = 9) -> list[float]:
    """Returns the median wall time [s] of each function in ``works``.

    The functions run in turns, so that changes of the machine's load affect all of them equally.
    """
    return interleaved_times(*works, rounds=rounds)[0].tolist()


def interleaved_times(*works: Callable[[], object], rounds: int = 9) -> np.ndarray:
    """Returns medians [2, work] s of each function in ``works``, which run in turns: wall time and this thread's
    processor time."""
    seconds = np.zeros((rounds, 2, len(works)))
    for row in seconds:
        for i, work in enumerate(works):
            start = time.perf_counter()
            began = time.thread_time()
            work()
            row[:, i] = time.perf_counter() - start, time.thread_time() - began
    return np.median(seconds, axis=0)
