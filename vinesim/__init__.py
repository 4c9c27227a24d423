"""vinesim: a simulator of vineyards, with soft vines and grapes, robots and people that touch them, and sensors.

    import vinesim

    simulation = vinesim.Simulation("demo")
    robot = simulation.add_robot("vinebot", pose=(1.5, -1.0, 1.57))
    simulation.step(100)

Every name below is loaded when it is first used; ``import vinesim`` alone takes milliseconds.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from vinesim.core.version import __version__

if TYPE_CHECKING:
    from vinesim.api.client import Client as Client
    from vinesim.api.energy import Energy as Energy
    from vinesim.api.energy import Momentum as Momentum
    from vinesim.api.export import export_vineyard as export_vineyard
    from vinesim.api.page import Page as Page
    from vinesim.api.picking import Grasp as Grasp
    from vinesim.api.picking import PickAttempt as PickAttempt
    from vinesim.api.picking import attempt_pick as attempt_pick
    from vinesim.api.picking import reachable_grasps as reachable_grasps
    from vinesim.api.plant_work import Binding as Binding
    from vinesim.api.plant_work import Hold as Hold
    from vinesim.api.pusher import Pusher as Pusher
    from vinesim.api.recording import RecordedMessage as RecordedMessage
    from vinesim.api.recording import Recording as Recording
    from vinesim.api.sensors import Camera as Camera
    from vinesim.api.sensors import Lidar as Lidar
    from vinesim.api.sensors import look_at as look_at
    from vinesim.api.simulation import Simulation as Simulation
    from vinesim.api.sweep import sweep as sweep
    from vinesim.core import frames as frames
    from vinesim.core.errors import UsageError as UsageError
    from vinesim.interaction.blades import Blade as Blade
    from vinesim.net.server.server import Server as Server
    from vinesim.plants.rollout import Rollout as Rollout
    from vinesim.robot.drives.controlled_robot import Robot as Robot
    from vinesim.scene.builder import RodMaterial as RodMaterial
    from vinesim.scene.builder import TreeBuilder as TreeBuilder
    from vinesim.scene.cane import CaneBuilder as CaneBuilder
    from vinesim.scene.cane import assemble as assemble
    from vinesim.scene.cane import cane as cane
    from vinesim.scene.generation.vineyard import generate as generate
    from vinesim.scene.ids import Organ as Organ
    from vinesim.scene.model import Model as Model
    from vinesim.scene.physics_parameters import PhysicsParameters as PhysicsParameters
    from vinesim.scene.plant_import.imported_plant import ImportedPlant as ImportedPlant
    from vinesim.scene.plant_import.imported_plant import import_plant as import_plant
    from vinesim.scene.spare_bodies import with_spares as with_spares
    from vinesim.scene.spec import Scene as Scene
    from vinesim.scene.spec import load_scene as load_scene
    from vinesim.scene.state import State as State
    from vinesim.scene.surroundings import Box as Box
    from vinesim.scene.surroundings import Tie as Tie
    from vinesim.scene.surroundings import Wire as Wire
    from vinesim.scene.wind import Wind as Wind

_MODULES = {
    "Binding": "api.plant_work",
    "Blade": "interaction.blades",
    "Box": "scene.surroundings",
    "Camera": "api.sensors",
    "CaneBuilder": "scene.cane",
    "Client": "api.client",
    "Energy": "api.energy",
    "Grasp": "api.picking",
    "Hold": "api.plant_work",
    "ImportedPlant": "scene.plant_import.imported_plant",
    "Lidar": "api.sensors",
    "Model": "scene.model",
    "Momentum": "api.energy",
    "Organ": "scene.ids",
    "Page": "api.page",
    "PhysicsParameters": "scene.physics_parameters",
    "PickAttempt": "api.picking",
    "Pusher": "api.pusher",
    "RecordedMessage": "api.recording",
    "Recording": "api.recording",
    "Robot": "robot.drives.controlled_robot",
    "RodMaterial": "scene.builder",
    "Rollout": "plants.rollout",
    "Scene": "scene.spec",
    "Server": "net.server.server",
    "Simulation": "api.simulation",
    "State": "scene.state",
    "Tie": "scene.surroundings",
    "TreeBuilder": "scene.builder",
    "UsageError": "core.errors",
    "Wind": "scene.wind",
    "Wire": "scene.surroundings",
    "assemble": "scene.cane",
    "attempt_pick": "api.picking",
    "cane": "scene.cane",
    "export_vineyard": "api.export",
    "frames": "core.frames",
    "generate": "scene.generation.vineyard",
    "import_plant": "scene.plant_import.imported_plant",
    "load_scene": "scene.spec",
    "look_at": "api.sensors",
    "reachable_grasps": "api.picking",
    "sweep": "api.sweep",
    "with_spares": "scene.spare_bodies",
}
"""Module of each public name, relative to the package ``vinesim``."""

__all__ = [
    "Binding",
    "Blade",
    "Box",
    "Camera",
    "CaneBuilder",
    "Client",
    "Energy",
    "Grasp",
    "Hold",
    "ImportedPlant",
    "Lidar",
    "Model",
    "Momentum",
    "Organ",
    "Page",
    "PhysicsParameters",
    "PickAttempt",
    "Pusher",
    "RecordedMessage",
    "Recording",
    "Robot",
    "RodMaterial",
    "Rollout",
    "Scene",
    "Server",
    "Simulation",
    "State",
    "Tie",
    "TreeBuilder",
    "UsageError",
    "Wind",
    "Wire",
    "__version__",
    "assemble",
    "attempt_pick",
    "cane",
    "export_vineyard",
    "frames",
    "generate",
    "import_plant",
    "load_scene",
    "look_at",
    "reachable_grasps",
    "sweep",
    "with_spares",
]


def __getattr__(name: str) -> Any:
    """Load a public name when it is first used."""
    if name not in _MODULES:
        raise AttributeError(f"module 'vinesim' has no attribute {name!r}; it offers {', '.join(__all__)}")
    module = importlib.import_module(f"vinesim.{_MODULES[name]}")
    value = module if _MODULES[name] == f"core.{name}" else getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
