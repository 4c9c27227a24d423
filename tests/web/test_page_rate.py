"""The page where pictures come too slowly: it draws less, but not because one picture had to wait."""

import json

import pytest

from tests.support.page_module import page_module

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("browser")]


@pytest.fixture(scope="module")
def rates(browser):
    """Evaluate a script in which everything of ``rate.js`` is known; its value."""
    with page_module(browser, "rate.js", "Detail", "FirstPictures", "PIXELS", "TRIANGLES") as run:
        yield run


@pytest.mark.parametrize(
    ("times", "median"),
    [([5.0] + 11 * [0.01], 0.01), (12 * [0.5], 0.5), (5 * [3.0] + 7 * [0.01], 0.01), (11 * [1.0], None)],
)
def test_pictures_that_wait_for_compilers_do_not_make_a_browser_slow(rates, times, median):
    """A card that then draws 100 pictures a second was given a fifth of the triangles for good."""
    found = rates(
        f"const first = new FirstPictures(12); for (const t of {json.dumps(times)}) first.add(t); return first.median;"
    )
    assert found == median


def scales(rates, cost, *, windows=40, rate=72.0):
    """Scales after each window of pictures on a display of ``rate`` [Hz], where a picture at full scale takes ``cost``
    [s] and one with fewer pixels proportionally less; pictures come with the display."""
    return rates(
        f"""
        const scale = new Detail(PIXELS), found = [];
        for (let k = 0; k < {windows}; ++k) {{
          for (let i = 0; i < 36; ++i)
            scale.add(Math.ceil({cost} * scale.value ** 2 * {rate} - 1e-9) / {rate}, {rate});
          found.push(scale.value);
        }}
        return found;"""
    )


def test_a_headset_that_keeps_up_draws_all_pixels(rates):
    assert set(scales(rates, 0.010)) == {1.0}


@pytest.mark.parametrize("cost", [0.016, 0.028, 0.040])
def test_a_headset_that_falls_behind_draws_as_many_pixels_as_it_can(rates, cost):
    """Of 13.9 ms a picture takes as much as it may: at the scale that it comes to, and not at the next finer step."""
    found = scales(rates, cost, windows=15)
    assert found == sorted(found, reverse=True)
    assert found[-1] == pytest.approx(found[-2])
    assert cost * found[-1] ** 2 <= 1.0 / 72.0 < cost * (found[-1] / 0.85) ** 2


def test_a_finer_scale_that_proves_too_fine_is_tried_ever_more_rarely(rates):
    """A scale is fine enough again when less is in view, and a card that cannot do more is not disturbed every time."""
    found = scales(rates, 0.028, windows=400)
    falls = [k for k in range(6, 400) if found[k] < found[k - 1]]
    assert 2 <= len(falls) <= 4
    assert falls[1] - falls[0] >= 1.3 * falls[0]
    assert max(found[6:]) ** 2 * 0.028 < 1.3 / 72.0
    assert min(found) > 0.95 * found[5]
    easier = rates(
        "const scale = new Detail(PIXELS); scale.value = 0.6;"
        "for (let k = 0; k < 300 * 36; ++k) scale.add(1 / 72, 72); return scale.value;"
    )
    assert easier == pytest.approx(1.0)


def test_a_scale_never_falls_below_half(rates):
    assert scales(rates, 1.0)[-1] == 0.5


@pytest.mark.parametrize(("base", "each", "expected"), [(0.002, 0.001, 4.0), (0.005, 0.006, 2.0), (0.010, 0.020, 0.4)])
def test_a_screen_shows_as_many_triangles_as_come_in_time(rates, base, each, expected):
    """A picture takes ``base`` and ``each`` for every 300,000 triangles [s]; the display shows 60 a second."""
    found = rates(
        f"""
        const detail = new Detail(TRIANGLES), found = [];
        for (let k = 0; k < 200 * 36; ++k) {{
          detail.add(Math.ceil(({base} + {each} * detail.value) * 60 - 1e-9) / 60, 60);
          found.push(detail.value);
        }}
        return found;"""
    )
    settled = sorted(found[len(found) // 2 :])[len(found) // 4]
    assert 0.7 * expected <= settled <= expected
