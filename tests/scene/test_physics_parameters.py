"""Parameters of the physics: each documented, each in its range, read from a scene file and used."""

import collections
import inspect
import pathlib
import re

import msgspec
import numpy as np
import pytest

import vinesim
from tests.physics.test_contact_solver import rows_of_canes
from vinesim.core.data_files import data_dir
from vinesim.scene import physics_parameters
from vinesim.scene.materials import pair_numbers
from vinesim.scene.physics_parameters import ParameterError, PhysicsParameters
from vinesim.scene.spec import SceneError, load_scene
from vinesim.world import Physics

FIELDS = [field.name for field in msgspec.structs.fields(PhysicsParameters)]


def annotation_and_description(name):
    text = inspect.getsource(physics_parameters)
    ((annotation, description),) = re.findall(rf'^    {name}: (.*) = .*\n    """((?:.|\n)*?)"""', text, re.MULTILINE)
    return annotation, description


def test_every_parameter_has_a_unit_and_a_source():
    found = []
    for name in FIELDS:
        annotation, description = annotation_and_description(name)
        if annotation.startswith(("Count", "Capacity", "Literal")) or "int" in annotation or annotation == "bool":
            continue
        if not re.match(r"\[[^]]+\] ", description):
            found.append(f"{name}: give its unit first")
        if not re.search(r"\b(READ|DERIVED|TUNED|GUESSED)\b", description):
            found.append(f"{name}: give its source")
    assert not found, "\n".join(found)


def test_the_page_counts_the_guesses_among_them_and_among_pairs_of_materials():
    grades = collections.Counter()
    for name in FIELDS:
        given = re.search(r"\b(READ|DERIVED|TUNED|GUESSED)\b", annotation_and_description(name)[1])
        grades[given[0] if given else ""] += 1
    text = " ".join((pathlib.Path(__file__).parents[2] / "docs/validation.md").read_text().split())
    counted = re.search(
        r"(\d+) of (\d+) physics parameters are guesses\*\* \((\d+) tuned with this solver, (\d+) derived, (\d+) read, "
        r"(\d+) switches and sizes\)",
        text,
    )
    assert counted, "no count of physics parameters"
    kinds = (grades[kind] for kind in ("TUNED", "DERIVED", "READ", ""))
    assert tuple(map(int, counted.groups())) == (grades["GUESSED"], len(FIELDS), *kinds)
    pairs = pair_numbers()
    listed = collections.Counter(number.grade for number in pairs["friction"].values())
    of_pairs = r"(\d+) coefficients of friction by pair of materials (\d+) are derived, (\d+) read, (\d+) guessed"
    counted = re.search(of_pairs, text)
    assert counted, "no count of pairs of materials"
    expected = (len(pairs["friction"]), listed["DERIVED"], listed["READ"], listed["GUESSED"])
    assert tuple(map(int, counted.groups())) == expected
    assert ("no stiffness of a pair is listed" in text) is (len(pairs["stiffness"]) == 0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"dt": -0.01}, "physics.dt is -0.01; give a number above 0"),
        ({"gravity": float("nan")}, "physics.gravity is nan; give a finite number"),
        ({"phi": 1.2}, "physics.phi is 1.2; give a number of 1 or less"),
        ({"sleep": 1}, "physics.sleep is 1; give True or False"),
        ({"contact_capacity": 0}, "physics.contact_capacity is 0; give a number of 1 or more"),
        ({"bunch_pool_size": 2.5}, "physics.bunch_pool_size is 2.5; give a whole number"),
        ({"fast_joint_rate": 80.0}, "physics.fast_joint_rate is 80.0, max_joint_rate 50.0, .* in increasing order"),
    ],
)
def test_a_parameter_out_of_range_is_refused(options, message):
    with pytest.raises(ParameterError, match=f"^{message}$"):
        PhysicsParameters(**options)


def scene_with(tmp_path, table):
    path = tmp_path / "other.toml"
    path.write_text((data_dir() / "scenes" / "demo.toml").read_text() + f"\n[physics]\n{table}\n")
    return load_scene(path)


def test_a_scene_file_overrides_parameters(tmp_path):
    assert load_scene("demo").physics == PhysicsParameters()
    changed = scene_with(tmp_path, "friction = 0.5\nsleep_duration = 2\nsleep = false")
    assert changed.physics == PhysicsParameters(friction=0.5, sleep_duration=2.0, sleep=False)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("frictoin = 0.5", "physics.frictoin is not a field; did you mean 'friction'?"),
        ("friction = 0", "physics.friction is 0; give a number > 0"),
        ("friction = inf", "physics.friction is inf; give a finite number"),
        ("max_joint_rate = 1", "physics.fast_joint_rate is 5.0, max_joint_rate 1.0"),
    ],
)
def test_a_scene_file_with_an_invalid_parameter_is_refused_in_one_line(tmp_path, table, message):
    with pytest.raises(SceneError, match=message.replace("?", r"\?")) as caught:
        scene_with(tmp_path, table)
    assert "\n" not in str(caught.value)
    assert "other.toml" in str(caught.value)


def ticks_until_asleep(**options):
    physics = Physics(rows_of_canes(1), parameters=PhysicsParameters(**options))
    physics.plants.wake(np.array([0]))
    for tick in range(1000):
        physics.step()
        if not len(physics.plants.awake):
            return tick + 1
    return 0


def test_durations_are_in_seconds_for_any_time_step():
    assert [ticks_until_asleep(dt=dt) * dt for dt in (0.005, 0.01)] == pytest.approx([0.5, 0.5])
    assert ticks_until_asleep(sleep_duration=1.0) == 100


def test_sleep_can_be_switched_off():
    assert ticks_until_asleep(sleep=False) == 0


def test_every_parameter_is_used():
    package = pathlib.Path(vinesim.__file__).parent
    own = pathlib.Path(physics_parameters.__file__)
    text = "\n".join(path.read_text() for path in sorted(package.rglob("*.py")) if path != own)
    unused = [name for name in FIELDS if not re.search(rf"(parameters|\bp)\.{name}\b", text)]
    assert unused == []
