from __future__ import annotations

from pathlib import Path

import pytest

import vinesim
from tests.structure.kernel_grammar import breaches

KERNELS = sorted((Path(vinesim.__file__).parent / "kernels").rglob("*.py"))

GOOD = '''
@wp.kernel
def fade(
    # model
    rate: float,
    # in
    light: wp.array(dtype=float),
    # out
    shade_out: wp.array(dtype=float),
):
    """One thread fades one light."""
    i = wp.tid()
    pair = wp.vec2()
    pair[0] = light[i]
    shade_out[i] = rate * pair[0]
'''


def test_kernels_follow_the_grammar() -> None:
    found = [breach for path in KERNELS for breach in breaches(path.read_text(), path.name)]
    assert not found, "\n".join(found)


def test_there_are_kernels() -> None:
    assert any("@wp.kernel" in path.read_text() for path in KERNELS)


def test_a_valid_kernel_has_no_breaches() -> None:
    assert breaches(GOOD.replace("one light.", "one light.\n\n    light: [light] lx.\n    ")) == []
    assert breaches(GOOD) == []
    assert breaches(GOOD.replace("@wp.kernel", "@wp.kernel(enable_backward=False)")) == []


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("    # model\n", "", "# model, # in, # out, in that order"),
        ("    # in\n", "    # out\n", "light is under # out; call it light_out"),
        ("    # out\n", "", "shade_out ends in _out; put it under # out"),
        ("shade_out", "shade", "shade is under # out; call it shade_out"),
        ('    """One thread fades one light."""\n', "", "name in its docstring what one thread does"),
        ("One thread fades", "Fade", "name in its docstring what one thread does"),
        ("    rate: float,\n", "".join(f"    r{i}: float,\n" for i in range(19)), "21 arguments; group them"),
        ("    pair[0] = light[i]\n", "    light[i] = 0.0\n", "writes light, which is not under # out"),
        ("    pair[0] = light[i]\n", "    light[i] += 1.0\n", "writes light, which is not under # out"),
        ("    pair[0] = light[i]\n", "    wp.atomic_add(light, i, 1.0)\n", "writes light, which is not under # out"),
        ("    pair[0] = light[i]\n", "    light[i][0], i = 1.0, 2\n", "writes light, which is not under # out"),
    ],
)
def test_each_breach_is_reported(old: str, new: str, message: str) -> None:
    found = breaches(GOOD.replace(old, new))
    assert any(message in breach for breach in found), found


def test_functions_mark_arrays_that_they_write() -> None:
    source = "@wp.func\ndef set(a: wp.array(dtype=float), i: int):\n    a[i] = 1.0\n"
    assert breaches(source) == ["<source>:3: set writes its argument a; call it a_out"]
    assert breaches(source.replace("(a:", "(a_out:").replace("    a[", "    a_out[")) == []
