"""The judge's renderer against closed forms: a sphere, the inverse square, energy; and what its colons are."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from lightdepth.judge_colons.colons import JUDGE_COLONS, JudgeColon, JudgeFrame, judge_frames
from lightdepth.judge_colons.corruption import CORRUPTIONS, SEVERITIES, corrupted
from lightdepth.judge_colons.lamps import Lamp, measured_light, vignetting
from lightdepth.judge_colons.skin import Skin
from lightdepth.judge_colons.transport import (
    Hits,
    Lit,
    Scene,
    direct,
    film_lobe,
    indirect,
    matt_lobe,
    mirrored,
    spread_over,
)
from lightdepth.judge_colons.wall import Mesh, centre_line, make_wall

RADIUS = 20.0
EVENLY = Lamp((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), power=0.0)
SMALL = JudgeColon("small", 901, 0.5, "clipped", "fisheye", 1.0, (40, 32), frames=2)


@cache
def sphere(rho: float) -> Scene:
    """The inside of a sphere that reflects rho, its film smooth."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, 91), np.linspace(0, 2 * np.pi, 181), indexing="ij")
    out = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    index = np.arange(len(out)).reshape(theta.shape)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    triangles = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    ones = np.ones((len(out), 3), np.float32)
    mesh = Mesh(
        (RADIUS * out).astype(np.float32), -out.astype(np.float32), ones[:, :2] / 2, ones, triangles.astype(np.uint32)
    )
    skin = Skin(np.full((4, 4, 3), rho, np.float32), np.zeros((4, 4, 2), np.float32), 0.25)
    return Scene(mesh, skin)


@cache
def small() -> list[JudgeFrame]:
    return judge_frames(SMALL, quality=3)


def lit(at: tuple[float, float, float]) -> Lit:
    pose = np.eye(4)
    pose[:3, 3] = at
    return Lit((EVENLY,), pose)


def around(scene: Scene, count: int) -> Hits:
    away = np.random.default_rng(0).normal(size=(count, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return scene.cast(np.zeros((count, 3)), away)


@pytest.mark.parametrize("rho", [0.5, 0.9])
@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (6.0, -3.0, 8.0)])
def test_in_a_sphere_walls_throw_back_rho_over_one_minus_rho_of_the_mean_direct_light(rho, place):
    scene, light = sphere(rho), lit(place)
    hits = around(scene, 30)
    found = indirect(scene, hits, light, np.random.default_rng(1), side=8)
    assert found.mean() == pytest.approx(rho / (1 - rho) / RADIUS**2, rel=0.04)
    assert found.std(0).max() < 0.25 * found.mean()  # alike everywhere, wherever the lamp is


def test_direct_light_falls_with_the_square_of_the_distance_and_the_cosine():
    scene, at = sphere(0.5), np.array([0.0, 0.0, 12.0])
    hits = around(scene, 200)
    off = at - hits.point
    far = np.linalg.norm(off, axis=1)
    expected = -(hits.point / RADIUS * off).sum(1) / far**3
    np.testing.assert_allclose(direct(scene, hits, lit(tuple(at))), expected, rtol=0.01)


def test_a_fold_throws_a_shadow():
    rng = np.random.default_rng(3)
    colon = make_wall(rng)
    scene = Scene(colon.mesh, sphere(0.5).skin)
    middle, axes = colon.line.at(80.0)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, middle
    hits = around_from(scene, middle, 2000)
    lamp = Lamp((3.0, 0.0, 0.0), (0.0, 0.0, 1.0), power=0.0)
    arrives, towards = Lit((lamp,), pose).falls(scene, hits, lamp)
    turned = ((towards * hits.facet).sum(1) > 0) & (arrives == 0)
    assert 0 < turned.mean() < 0.3


def around_from(scene: Scene, origin: np.ndarray, count: int) -> Hits:
    away = np.random.default_rng(0).normal(size=(count, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return scene.cast(np.broadcast_to(origin, away.shape), away)


def whole_sky(count: int) -> tuple[np.ndarray, float]:
    """Directions (n, 3) all over the half sphere about z, each of the same solid angle [sr]."""
    z = (np.arange(count) + 0.5) / count
    turn = np.pi * (1 + 5**0.5) * np.arange(count)
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], -1), 2 * np.pi / count


@pytest.mark.parametrize("roughness", [0.16, 0.3])
@pytest.mark.parametrize("degrees", [0, 40, 70, 85])
def test_a_white_wall_under_its_film_throws_back_no_more_than_falls_on_it(roughness, degrees):
    sky, angle = whole_sky(200_000)
    lens = np.broadcast_to([np.sin(np.radians(degrees)), 0, np.cos(np.radians(degrees))], sky.shape)
    normal = np.broadcast_to([0.0, 0.0, 1.0], sky.shape)
    lobes = matt_lobe(np.ones((len(sky), 1)), sky[:, 2], lens[:, 2])[:, 0], film_lobe(normal, sky, lens, roughness)
    shares = [float((lobe * sky[:, 2]).sum() * angle) for lobe in lobes]
    assert 0.3 < sum(shares) <= 1.0 and shares[1] > 0.01
    swapped = film_lobe(normal, lens, sky, roughness)
    np.testing.assert_allclose(lobes[1], swapped, atol=1e-9)


def test_what_the_film_mirrors_of_an_even_surrounding_is_its_share_of_it():
    scene, light = sphere(0.6), lit((0.0, 0.0, 0.0))
    hits = around(scene, 6000)
    lens = -hits.point / RADIUS  # straight on
    found = mirrored(scene, hits, lens.astype(np.float32), light, np.random.default_rng(2)).mean()
    sky, angle = whole_sky(200_000)
    normal = np.broadcast_to([0.0, 0.0, 1.0], sky.shape)
    share = (film_lobe(normal, sky, normal, scene.skin.roughness) * sky[:, 2]).sum() * angle
    assert found == pytest.approx(share * 0.6 / np.pi / (1 - 0.6) / RADIUS**2, rel=0.04)


def test_values_read_between_places_are_those_of_the_nearest():
    scene = sphere(0.5)
    known, asked = around(scene, 400), around_from(scene, np.array([1.0, 2.0, 0.0]), 50)
    found = spread_over(known, known.point.astype(np.float64), asked)
    assert np.abs(found - asked.point).max() < 5


def test_the_light_file_of_one_narrow_lamp_is_that_lamp():
    rays = np.stack([*np.meshgrid(np.linspace(-0.7, 0.7, 15), np.linspace(-0.6, 0.6, 13)), np.ones((13, 15))], -1)
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(-1, 3)
    light = measured_light((Lamp((2.0, 0.0, -0.5), (0.0, 0.0, 1.0), 1.0, 2.5),), rays, 0.0, 2.2)
    assert light.position_mm == (2.0, 0.0, -0.5) and 2.3 < light.mu < 3.1
    wide = measured_light((Lamp((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 1.0, 0.0),), rays, 0.0, 2.2)
    dark = measured_light((Lamp((2.0, 0.0, -0.5), (0.0, 0.0, 1.0), 1.0, 2.5),), rays, 1.0, 2.2)
    assert light.lamps is not None and light.lamps.lens_mu == 0
    assert dark.lamps is not None and dark.lamps.lens_mu == pytest.approx(dark.mu - light.mu) and dark.mu > light.mu
    assert wide.mu < 0.01 < vignetting(rays, 1.0).min()


@pytest.mark.parametrize("seed", [3])
def test_no_light_leaves_a_colon_and_its_line_never_folds(seed):
    colon = make_wall(np.random.default_rng(seed))
    scene = Scene(colon.mesh, sphere(0.5).skin)
    for s in (70.0, 120.0):
        assert around_from(scene, colon.line.at(s)[0], 3000).met.all()
    line = centre_line(np.random.default_rng(seed), 20.0)
    bend = np.linalg.norm(np.diff(line.along, axis=0), axis=1) / 0.5
    assert bend.max() < 1 / 20


def test_a_colon_is_made_the_same_twice():
    first, second = small(), judge_frames(SMALL, quality=3)
    for one, other in zip(first, second, strict=True):
        assert np.array_equal(one.frame.image, other.frame.image)
        assert np.array_equal(one.frame.true_distance, other.frame.true_distance)
        assert one.frame.light == other.frame.light


def test_the_twelve_are_six_of_either_bounce_through_every_lens_at_every_exposure():
    assert len({c.seed for c in JUDGE_COLONS}) == len({c.name for c in JUDGE_COLONS}) == 12
    assert sum(c.strong for c in JUDGE_COLONS) == 6
    assert (min(c.reflectance for c in JUDGE_COLONS), max(c.reflectance for c in JUDGE_COLONS)) == (0.1, 0.9)
    for strong in (True, False):
        chosen = [c for c in JUDGE_COLONS if c.strong == strong]
        assert {c.exposure for c in chosen} == {"dark", "even", "bright", "clipped"}
        assert {c.lens for c in chosen} == {"plain", "narrow", "barrel", "circle", "fisheye"}


def test_frames_have_distance_wherever_their_mask_shows_wall_and_walls_reflect_what_is_stated():
    made = small()
    for one in made:
        frame = one.frame
        assert frame.true_distance is not None and frame.mask is not None and 0.3 < frame.mask.mean() < 1
        assert ((frame.true_distance > 3) == frame.valid).all()
        assert frame.image[~frame.mask].max() == 0
        assert (frame.image.max(-1)[frame.mask] == 1).mean() > 0.1
    brightest = np.concatenate([o.reflectance[o.frame.valid].max(-1) for o in made])
    assert brightest.mean() == pytest.approx(0.5, abs=0.15)


def test_lamps_that_are_given_take_the_place_of_those_drawn_and_the_way_stays():
    lamp = Lamp((5.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    made = judge_frames(SMALL, quality=1, lamps=[lamp])
    for one, before in zip(made, small(), strict=True):
        assert one.frame.light.position_mm == (5.0, 0.0, 0.0) != before.frame.light.position_mm
        np.testing.assert_array_equal(one.frame.true_world_from_cam, before.frame.true_world_from_cam)
    np.testing.assert_array_equal(made[0].frame.true_distance, small()[0].frame.true_distance)


def test_the_judge_knows_nothing_of_what_trains():
    folder = Path(__file__).parents[1] / "lightdepth" / "judge_colons"
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module == "lightdepth.photometry":
                named = {alias.name for alias in node.names}
                assert named <= {"PhotometricCalibration", "MeasuredLamps"}, path.name  # what a light file holds


@pytest.mark.parametrize("corruption", CORRUPTIONS)
def test_a_frame_is_spoilt_the_same_twice_and_more_with_each_severity(corruption):
    frame = small()[0].frame
    found = [corrupted(frame, corruption, severity, np.random.default_rng(5)) for severity in SEVERITIES]
    again = corrupted(frame, corruption, 5, np.random.default_rng(5))
    assert np.array_equal(found[-1].image, again.image) and frame.mask is not None
    off = [np.abs(spoilt.image - frame.image)[frame.mask].mean() for spoilt in found]
    assert 0 <= off[0] < off[2] < off[4]  # so small an image is hardly blurred by the first
    for spoilt in found:
        assert np.array_equal(spoilt.image[~frame.mask], frame.image[~frame.mask])
        assert spoilt.image.min() >= 0 and spoilt.image.max() <= 1 and spoilt.true_distance is frame.true_distance
