"""Poses that contradict the images are told by them, before distances are measured by parallax."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from colons import colon, slam, truth

from lightdepth.camera import Pinhole
from lightdepth.parallax import Look, ParallaxConfig, guessed, measured
from lightdepth.relative_pose import Tracks, as_the_images_say, fitted, pixels_per_radian
from lightdepth.sparse_map import Keyframe, Submap

CAMERA = Pinhole(160, 128, 86.0, 86.0, 80.0, 64.0)
CONFIG = ParallaxConfig()


@pytest.fixture(scope="module")
def frames():
    return colon(0, 6, 10.0, CAMERA).frames


@pytest.fixture(scope="module")
def submap(frames) -> Submap:
    return slam(frames, spurious=0.05, points_per_keyframe=120).map.submaps[0]


def look_at(frames, keyframe: Keyframe) -> Look:
    return Look.of(keyframe, frames[keyframe.number], CONFIG.width)


def turned(look: Look, degrees: float) -> Look:
    """As if the map had it looking a little higher."""
    off = np.eye(4)
    off[:3, :3] = cv2.Rodrigues(np.radians([degrees, 0.0, 0.0]))[0]
    return replace(look, keyframe=replace(look.keyframe, cam_from_map=off @ look.keyframe.cam_from_map))


def degrees_between(a: Look, b: Look) -> float:
    turn = a.keyframe.cam_from_map[:3, :3] @ b.keyframe.cam_from_map[:3, :3].T
    return float(np.degrees(np.linalg.norm(cv2.Rodrigues(turn)[0])))


def test_a_pose_that_agrees_with_the_images_stays_as_the_map_has_it(frames, submap):
    look, other = (look_at(frames, submap.keyframes[i]) for i in (0, 2))
    assert as_the_images_say(look, other, guessed(look.keyframe, submap), CONFIG) is other


def test_a_pose_that_is_turned_comes_back_and_so_do_the_distances(frames, submap):
    look, other = (look_at(frames, submap.keyframes[i]) for i in (0, 2))
    wrong, guess = turned(other, 2.0), guessed(look.keyframe, submap)
    mended = as_the_images_say(look, wrong, guess, CONFIG)
    assert degrees_between(mended, other) < 0.6
    step = [np.linalg.norm(look.keyframe.in_camera(x.keyframe.center[None])) for x in (wrong, mended)]
    assert step[0] == pytest.approx(step[1])
    right = truth(frames[look.keyframe.number])

    def error(beside: Look) -> float:
        told = measured(look, [beside], guess, right, CONFIG)
        off = np.log(told.mapped / told.predicted)  # the map has its own scale
        return float(np.median(np.abs(off - np.median(off)))) if len(told) > 20 else float("inf")

    assert error(mended) < 0.6 * error(wrong)


def test_the_option_decides_from_how_far_off_on_the_map_is_overruled(frames, submap):
    look, other = (look_at(frames, submap.keyframes[i]) for i in (0, 2))
    wrong = turned(other, 2.0)
    patient = replace(CONFIG, off_line=20.0)
    assert as_the_images_say(look, wrong, guessed(look.keyframe, submap), patient) is wrong


def test_white_frames_and_keyframes_on_one_spot_change_nothing(frames, submap):
    look = look_at(frames, submap.keyframes[0])
    guess = guessed(look.keyframe, submap)
    white = [replace(look_at(frames, k), brightness=np.zeros_like(look.brightness)) for k in submap.keyframes[:3]]
    wrong = turned(white[2], 2.0)
    assert as_the_images_say(white[0], wrong, guess, CONFIG) is wrong
    assert as_the_images_say(look, look, guess, CONFIG) is look


def test_tracks_that_no_pose_explains_overrule_nothing(frames, submap, monkeypatch):
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(2, 300, 3)) + (0, 0, 3)
    noise = Tracks(*(rays / np.linalg.norm(rays, axis=2)[..., None]))
    monkeypatch.setattr("lightdepth.relative_pose.tracked", lambda *_: noise)
    look, other = (look_at(frames, submap.keyframes[i]) for i in (0, 2))
    assert as_the_images_say(look, other, guessed(look.keyframe, submap), CONFIG) is other


def test_an_image_of_another_size_is_not_tracked_into(frames, submap):
    look = look_at(frames, submap.keyframes[0])
    smaller = Look.of(submap.keyframes[2], frames[submap.keyframes[2].number], 80)
    assert smaller.usable.shape != look.usable.shape
    wrong = turned(smaller, 2.0)
    assert as_the_images_say(look, wrong, guessed(look.keyframe, submap), CONFIG) is wrong


def test_the_fit_finds_turn_and_direction_with_a_tenth_of_the_tracks_wrong():
    rng = np.random.default_rng(3)
    there_from_here = np.eye(4)
    there_from_here[:3, :3] = cv2.Rodrigues(np.radians([0.5, -0.8, 0.3]))[0]
    there_from_here[:3, 3] = [1.0, 0.2, -2.0]
    points = rng.uniform((-15, -12, 10), (15, 12, 40), (200, 3))
    there = points @ there_from_here[:3, :3].T + there_from_here[:3, 3]
    here, there = (p / np.linalg.norm(p, axis=1)[:, None] for p in (points, there))
    there[:20] = there[rng.permutation(200)[:20]]
    start = np.eye(4)
    start[:3, 3] = [1.1, 0.2, -1.95]
    tracks = Tracks(here, there)
    found = fitted(tracks, start, 0.2 / 86)
    assert np.median(np.abs(tracks.off_lines(found))) < 0.2 * np.median(np.abs(tracks.off_lines(start)))
    off = np.degrees(np.linalg.norm(cv2.Rodrigues(found[:3, :3] @ there_from_here[:3, :3].T)[0]))
    assert off < 0.1
    assert np.linalg.norm(found[:3, 3]) == pytest.approx(np.linalg.norm(start[:3, 3]))


def test_pixels_per_radian_is_the_focal_length_in_the_middle():
    assert pixels_per_radian(CAMERA) == pytest.approx(86.0, rel=1e-3)
