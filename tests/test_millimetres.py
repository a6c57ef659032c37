"""The scale of a map from the light that sits beside the lens, on colons whose geometry is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from raising import refused

from lightdepth.camera import Pinhole
from lightdepth.light import millimetres as room
from lightdepth.light.enclosure import Enclosure, enclosure
from lightdepth.light.looks import Look, Seen, elements, seen_places, typical_distance
from lightdepth.light.millimetres import Millimetres, millimetres
from lightdepth.light.shading import Shading, _lit, fitted
from lightdepth.photometry import MeasuredLamps, PhotometricCalibration
from lightdepth.tube import render_sequence

CAMERA = Pinhole(120, 96, 64.0, 64.0, 60.0, 48.0)
LIGHT = PhotometricCalibration(2.2, 1.5, (4.0, 1.5, 0.0), reflectance=0.05, source="given")


def looks_under(light: PhotometricCalibration, unit_mm: float = 1.0) -> list[Look]:
    """Looks at a colon in map units of so many millimetres."""
    looks = []
    for frame in render_sequence(7003, 8, CAMERA, 24.0, None, light).frames:
        pose = np.linalg.inv(frame.true_world_from_cam)
        pose[:3, 3] /= unit_mm
        looks.append(Look(CAMERA, pose, frame.image, frame.valid, frame.true_distance / unit_mm))
    return looks


@pytest.fixture(scope="module")
def looks() -> list[Look]:
    """Looks under LIGHT in map units of 2 mm."""
    return looks_under(LIGHT, 2.0)


@pytest.fixture(autouse=True)
def quick(monkeypatch) -> None:
    fine = ((0.0, 0.1, 0.3), (0.5,))
    for name, value in (("_PLACES", 600), ("_CELL", 0.25), ("_DRAWN", 40), ("_COARSE", fine), ("_FINE", fine)):
        monkeypatch.setattr(room, name, value)


def faced(distance: np.ndarray, image: np.ndarray | None = None) -> Look:
    """A look from the map's origin."""
    image = np.full((96, 120, 3), 0.5) if image is None else image
    return Look(CAMERA, np.eye(4), image, np.ones((96, 120), bool), distance)


def rays() -> np.ndarray:
    return CAMERA.rays()[0]


def test_a_slanted_plane_s_normal_is_exact_and_all_of_it_is_even():
    normal = np.array([0.3, 0.2, -np.sqrt(1 - 0.13)])
    wall = faced(-10 / (rays() @ normal)).wall()
    inner = (slice(3, -3), slice(3, -3))
    assert wall.even[inner].all()
    np.testing.assert_allclose(wall.normals[inner], np.broadcast_to(normal, wall.normals[inner].shape), atol=1e-9)


def test_the_areas_of_a_sphere_s_pixels_are_those_of_their_angles():
    wall = faced(np.full((96, 120), 10.0)).wall()
    inner = (slice(3, -3), slice(3, -3))
    np.testing.assert_allclose(wall.areas[inner], 100 * wall.angle[inner] ** 2, rtol=0.01)


def test_the_edge_of_a_fold_is_no_steep_wall_but_none_that_is_even():
    depth = np.where(np.arange(120) < 60, 10.0, 13.0)[None] / rays()[..., 2]
    wall = faced(depth).wall()
    assert not wall.even[10:-10, 58:62].any()
    assert wall.even[10:-10, 40:57].all() and wall.even[10:-10, 63:80].all()
    assert np.abs(wall.normals[wall.even][:, 2]).min() > 0.999


def test_a_white_highlight_changes_nothing_of_the_light_that_is_read():
    colour = np.broadcast_to([0.6, 0.3, 0.2], (96, 120, 3))
    shone = (colour**2.2 + 0.05) ** (1 / 2.2)  # the lamp, mirrored by a film of water
    depth = 10.0 / rays()[..., 2]
    pair = [faced(depth, colour), faced(depth, shone)]
    seen = seen_places(pair, [look.wall() for look in pair], 2.2, 200, np.random.default_rng(0))
    assert seen.log_light.shape[1] > 100
    np.testing.assert_allclose(seen.log_light[0], seen.log_light[1], atol=1e-3)


def sphere(sides: int) -> list[Look]:
    """Looks from the middle of a sphere of radius 10, in so many of six directions, that leave no gap between them."""
    lens = Pinhole(120, 100, 40.0, 40.0, 60.0, 50.0)
    turns = [np.diag([1.0, 1.0, 1.0]), np.diag([-1.0, 1.0, -1.0])]
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        ahead = np.array([x, y, 0.0])
        down = np.array([0.0, 0.0, 1.0])
        turns.append(np.stack([np.cross(down, ahead), down, ahead]))
    looks = []
    for turn in turns[:sides]:
        pose = np.eye(4)
        pose[:3, :3] = turn
        image, valid = np.broadcast_to([0.6, 0.3, 0.2], (100, 120, 3)), np.ones((100, 120), bool)
        looks.append(Look(lens, pose, image, valid, np.full((100, 120), 10.0)))
    return looks


def around(looks: list[Look], places: np.ndarray, normals: np.ndarray) -> Enclosure:
    walls, rng = [look.wall() for look in looks], np.random.default_rng(0)
    typical = typical_distance(looks)
    none = np.zeros((len(looks), len(places)))
    seen = Seen(places, normals, none[0], none, none, 0.0)
    return enclosure(looks, walls, elements(walls, 0.3 * typical), seen, typical, rng)


def evenly(found: Enclosure) -> np.ndarray:
    """Direct light of 1 on every element."""
    return np.ones((1, len(found.elements)))


def test_inside_a_sphere_each_element_lights_every_place_by_its_area():
    out = np.array([[0.0, 0.6, 0.8], [0.0, 0.0, 1.0], [0.6, 0.0, -0.8]])
    found = around(sphere(6), 10 * out, -out)
    assert found.areas.sum() == pytest.approx(400 * np.pi, rel=0.1) and found.lit.all()
    np.testing.assert_allclose(found.onto.sum(1), 1, atol=0.05)
    octant = (found.elements > 0).all(1)
    np.testing.assert_allclose(found.onto[:, octant].sum(1), 1 / 8, atol=0.06)
    # Evenly lit, all radiosity is 1 / (1 - rho), whether or not the unseen wall, of which there is none, counts.
    for unseen in (0.0, 1.0):
        np.testing.assert_allclose(found.received(0.5, unseen, evenly(found)), 1, rtol=0.15)


def test_of_a_red_wall_s_light_the_brightest_channel_s_less_the_darkest_s_is_reckoned_by_the_reflectance_of_each():
    out = np.array([[0.0, 0.6, 0.8], [0.0, 0.0, 1.0], [0.6, 0.0, -0.8]] * 4)
    looks, rho, pale = sphere(6), 0.5, 0.4
    found = around(looks, 10 * out, -out)
    # Evenly lit, a channel of reflectance r shows r / (1 - r), of which r is direct light's.
    shown = pale * (1 - rho) / (1 - pale * rho)
    none = np.zeros((6, len(out)))
    seen = Seen(10 * out, -out, none[0], none, none, shown)
    shading = Shading(np.stack([look.cam_from_map for look in looks]), seen, found, LIGHT)
    direct, source = np.ones((6, len(out))), np.ones((6, len(found.elements)))
    assert shading._pale(rho, 0.0, direct, source) == pytest.approx(pale, rel=0.1)
    right = (rho / (1 - rho) - pale * pale * rho / (1 - pale * rho)) / (1 - pale)
    assert right == pytest.approx(1.5)
    np.testing.assert_allclose(shading._from_wall(rho, 0.0, pale, source[None]), right, rtol=0.15)
    as_grey = shading._from_wall(rho, 0.0, 0.0, source[None])[0]
    np.testing.assert_allclose(as_grey, found.received(rho, 0.0, source))


def test_how_pale_the_wall_looks_is_read():
    colour = np.broadcast_to([0.6, 0.3, 0.2], (96, 120, 3))
    pair = [faced(10.0 / rays()[..., 2], colour)] * 2
    seen = seen_places(pair, [look.wall() for look in pair], 2.2, 200, np.random.default_rng(0))
    assert seen.pale == pytest.approx((0.2 / 0.6) ** 2.2, rel=1e-3)


def test_wall_that_no_look_shows_counts_as_much_as_it_is_said_to():
    out = np.array([[0.0, 0.0, 1.0], [0.0, 0.6, 0.8]])
    found = around(sphere(1), 10 * out, -out)
    open_, half, closed = (found.received(0.5, unseen, evenly(found)) for unseen in (0.0, 0.5, 1.0))
    assert (open_ < 0.35).all() and (open_ < half).all() and (half < closed).all()
    np.testing.assert_allclose(closed, 1, rtol=1e-6)


def test_wall_behind_other_wall_is_in_the_shadow():
    beyond = np.eye(4)
    beyond[2, 3] = -11.0  # stands behind the plate that the first look sees
    looks = [faced(10.0 / rays()[..., 2]), replace(faced(9.0 / rays()[..., 2]), cam_from_map=beyond)]
    found = around(looks, np.array([[0.0, 0.0, 10.0]]), np.array([[0.0, 0.0, -1.0]]))
    far = found.elements[:, 2] > 15
    assert far.any() and not found.lit[0, far].any() and found.lit[1, far].all() and found.lit[0, ~far].all()


def test_the_light_s_offset_tells_the_millimetres_of_a_map_unit(looks):
    found = millimetres(looks, LIGHT, near=2.5)
    assert found.mm_per_unit == pytest.approx(2.0, rel=0.1) and not found.refused
    assert 0 < found.deviation < 0.25 and found.views > 500
    low, high = found.interval
    assert low < 2.0 < high and low * high == pytest.approx(found.mm_per_unit**2)


def test_an_interval_is_wider_the_more_light_may_come_from_wall_that_no_look_shows(looks, monkeypatch):
    monkeypatch.setattr(room, "_FINE", ((0.3,), (0.5,)))
    wide = millimetres(looks, LIGHT, near=2.5)
    monkeypatch.setattr(room, "_BETWEEN", 0.0)
    narrow = millimetres(looks, LIGHT, near=2.5)
    assert wide.reflectance == 0.3 and wide.mm_per_unit == narrow.mm_per_unit
    assert wide.deviation**2 - narrow.deviation**2 == pytest.approx((0.28 * 0.3) ** 2)


def test_a_search_that_ends_where_its_finer_scales_end_goes_on_from_there(looks, monkeypatch):
    right = millimetres(looks, LIGHT, near=2.5)
    monkeypatch.setattr(room, "_profiles", misled := Misled(room._profiles))
    found = millimetres(looks, LIGHT, near=2.5)
    assert misled.calls > 2 and not found.refused
    assert found.mm_per_unit == pytest.approx(right.mm_per_unit, rel=0.05)


class Misled:
    """Profiles of which the first, over coarse scales, has its least three steps too far."""

    def __init__(self, profiles) -> None:
        self.profiles, self.calls = profiles, 0

    def __call__(self, costs):
        self.calls += 1
        found = self.profiles(costs)
        return found if self.calls > 1 else [np.roll(profile, 3) for profile in found]


def test_what_a_board_says_of_the_lens_s_share_of_mu_is_taken_and_the_interval_is_no_wider_for_it():
    own, dark = 2.0, np.exp(-2.0 * (1 - rays()[..., 2:]))  # the lens darkens to its side, wherever the lamp sits
    looks = [replace(look, image=(look.image**2.2 * dark) ** (1 / 2.2)) for look in looks_under(LIGHT, 2.0)]
    light = replace(LIGHT, mu=LIGHT.mu + own)
    measured = MeasuredLamps((LIGHT.position_mm,), (1.0,), (0.1, 0.1, 0.1), own)
    known = millimetres(looks, replace(light, lamps=measured), near=2.5)
    unsaid = millimetres(looks, light, near=2.5)
    none_of_it = millimetres(looks, replace(light, lamps=replace(measured, lens_mu=0.0)), near=2.5)
    assert known.mm_per_unit == pytest.approx(2.0, rel=0.1) and not known.refused
    assert unsaid.mm_per_unit == pytest.approx(none_of_it.mm_per_unit) and unsaid.deviation > none_of_it.deviation
    assert abs(np.log(known.mm_per_unit / 2)) < abs(np.log(none_of_it.mm_per_unit / 2))


def test_each_of_several_lamps_lights_from_its_own_place():
    sides = ((4.0, 1.5, 0.0), (-4.0, 1.5, 0.0))
    lamps = MeasuredLamps(sides, (0.25, 0.75), (0.1, 0.1, 0.1))
    light = replace(LIGHT, position_mm=(-2.0, 1.5, 0.0), lamps=lamps)
    at, turned = np.array([[1.0, 2.0, 20.0], [-5.0, 0.0, 15.0]]), np.array([[0.0, 0.0, -1.0], [0.6, 0.0, -0.8]])
    both = _lit(at, turned, np.eye(4), light, 2.0, 0.0)
    each = [_lit(at, turned, np.eye(4), replace(LIGHT, position_mm=place), 2.0, 0.0) for place in sides]
    np.testing.assert_allclose(both, 0.25 * each[0] + 0.75 * each[1])


def test_an_offset_too_small_to_be_seen_tells_nothing():
    light = replace(LIGHT, position_mm=(0.1, 0.0, 0.0))
    found = millimetres(looks_under(light), light)
    assert found.refused.startswith("the light's offset is 0.")


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        (replace(LIGHT, position_mm=(-1.5, 4.0, 0.0)), "the light shines from elsewhere"),
        (replace(LIGHT, gamma=1.4), "the response does not fit"),
        (replace(LIGHT, source="assumed"), "nobody gave the light"),
        (replace(LIGHT, position_mm=(0.0, 0.0, 0.0)), "the light is said to sit in the camera"),
    ],
)
def test_another_endoscope_s_light_or_none_tells_nothing_and_why(looks, wrong, why):
    assert millimetres(looks, wrong, near=2.0).refused.startswith(why)


def test_what_shows_nothing_is_refused_with_how_much_is_needed():
    white = faced(np.ones((96, 120)), np.ones((96, 120, 3)))
    assert millimetres([white] * 3, LIGHT).refused.startswith("0 views of places are even")
    nothing = faced(np.zeros((96, 120)))
    assert millimetres([white, white, nothing], LIGHT).refused.startswith("0 views of places are even")
    with refused(where="the looks", found="2 of them"):
        millimetres([white] * 2, LIGHT)


@pytest.mark.parametrize(
    ("aside", "bent", "share", "why"),
    [
        (0.0, 0.0, 0.02, "the light's offset is 2.0% of the distance, of 3% needed"),
        (1.0, 0.0, 0.1, "the light shines from elsewhere: the images put it 45 degrees around the axis from its place"),
        (0.0, 1.0, 0.1, "the response does not fit: the images' gamma is 0.50 times the light's"),
    ],
)
def test_each_doubt_says_its_own_figure(aside, bent, share, why):
    assert room._doubt(Millimetres(1.0, 0.1, 0.1, 999, "", aside, bent), False, share) == why


def test_a_wall_as_bright_as_any_that_is_tried_is_refused():
    why = "a wall of reflectance 0.3 or more, or another response: the images do not say which"
    assert room._doubt(Millimetres(1.0, 0.1, 0.3, 999, "", 0.0, 0.0), False, 0.1) == why


def test_a_wall_that_may_be_another_response_is_refused_unless_the_response_was_measured(monkeypatch):
    monkeypatch.setattr(room, "_FINE", ((0.0, 0.4, 0.7), (0.5,)))
    bright, as_any = (Millimetres(1.0, 0.1, rho, 999, "", 0.0, 0.0) for rho in (0.4, 0.7))
    assert room._doubt(bright, False, 0.1).startswith("a wall of reflectance 0.4 or more, or another response")
    assert room._doubt(bright, False, 0.1, measured=True) == ""
    assert room._doubt(as_any, False, 0.1, measured=True).startswith("a wall of reflectance 0.7 or more")


def test_a_cost_that_is_flat_is_refused_and_one_that_is_not_is_told():
    told = Millimetres(1.0, 0.1, 0.1, 999, "", 0.0, 0.0)
    flat = "shading hardly changes with the scale: the light's offset is 10.0% of the distance"
    assert room._doubt(told, True, 0.1) == flat and room._doubt(told, False, 0.1) == ""


def test_factors_of_columns_are_found_beside_gains_and_albedos_under_outliers():
    rng = np.random.default_rng(0)
    column, known = rng.normal(size=(6, 80)), rng.random((6, 80)) < 0.8
    left = 0.3 * column + rng.normal(size=(6, 1)) + rng.normal(size=80) + 0.01 * rng.normal(size=(6, 80))
    left[0, :8] += 1.0
    residual, (factor,) = fitted(np.where(known, left, 0), known, np.full((6, 80), 0.01), [column])
    assert factor == pytest.approx(0.3, abs=0.01) and np.abs(residual[known]).max() > 20
