"""Canes with a bunch of berry clusters, and momenta of plants."""

from __future__ import annotations

import numpy as np

from vinesim.core import frames
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.scene.builder import GRAVITY, RodMaterial, TreeBuilder, assemble, solve_rest_pose
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model

DOWN = frames.from_x_axis(np.array([0.0, 0.0, -1.0]))


def compound(parts: list[tuple[float, np.ndarray, np.ndarray]]) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre and diagonal moments about it of parts (mass, centre, moments), axes alike."""
    mass = sum(m for m, _, _ in parts)
    center = sum(m * c for m, c, _ in parts) / mass
    inertia = sum(i + m * (((c - center) ** 2).sum() - (c - center) ** 2) for m, c, i in parts)
    return mass, center, inertia


def clustered(count: int = 1, clusters: int = 5, *, pose: np.ndarray | None = None, pieces: int = 8) -> Model:
    """Horizontal canes of 1 m (side by side), each with a bunch of 0.5 kg on a peduncle half way; drawn at rest."""
    trees = []
    bunches = []
    for i in range(count):
        tree = TreeBuilder(frames.pose(np.array([0.0, 0.5 * i, 2.0])) if pose is None else pose)
        cane = tree.add_rod(-1, 1.0, (0.005, 0.004), RodMaterial(5e9, 800.0, 0.01), pieces)
        stalk = tree.add_rod(cane[pieces // 2], 0.06, (0.002, 0.002), RodMaterial(1e9, 900.0, 0.02), 2, rest=DOWN)
        head = {"mass": 0.05, "com": np.array([0.03, 0.0, 0.0]), "inertia": np.array([1e-5, 4e-5, 4e-5])}
        bunch = tree.add_body(
            stalk[-1],
            offset=(0.03, 0, 0),
            organ=int(Organ.BUNCH),
            length=0.15,
            radius=(0.05, 0.05),
            stiffness=(0.3, 0.3, 0.3),
            damping=(0.004, 0.004, 0.004),
            **head,
        )
        cluster_mass = 0.45 / clusters
        parent = bunch
        for j in range(clusters):
            side = frames.exp(np.array([1.3 * j, 0.0, 0.0]))
            out = frames.multiply(side, frames.exp(np.array([0.0, 0.0, 0.7])))
            parent = bunch if j % 2 == 0 else parent
            parent = tree.add_body(
                parent, offset=(0.02 + 0.02 * (j % 3), 0, 0), rest=out, organ=int(Organ.BUNCH), mass=cluster_mass,
                com=(0.03, 0, 0), inertia=cluster_mass * np.array([3e-4, 5e-4, 5e-4]), length=0.05, radius=(0.02, 0.02),
                stiffness=(0.1, 0.1, 0.1), damping=(1e-3, 1e-3, 1e-3),
            )  # fmt: skip
        trees.append(tree)
        bunches.append((bunch, head, len(tree.bodies) - clusters))
        tree.bunches.append({"body": bunch, "length": 0.15, "radius": 0.05, "berries": 100})
    model = solve_rest_pose(assemble(trees))
    for i, (bunch, head, core) in enumerate(bunches):
        first = int(model.tree_first[i])
        model.tree_core[i], model.bunch_cluster[i], model.bunch_clusters[i] = core, first + core, clusters
        model.bunch_head_mass[i] = head["mass"]
        model.bunch_head_com[i] = head["com"]
        model.bunch_head_inertia[i] = head["inertia"]
        world = model.forward_kinematics(model.joint_settled)
        back = frames.inverse(world[first + bunch])
        parts = [(head["mass"], head["com"], head["inertia"])]
        for body in range(first + core, first + core + clusters):
            at = frames.compose(back, world[body])
            axes = frames.to_matrix(at[3:])
            spread = np.diag(axes @ np.diag(model.body_inertia[body]) @ axes.T)
            parts.append((float(model.body_mass[body]), at[:3] + axes @ model.body_com[body], spread))
        body = first + bunch
        model.body_mass[body], model.body_com[body], model.body_inertia[body] = compound(parts)
    return model


def moving(plants: ArticulationSolver, trees: np.ndarray) -> np.ndarray:
    """The bodies that the kernels visit."""
    fine = plants.state.tree_fine[trees]
    size = np.where(fine, plants.model.tree_size[trees], plants.model.tree_core[trees])
    return np.concatenate([np.arange(f, f + n) for f, n in zip(plants.model.tree_first[trees], size, strict=True)])


def momenta(
    plants: ArticulationSolver, bodies: np.ndarray, about: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Linear momentum, angular momentum about a point, centre of mass and kinetic energy of bodies."""
    pose = plants.state.body_q[bodies].astype(float)
    speed = plants.state.body_qd[bodies].astype(float)
    mass = plants.body_mass[bodies].astype(float)
    com = frames.rotate(pose[:, 3:], plants.body_com[bodies].astype(float))
    omega = frames.rotate(frames.conjugate(pose[:, 3:]), speed[:, 3:])
    x, y, z = plants.body_product[bodies].astype(float).T
    zero = np.zeros_like(x)
    tensor = np.stack([np.stack(row, -1) for row in ([zero, z, y], [z, zero, x], [y, x, zero])], 1)
    spin = plants.body_inertia[bodies] * omega + np.einsum("nij,nj->ni", tensor, omega)
    linear = mass[:, None] * (speed[:, :3] + np.cross(speed[:, 3:], com))
    at = pose[:, :3] + com
    angular = np.cross(at - about, linear) + frames.rotate(pose[:, 3:], spin)
    kinetic = 0.5 * ((linear**2).sum(1) / mass).sum() + 0.5 * (omega * spin).sum()
    return linear.sum(0), angular.sum(0), mass @ at / mass.sum(), float(kinetic)


def fall(time: float) -> np.ndarray:
    """Displacement [3] m of free fall after a time [s]."""
    return 0.5 * GRAVITY * time * time
