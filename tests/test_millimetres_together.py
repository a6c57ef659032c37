"""Maps that share light and reflectance solved together, and weighed with a length that somebody knows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from raising import refused
from test_millimetres import LIGHT, looks, quick  # noqa: F401 - fixtures

from lightdepth.light import millimetres as room
from lightdepth.light.known_length import BOTH, LENGTH, KnownLength, weighed
from lightdepth.light.looks import Look
from lightdepth.light.millimetres import Millimetres, Together, together


def resized(given: list[Look], factor: float) -> list[Look]:
    """The same looks in units that are so many times as small."""
    result = []
    for look in given:
        pose = look.cam_from_map.copy()
        pose[:3, 3] *= factor
        result.append(replace(look, cam_from_map=pose, distance=look.distance * factor))
    return result


def test_maps_of_one_procedure_have_scales_of_their_own_and_one_reflectance(looks):  # noqa: F811
    found = together([looks, resized(looks, 4.0), looks[:2]], LIGHT, [2.3, 0.6, 2.0], surface=0.12)
    first, second, third = found.maps
    assert first.mm_per_unit == pytest.approx(2.0, rel=0.1) and second.mm_per_unit == pytest.approx(0.5, rel=0.15)
    assert first.reflectance == second.reflectance and not first.refused and not second.refused
    assert third.refused == "2 keyframes see the surface, of 3 needed" and np.isnan(third.mm_per_unit)
    assert found.covariance.shape == (3, 3) and np.isinf(found.covariance[2, 2])
    assert np.sqrt(found.covariance[0, 0]) == first.deviation > 0.12  # that of its surface is in it
    assert found.covariance[0, 1] < found.covariance[0, 0] - 0.12**2  # and is its own
    # What both share of their errors, the reflectance and the lens's part, is in the covariance.
    assert found.covariance[0, 1] == found.covariance[1, 0] != 0


def test_what_maps_share_is_chosen_by_all_of_them():
    """Costs (scales, rhos, shares) of two maps: alone, each would take another reflectance."""
    first, second = np.ones((3, 2, 1)), np.ones((3, 2, 1))
    first[0, 0], first[2, 1] = 0.5, 0.6  # would take rho 0 and the first scale
    second[1, 1] = 0.1  # insists on rho 1
    assert [int(p.argmin()) for p in room._profiles([first, second])] == [2, 1]
    assert [int(p.argmin()) for p in room._profiles([first])] == [0]


def told(mm: float, deviation: float = 0.1, refused: str = "") -> Millimetres:
    return Millimetres(mm, deviation, 0.1, 999, refused)


def test_a_length_as_sure_as_the_light_meets_it_half_way():
    found = weighed(Together((told(2.0),), np.array([[0.01]])), KnownLength(0, 1.0, 2.2, 0.22))
    assert found.maps[0].mm_per_unit == pytest.approx(np.sqrt(2.0 * 2.2)) and found.maps[0].by == BOTH
    assert found.maps[0].deviation == pytest.approx(0.1 / np.sqrt(2))
    assert found.covariance[0, 0] == pytest.approx(0.005)


def test_a_length_that_is_sure_says_the_scale_and_moves_maps_that_err_with_its_own():
    """Two maps whose errors are the same but for a little, and one that errs by itself."""
    covariance = np.array([[0.01, 0.008, 0.0], [0.008, 0.01, 0.0], [0.0, 0.0, 0.01]])
    found = weighed(Together((told(1.0), told(3.0), told(5.0)), covariance), KnownLength(0, 2.0, 2.2, 1e-6))
    first, second, third = found.maps
    assert first.mm_per_unit == pytest.approx(1.1) and first.deviation < 1e-4
    assert second.mm_per_unit == pytest.approx(3 * 1.1**0.8) and second.deviation == pytest.approx(0.06)
    assert third.mm_per_unit == pytest.approx(5.0) and third.deviation == pytest.approx(0.1)


def test_a_length_tells_its_own_map_where_the_light_tells_nothing():
    light = together([[], []], replace(LIGHT, source="assumed"), [1.0, 1.0])
    first, second = weighed(light, KnownLength(0, 4.0, 8.0, 0.8)).maps
    assert (first.mm_per_unit, first.by, first.refused) == (2.0, LENGTH, "")
    assert first.deviation == pytest.approx(0.1) and second.refused.startswith("nobody gave the light")
    assert first.light_refused == second.refused and first.cure.startswith("give it: --light")
    low, high = first.interval
    assert low * high == pytest.approx(4.0) and low == pytest.approx(2.0 * np.exp(-0.1645))


def test_where_length_and_light_contradict_each_other_the_light_is_not_believed_in_any_map():
    found = weighed(Together((told(1.0), told(1.0)), 0.01 * np.eye(2)), KnownLength(0, 1.0, 2.0, 0.1))
    first, second = found.maps
    assert (first.mm_per_unit, first.by, first.refused) == (2.0, LENGTH, "")
    assert second.refused == "the light contradicts the known length, by which units are 2.00 times as large"
    assert second.cure.startswith("measure the length again")
    assert first.light_refused == second.refused and first.cure == second.cure and second.light_refused == ""


@pytest.mark.parametrize(("units", "mm", "error"), [(0.0, 5.0, 1.0), (1.0, -5.0, 1.0), (1.0, 5.0, 0.0)])
def test_a_length_of_nothing_is_refused(units, mm, error):
    with refused(where="the known length"):
        KnownLength(0, units, mm, error)


@pytest.mark.parametrize(
    "why",
    [
        together([[]], replace(LIGHT, source="assumed"), [1.0]).maps[0].refused,
        together([[]], replace(LIGHT, position_mm=(0.0, 0.0, 0.0)), [1.0]).maps[0].refused,
        together([[]], LIGHT, [1.0]).maps[0].refused,
        room._doubt(told(1.0), False, 0.02),
        room._doubt(told(1.0), True, 0.1),
        room._doubt(replace(told(1.0), aside=1.0, bent=0.0), False, 0.1),
        room._doubt(replace(told(1.0), aside=0.0, bent=1.0), False, 0.1),
        room._doubt(replace(told(1.0), aside=0.0, bent=0.0, reflectance=0.99), False, 0.1),
        "12 views of places are even",
    ],
)
def test_every_refusal_has_a_cure(why):
    found = replace(told(1.0), refused=why)
    assert why and found.cure
    assert ("gamma" in found.cure) == ("response" in why)
    assert not told(1.0).cure
