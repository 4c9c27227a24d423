"""The URDF of another client's robot, for programs on this machine such as RViz."""

from __future__ import annotations

import functools
import pathlib

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.robot.description.description import RobotDescription
from vinesim.scene.appearance.mesh_files import store_stl


@functools.lru_cache(64)  # descriptions never change
def shown_urdf(description: RobotDescription) -> str:
    """Returns the URDF of a robot with addresses of meshes at which other programs on this machine find them: files of
    this machine, and received triangles in the cache. A text without meshes stays as it is."""
    if description.ros_urdf:
        return description.ros_urdf
    root = etree.fromstring(description.urdf.encode())
    meshes = root.findall("link//geometry/mesh")
    for mesh in meshes:
        name = mesh.get("filename", "")
        if name in description.meshes:
            mesh.set("filename", store_stl(description.meshes[name]).as_uri())
        elif pathlib.Path(name).is_absolute():
            mesh.set("filename", pathlib.Path(name).as_uri())
    return etree.tostring(root, encoding="unicode") if meshes else description.urdf
