"""The registry of kinds of sensors: what each layer knows of a kind is where the kind says."""

import pytest

from vinesim.robot.description.sidecar import read_sidecar
from vinesim.robot.description.urdf import DescriptionError
from vinesim.scene.values import SENSOR_KINDS
from vinesim.sensors.sensor import maker


@pytest.mark.parametrize("name", SENSOR_KINDS)
def test_each_layer_has_its_part_of_a_kind(name):
    kind = SENSOR_KINDS[name]
    assert kind.mount.kind == name
    assert kind.maker.startswith("vinesim.sensors.")
    assert kind.publisher.startswith("vinesim.ros.publishers.")
    assert kind.topics
    assert kind.whole
    assert callable(maker(name).make)


@pytest.mark.ros
@pytest.mark.parametrize("name", SENSOR_KINDS)
def test_each_kind_has_a_publisher(name):
    pytest.importorskip("rclpy")
    from vinesim.ros.sensor_node import publisher

    assert callable(publisher(name).pending)


def test_no_two_kinds_share_a_table():
    tables = [kind.table for kind in SENSOR_KINDS.values()]
    assert len(set(tables)) == len(tables)


@pytest.mark.parametrize("name", SENSOR_KINDS)
def test_the_table_of_a_kind_is_read_and_checked(name, tmp_path):
    kind = SENSOR_KINDS[name]
    file = tmp_path / "robot.toml"
    file.write_text(f'[[{kind.table}]]\nname = "s"\nframe = "link"\ntype = "t"\nrate = 2.5\n')
    [mount] = list(read_sidecar(file).mounts(name) or ())
    assert (mount.kind, mount.name, mount.frame, mount.type, mount.rate) == (name, "s", "link", "t", 2.5)
    assert mount.fault() is None
    file.write_text(f'[[{kind.table}]]\nname = "s"\nframe = "link"\nrate = 0.0\n')
    [slow] = list(read_sidecar(file).mounts(name) or ())
    assert slow.fault() == ("the rate 0.0", "give 0.01 to 1000 Hz")
    file.write_text(f'[[{kind.table}]]\nname = "s"\nframe = "link"\nlens = 1\n')
    with pytest.raises(DescriptionError, match=rf"lens.*{kind.table}"):
        read_sidecar(file)
    file.write_text("")
    assert read_sidecar(file).mounts(name) is None
