"""Array fields: allocation, counts and checks follow from one declaration."""

import dataclasses

import numpy as np
import pytest

from vinesim.core.array_fields import StructOfArrays, array


@dataclasses.dataclass
class Wires(StructOfArrays):
    start: np.ndarray = array("wire", 3, unit="m")
    radius: np.ndarray = array("wire", unit="m", fill=0.002)
    organ: np.ndarray = array("wire", unit="1", dtype=np.int32)
    pole: np.ndarray = array("pole", unit="m")


def test_allocation_fills_shapes_types_and_defaults():
    wires = Wires.allocate(wire=4, pole=2)
    assert wires.start.shape == (4, 3)
    assert wires.radius.tolist() == pytest.approx([0.002] * 4)
    assert wires.organ.dtype == np.int32
    assert wires.counts() == {"wire": 4, "pole": 2}
    assert wires.check() is wires
    assert str(Wires.array_fields()["start"]) == "[wire, 3] float32 [m]"


def test_defaults_are_not_shared():
    wires = Wires.allocate(wire=2, pole=0)
    twin = wires.copy()
    wires.radius[0] = 1.0
    assert twin.radius[0] == pytest.approx(0.002)
    assert Wires.allocate(wire=2, pole=0).radius[0] == pytest.approx(0.002)


@pytest.mark.parametrize(
    ("field", "value", "text"),
    [
        ("radius", np.zeros(3, np.float32), r"Wires\.radius has 3 along 'wire', expected 4 as in start"),
        ("radius", np.zeros((4, 1), np.float32), r"Wires\.radius has 2 axes"),
        ("start", np.zeros((4, 2), np.float32), r"Wires\.start has 2 along 3, expected 3"),
        ("start", np.zeros((4, 3)), r"Wires\.start is float64"),
        ("radius", np.array([0, np.nan, 0, 0], np.float32), r"Wires\.radius\[1\] is not finite"),
    ],
)
def test_an_invalid_array_is_named(field, value, text):
    wires = Wires.allocate(wire=4, pole=1)
    setattr(wires, field, value)
    with pytest.raises(ValueError, match=text):
        wires.check()


def test_a_missing_count_is_named():
    with pytest.raises(ValueError, match=r"Wires\.pole needs a count for 'pole'"):
        Wires.allocate(wire=4)
