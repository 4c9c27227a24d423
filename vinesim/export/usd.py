"""The vineyard as OpenUSD with the schemas of UsdPhysics, by the package ``usd-core``, which is an extra.

Each tree is an articulation of rigid bodies. A ball joint is a joint with locked translations and a spring (drive)
about each of its axes; a tie is one with a spring along each axis.
"""

from __future__ import annotations

import importlib
import pathlib
from typing import Any

import numpy as np

from vinesim.core import frames
from vinesim.export.articulation import COLORS, Capsule, Link, Tie, Vineyard
from vinesim.scene.ids import Organ
from vinesim.scene.terrain import Terrain


class UsdMissing(RuntimeError):
    """usd-core is not installed. The message is one line with the remedy."""

    exit_code = 3


class _Pxr:
    """The modules of ``pxr`` that are needed."""

    def __init__(self) -> None:
        try:
            for name in ("Gf", "Sdf", "Usd", "UsdGeom", "UsdPhysics", "UsdShade"):
                setattr(self, name, importlib.import_module(f"pxr.{name}"))
        except ImportError as bad:
            raise UsdMissing(f"OpenUSD cannot be loaded ({bad}); run: pip install 'vinesim[export]'") from None

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(name)


def write_usd(vineyard: Vineyard, file: pathlib.Path) -> None:
    """Write the vineyard into a file: text (.usda), or binary (.usd, .usdc).

    Raises :class:`UsdMissing` without usd-core, and :class:`OSError` if the file cannot be written.
    """
    stage = _StageWriter(_Pxr(), vineyard).stage
    file.unlink(missing_ok=True)
    file.touch()  # raises OSError, where USD would raise an error of its own
    stage.GetRootLayer().Export(str(file))


class _StageWriter:
    """Writes a stage in memory."""

    def __init__(self, pxr: _Pxr, vineyard: Vineyard) -> None:
        self._pxr = pxr
        self.stage = stage = pxr.Usd.Stage.CreateInMemory()
        pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.z)
        pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        pxr.UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
        world = pxr.UsdGeom.Xform.Define(stage, "/World")
        stage.SetDefaultPrim(world.GetPrim())
        scene = pxr.UsdPhysics.Scene.Define(stage, "/World/physics")
        scene.CreateGravityDirectionAttr(pxr.Gf.Vec3f(0.0, 0.0, -1.0))
        scene.CreateGravityMagnitudeAttr(vineyard.gravity)
        self._bind_friction(world.GetPrim(), vineyard.friction)
        self._ground(vineyard.terrain)
        self._group("plants")
        self._group("fixed")
        for piece in vineyard.fixed:
            self._capsule(f"/World/fixed/{piece.name}", piece.organ, piece.capsule)
        for crate in vineyard.crates:
            path = f"/World/boxes/{crate.name}"
            prim = self._body(path, crate.pose)
            pxr.UsdPhysics.MassAPI.Apply(prim).CreateMassAttr(crate.mass)
            for i, (pose, half, mass) in enumerate(crate.walls):
                wall = self._box(f"{path}/wall_{i}", Organ.BOX, pose, half)
                pxr.UsdPhysics.MassAPI.Apply(wall.GetPrim()).CreateMassAttr(mass)
        paths: list[str] = []
        poses: list[np.ndarray] = []
        for link in vineyard.links:
            parent = (paths[link.parent], poses[link.parent]) if link.parent >= 0 else ("", frames.pose(np.zeros(3)))
            tree = f"/World/plants/tree_{link.tree}"
            if link.parent < 0:
                xform = pxr.UsdGeom.Xform.Define(stage, tree)
                pxr.UsdPhysics.ArticulationRootAPI.Apply(xform.GetPrim())
            paths.append(f"{tree}/{link.name}")
            poses.append(frames.compose(parent[1], link.pose))
            self._link(link, paths[-1], poses[-1], parent[0])
        for tie in vineyard.ties:
            self._tie(tie, paths[tie.link], poses[tie.link])

    def _link(self, link: Link, path: str, pose: np.ndarray, parent: str) -> None:
        """Add a body of a plant and the joint to its parent; without parent, to the world."""
        pxr = self._pxr
        mass = pxr.UsdPhysics.MassAPI.Apply(self._body(path, pose))
        moments, axes = np.diagonal(link.inertia), np.eye(3)
        if (link.inertia != np.diag(moments)).any():
            moments, axes = np.linalg.eigh(link.inertia)
            axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
        mass.CreateMassAttr(link.mass)
        mass.CreateCenterOfMassAttr(self._vector(link.com))
        mass.CreateDiagonalInertiaAttr(self._vector(moments))
        mass.CreatePrincipalAxesAttr(self._turn(frames.from_matrix(axes)))
        for i, capsule in enumerate(link.capsules):
            self._capsule(f"{path}/shape_{i}", link.organ, capsule)
        for i, leaf in enumerate(link.leaves):
            self._box(f"{path}/leaf_{i}", Organ.LEAF, leaf.pose, leaf.size, collides=False)
        for name, place in link.buds:
            self._place(pxr.UsdGeom.Xform.Define(self.stage, f"{path}/{name}"), place)
        frame = frames.from_matrix(link.axes.T)
        here = frames.pose(np.zeros(3), frame)
        joint = self._joint(f"{path}_joint", parent, frames.compose(link.pose, here), path, here)
        for axis in "XYZ":
            self._limit(joint, f"trans{axis}", 1.0, -1.0)  # a lower limit above the upper one locks the axis
            self._limit(joint, f"rot{axis}", -180.0, 180.0)  # Newton ignores axes without limits
        degree = np.radians(1.0)
        rows = zip("XYZ", link.stiffness * degree, link.damping * degree, link.rest / degree, strict=True)
        for axis, stiffness, damping, rest in rows:
            self._spring(joint, f"rot{axis}", stiffness, damping, rest)

    def _tie(self, tie: Tie, path: str, pose: np.ndarray) -> None:
        frame = frames.from_matrix(tie.axes.T)
        there = frames.pose(tie.point, frames.multiply(frames.conjugate(pose[3:]), frame))
        joint = self._joint(f"/World/ties/{tie.name}", "", frames.pose(tie.anchor, frame), path, there)
        joint.CreateExcludeFromArticulationAttr(True)
        for axis, stiffness, damping in zip("XYZ", tie.stiffness, tie.damping, strict=True):
            self._spring(joint, f"trans{axis}", stiffness, damping, 0.0)

    # ------------------------------------------------------------------ prims

    def _body(self, path: str, pose: np.ndarray) -> Any:
        """Returns the prim of a rigid body, which moves."""
        xform = self._pxr.UsdGeom.Xform.Define(self.stage, path)
        self._place(xform, pose)
        self._pxr.UsdPhysics.RigidBodyAPI.Apply(xform.GetPrim())
        return xform.GetPrim()

    def _joint(self, path: str, parent: str, there: np.ndarray, child: str, here: np.ndarray) -> Any:
        """Returns a joint of poses ``there`` in the parent (the world if empty) and ``here`` in the child."""
        joint = self._pxr.UsdPhysics.Joint.Define(self.stage, path)
        if parent:
            joint.CreateBody0Rel().SetTargets([parent])
        joint.CreateBody1Rel().SetTargets([child])
        joint.CreateLocalPos0Attr(self._vector(there[:3]))
        joint.CreateLocalRot0Attr(self._turn(there[3:]))
        joint.CreateLocalPos1Attr(self._vector(here[:3]))
        joint.CreateLocalRot1Attr(self._turn(here[3:]))
        joint.CreateCollisionEnabledAttr(False)
        return joint

    def _limit(self, joint: Any, axis: str, low: float, high: float) -> None:
        limit = self._pxr.UsdPhysics.LimitAPI.Apply(joint.GetPrim(), axis)
        limit.CreateLowAttr(low)
        limit.CreateHighAttr(high)

    def _spring(self, joint: Any, axis: str, stiffness: float, damping: float, rest: float) -> None:
        drive = self._pxr.UsdPhysics.DriveAPI.Apply(joint.GetPrim(), axis)
        drive.CreateTypeAttr("force")
        drive.CreateStiffnessAttr(float(stiffness))
        drive.CreateDampingAttr(float(damping))
        drive.CreateTargetPositionAttr(float(rest))

    def _capsule(self, path: str, organ: Organ, capsule: Capsule) -> None:
        """Add a capsule or sphere that collides."""
        pxr = self._pxr
        radius = capsule.radius
        middle = 0.5 * (capsule.start + capsule.end)
        if capsule.is_sphere:
            shape = pxr.UsdGeom.Sphere.Define(self.stage, path)
            self._place(shape, frames.pose(middle))
            reach = np.full(3, radius)
        else:
            way = capsule.end - capsule.start
            length = float(np.linalg.norm(way))
            shape = pxr.UsdGeom.Capsule.Define(self.stage, path)
            shape.CreateAxisAttr("X")
            shape.CreateHeightAttr(length)
            self._place(shape, frames.pose(middle, frames.from_x_axis(way / length)))
            reach = np.array([0.5 * length + radius, radius, radius])
        shape.CreateRadiusAttr(radius)
        self._finish_shape(shape, organ, [tuple(-reach), tuple(reach)])

    def _box(self, path: str, organ: Organ, pose: np.ndarray, half: np.ndarray, *, collides: bool = True) -> Any:
        """Returns a box of half sizes ``half`` [3] m."""
        cube = self._pxr.UsdGeom.Cube.Define(self.stage, path)
        cube.CreateSizeAttr(2.0)
        self._place(cube, pose)
        cube.AddScaleOp().Set(self._vector(half))
        self._finish_shape(cube, organ, [(-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)], collides=collides)
        return cube

    def _ground(self, terrain: Terrain | None) -> None:
        """Add the plane z = 0, or the triangles of uneven ground."""
        pxr = self._pxr
        if terrain is None:
            ground = pxr.UsdGeom.Plane.Define(self.stage, "/World/ground")
            ground.CreateAxisAttr("Z")
            ground.CreateWidthAttr(200.0)
            ground.CreateLengthAttr(200.0)
            self._finish_shape(ground, Organ.GROUND, [(-100.0, -100.0, 0.0), (100.0, 100.0, 0.0)])
            return
        points, triangles = _ground_mesh(terrain)
        ground = pxr.UsdGeom.Mesh.Define(self.stage, "/World/ground")
        ground.CreatePointsAttr(pxr.Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
        ground.CreateFaceVertexIndicesAttr(pxr.Vt.IntArray.FromNumpy(triangles.ravel().astype(np.int32)))
        ground.CreateFaceVertexCountsAttr(pxr.Vt.IntArray.FromNumpy(np.full(len(triangles), 3, np.int32)))
        ground.CreateSubdivisionSchemeAttr("none")
        self._finish_shape(ground, Organ.GROUND, [tuple(points.min(0)), tuple(points.max(0))])
        pxr.UsdPhysics.MeshCollisionAPI.Apply(ground.GetPrim()).CreateApproximationAttr("none")

    def _finish_shape(self, shape: Any, organ: Organ, extent: list[tuple], *, collides: bool = True) -> None:
        shape.CreateDisplayColorAttr([self._vector(np.array(COLORS[organ][:3]))])
        shape.CreateExtentAttr([self._vector(np.array(corner)) for corner in extent])
        if collides:
            self._pxr.UsdPhysics.CollisionAPI.Apply(shape.GetPrim())

    def _place(self, xform: Any, pose: np.ndarray) -> None:
        xform.AddTranslateOp().Set(self._pxr.Gf.Vec3d(*map(float, pose[:3])))
        xform.AddOrientOp().Set(self._turn(pose[3:]))

    def _group(self, name: str) -> None:
        """Add a group of bodies at ``/World/<name>`` that do not collide with plants."""
        pxr = self._pxr
        pxr.UsdGeom.Scope.Define(self.stage, f"/World/{name}")
        group = pxr.UsdPhysics.CollisionGroup.Define(self.stage, f"/World/groups/{name}")
        group.GetCollidersCollectionAPI().CreateIncludesRel().SetTargets([f"/World/{name}"])
        group.CreateFilteredGroupsRel().SetTargets(["/World/groups/plants"])

    def _bind_friction(self, world: Any, friction: float) -> None:
        pxr = self._pxr
        material = pxr.UsdShade.Material.Define(self.stage, "/World/friction")
        physics = pxr.UsdPhysics.MaterialAPI.Apply(material.GetPrim())
        physics.CreateStaticFrictionAttr(friction)
        physics.CreateDynamicFrictionAttr(friction)
        binding = pxr.UsdShade.MaterialBindingAPI.Apply(world)
        binding.Bind(material, pxr.UsdShade.Tokens.weakerThanDescendants, "physics")

    def _vector(self, v: np.ndarray) -> Any:
        return self._pxr.Gf.Vec3f(*map(float, v))

    def _turn(self, q: np.ndarray) -> Any:
        x, y, z, w = map(float, q)
        return self._pxr.Gf.Quatf(w, x, y, z)


def _ground_mesh(terrain: Terrain) -> tuple[np.ndarray, np.ndarray]:
    """Returns the nodes [node, 3] m of the uneven ground, and the corners [triangle, 3] of its triangles,
    counterclockwise from above."""
    heights = terrain.nodes()
    rows, columns = heights.shape
    x = np.broadcast_to(terrain.origin[0] + terrain.cell * np.arange(columns), heights.shape)
    y = np.broadcast_to(terrain.origin[1] + terrain.cell * np.arange(rows)[:, None], heights.shape)
    low = (columns * np.arange(rows - 1)[:, None] + np.arange(columns - 1)).ravel()
    high = low + columns + 1
    triangles = np.concatenate([np.stack([low, low + 1, high], -1), np.stack([low, high, high - 1], -1)])
    return np.stack([x, y, heights], -1).reshape(-1, 3), triangles
