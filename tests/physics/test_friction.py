"""Friction of robots' links: as a URDF or the robot's TOML file gives it, against boxes and plants alike."""

from __future__ import annotations

import dataclasses
import math
import pathlib

import numpy as np
import pytest

from tests.support.contact_scenes import bar, cane
from vinesim.core import frames
from vinesim.rigid.mujoco_contacts import PairFriction
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.urdf import DescriptionError
from vinesim.scene.builder import assemble
from vinesim.scene.materials import Material, pair_table
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.world import Physics

INERTIAL = '<inertial><mass value="50"/><inertia ixx="5" iyy="5" izz="5" ixy="0" ixz="0" iyz="0"/></inertial>'
TRAY = f"""<robot name="tray"><link name="base">{INERTIAL}</link><link name="tray">{INERTIAL}
<collision><origin xyz="0 0 -0.05"/><geometry><box size="2 2 0.1"/></geometry></collision>CONTACT</link>
<joint name="tilt" type="revolute"><parent link="base"/><child link="tray"/><origin xyz="0 0 1"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="5000" velocity="1"/></joint>GAZEBO</robot>"""


def tray(
    folder: pathlib.Path, *, gazebo: str = "", contact: str = "", toml: str = "", surface: str = ""
) -> pathlib.Path:
    """A robot with a tray that tilts; ``surface``: material of what is seen of it."""
    file = folder / "tray.urdf"
    seen = TRAY[TRAY.index("<origin") : TRAY.index("</collision>")]
    contact += f'<visual>{seen}<material name="{surface}"/></visual>' if surface else ""
    file.write_text(TRAY.replace("GAZEBO", gazebo).replace("CONTACT", contact))
    group = '[groups.arm]\njoints = ["tilt"]\nstiffness = [1e6]\ndamping = [1e5]\nhome = [0.0]\n'
    (folder / "tray.toml").write_text(toml + group)
    return file


def slides(file: pathlib.Path, slope: float) -> bool:
    """Whether a crate slides on the tray when that has tilted to ``slope`` = tan(angle)."""
    model = Model.allocate(tree=0, body=0, bunch=0, leaf=0, fixed=0, tie=0, box=1)
    model.box_pose[0] = frames.pose([0.0, 0.0, 1.001])
    model.box_size[:] = (0.4, 0.3, 0.2)
    model.box_mass[:] = 2.0
    rigid = RigidWorld(model)
    rigid.add_robot(load_description(file).to_spec("anna"))
    angle = math.atan(slope)
    for step in range(300):
        rigid.command("anna", np.array([angle * min(1.0, step / 100)]))
        rigid.predict()
        rigid.integrate()
    box = rigid.visual_q()[0, :3]
    return bool(np.linalg.norm(box - [0.0, 0.0, 1.0]) > 0.1)


GAZEBO = '<gazebo reference="tray"><mu1>0.3</mu1><mu2>0.3</mu2></gazebo>'


@pytest.mark.parametrize(
    "given",
    [
        {"gazebo": GAZEBO},
        {"gazebo": '<gazebo reference="tray"><mu1 value="0.3"/></gazebo>'},
        {"contact": '<contact><lateral_friction value="0.3"/></contact>'},
        {"toml": "friction = {tray = 0.3}\n", "gazebo": GAZEBO.replace("0.3", "0.9")},
    ],
)
def test_a_crate_slides_on_a_tray_from_the_slope_that_its_friction_says(
    given: dict[str, str], tmp_path: pathlib.Path
) -> None:
    """At 0.3 it stays on a slope of 0.27 and slides on one of 0.33, although the crate's plastic has 0.8."""
    file = tray(tmp_path, **given)
    assert not slides(file, 0.27)
    assert slides(file, 0.33)


def test_a_link_without_friction_of_its_own_has_that_of_the_scene(tmp_path: pathlib.Path) -> None:
    assert not slides(tray(tmp_path), 0.7)
    assert slides(tray(tmp_path), 0.9)


def test_a_crate_slides_on_a_tray_from_the_slope_that_their_materials_say(tmp_path: pathlib.Path) -> None:
    """On a tray of steel as the shipped file says of plastic on steel; on one with its own coefficient by that."""
    coefficient = float(pair_table("friction", 0.8)[Material.PLASTIC, Material.STEEL])
    file = tray(tmp_path, surface="steel")
    assert not slides(file, 0.8 * coefficient)
    assert slides(file, 1.25 * coefficient)
    assert not slides(tray(tmp_path, surface="steel", gazebo=GAZEBO), 1.25 * coefficient)


def test_a_listed_pair_with_the_usual_coefficient_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A crate dropped and pushed: constraints that are written anew with the same coefficient are the same."""

    def run() -> list[np.ndarray]:
        model = Model.allocate(tree=0, body=0, bunch=0, leaf=0, fixed=0, tie=0, box=2)
        model.box_pose[:] = frames.pose(np.array([[0.0, 0.0, 0.05], [0.05, 0.0, 0.3]]))
        model.box_size[:] = (0.4, 0.3, 0.2)
        model.box_mass[:] = 2.0
        rigid = RigidWorld(model)
        states = []
        for step in range(150):
            rigid.mj_data.xfrc_applied[1, 0] = 12.0 if step > 100 else 0.0
            rigid.predict()
            rigid.integrate()
            states.append(rigid.mj_data.qpos.copy())
        return states

    before = run()
    monkeypatch.setattr(PairFriction, "__init__", list_all_pairs)
    assert all((a == b).all() for a, b in zip(before, run(), strict=True))


def list_all_pairs(friction: PairFriction, parameters: PhysicsParameters) -> None:
    """In place of ``PairFriction.__init__``: every pair is listed, with the coefficient of all others."""
    friction._table = np.full((len(Material), len(Material)), parameters.friction)
    friction._is_listed = np.ones_like(friction._table, bool)


def sliding_ratio(visual: str, own: str = "") -> float:
    """Largest share of the normal force by which a bar that is bent past a cane is held back along the surface.

    ``visual``: material of what is seen at the bar's place; ``own``: a coefficient of the URDF.
    """
    physics = Physics(assemble([cane((0.0, 0.0, 1.0), pieces=8)]))
    robot = bar((0.5, -0.045, 0.95), stiffness=5000.0, damping=300.0)
    shape = robot.urdf[robot.urdf.index("<collision>") + 11 : robot.urdf.index("</collision>")]
    seen = f'<visual>{shape}<material name="{visual}"/></visual><collision>' if visual else "<collision>"
    given = f'<gazebo reference="bar"><mu1>{own}</mu1></gazebo></robot>' if own else "</robot>"
    urdf = robot.urdf.replace("<collision>", seen).replace("</robot>", given)
    physics.add_robot(dataclasses.replace(robot, urdf=urdf))
    physics.rigid.command("bar", np.array([0.1]))
    ratio = []
    for _ in range(60):
        physics.step()
        axis = physics.rigid.link_pose("bar", "bar")[:2]
        for contact in physics.contacts:
            normal = np.append(contact.position[:2] - axis, 0.0) / np.linalg.norm(contact.position[:2] - axis)
            along = float(contact.force @ normal)
            ratio.append(np.linalg.norm(contact.force - along * normal) / abs(along))
    return max(ratio)


@pytest.mark.parametrize(
    ("visual", "own", "coefficient"),
    [("", "0.2", 0.2), ("bright_steel", "0.2", 0.2), ("bright_steel", "", None), ("plastic", "", None)],
)
def test_a_cane_slips_on_a_bar_by_their_materials_or_by_the_bars_own_friction(
    visual: str, own: str, coefficient: float | None
) -> None:
    """A cane across the bar is dragged along: the force reaches the cone of the pair, not that of the guess of 0.8."""
    if coefficient is None:
        of_visual = {"bright_steel": Material.STEEL, "plastic": Material.PLASTIC}[visual]
        coefficient = float(pair_table("friction", 0.8)[Material.BARK, of_visual])
        assert coefficient < 0.5
    # the normal here is that of the step's end, the contact's is that of its middle
    assert 0.9 * coefficient < sliding_ratio(visual, own) < coefficient + 0.05


@pytest.mark.parametrize("stiffness", [2000.0, 20000.0])
def test_a_bar_stands_as_deep_in_a_cane_as_the_stiffness_of_their_materials_says(
    stiffness: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At rest: force = stiffness times the depth at the start of the step, for a pair that the file gives its own."""

    def listed(quantity: str, default: float) -> np.ndarray:
        table = pair_table(quantity, default)
        if quantity == "stiffness":
            table[Material.BARK, Material.UNKNOWN] = table[Material.UNKNOWN, Material.BARK] = stiffness
        return table

    monkeypatch.setattr("vinesim.scene.materials.pair_table", listed)
    physics = Physics(assemble([cane((0.0, 0.0, 1.0), pieces=8, beta=0.05)]))
    physics.add_robot(bar((0.4375, -0.045, 0.95), stiffness=5000.0, damping=300.0))  # at the middle of a piece
    physics.rigid.command("bar", np.array([0.02]))
    for _ in range(300):
        physics.step()
    contacts = physics.contact_solver.impulses.contacts
    assert len(physics.contacts) == 1
    normal = float(contacts.axes[0][0] @ contacts.force[0])
    assert normal > 1.0
    assert normal == pytest.approx(-stiffness * contacts.gap[0], rel=0.01)


def test_what_never_slips_holds_a_crate_on_a_steep_slope(tmp_path: pathlib.Path) -> None:
    """Files write coefficients of 500 to 1e14 for it. A crate as low as this one tips on no slope below 1.5."""
    assert not slides(tray(tmp_path, gazebo=GAZEBO.replace("0.3", "1e14")), 1.0)


@pytest.mark.parametrize("text", ["-0.1", "rubber", "", "nan", "inf"])
def test_a_coefficient_that_is_none_is_refused_in_one_line(text: str, tmp_path: pathlib.Path) -> None:
    file = tray(tmp_path, gazebo=GAZEBO.replace("<mu1>0.3", f"<mu1>{text}"))
    with pytest.raises(DescriptionError, match=r"mu1 of 'tray'.*0 or more") as caught:
        load_description(file)
    assert "\n" not in str(caught.value)


def test_friction_of_an_unknown_link_is_refused(tmp_path: pathlib.Path) -> None:
    with pytest.raises(DescriptionError, match="'spoon'"):
        load_description(tray(tmp_path, toml="friction = {spoon = 0.3}\n"))


# ---------------------------------------------------------------------- steps of other lengths


def rebound(dt: float, speed: float) -> float:
    """[m/s] With which a bar of 3 kg that hit a cane at ``speed`` leaves it."""
    physics = Physics(assemble([cane((0.0, 0.0, 1.0), pieces=8)]), parameters=PhysicsParameters(dt=dt))
    physics.add_robot(bar((0.3, -0.06, 0.95)))
    dof = physics.rigid.robot("bar").v
    physics.rigid.mj_data.qvel[dof] = speed
    for _ in range(round(0.8 / dt)):
        physics.step()
    return float(physics.rigid.mj_data.qvel[dof][0])


@pytest.mark.parametrize("speed", [0.2, 1.0])
def test_a_contact_gives_back_as_much_whatever_the_step_takes(speed: float) -> None:
    """With 5 and with 10 ms a bar leaves a cane at speeds within 5 %: a contact's damping is a time, not a step."""
    short = rebound(0.005, speed)
    normal = rebound(0.01, speed)
    assert -0.75 * speed < normal < -0.5 * speed
    assert short == pytest.approx(normal, rel=0.05)
