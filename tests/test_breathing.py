from __future__ import annotations

import numpy as np
import pytest
from colons import CAMERA, SMALL, colon, in_world, slam
from raising import refused

from lightdepth.tube import render_sequence
from lightdepth.tube.breathing import Breathing, BreathingConfig
from lightdepth.tube.slam import SlamConfig, simulate_slam

SLOW = BreathingConfig(amplitude=0.1, period=0.4)  # 12 frames


def test_a_wall_at_rest_gives_the_frames_of_one_that_does_not_breathe():
    still = render_sequence(0, 2, CAMERA, 3.0, SMALL, breathing=BreathingConfig())
    assert still.breathing is None
    for one, other in zip(still.frames, render_sequence(0, 2, CAMERA, 3.0, SMALL).frames, strict=True):
        assert np.array_equal(one.image, other.image) and np.array_equal(one.true_distance, other.true_distance)


def test_a_breath_moves_the_wall_by_its_amplitude_and_truth_with_it():
    made, still = render_sequence(0, 4, CAMERA, 4.0, SMALL, breathing=SLOW), colon(0, 4, 4.0)
    for number in (0, 3):  # at rest, and a quarter of a period later
        moved, rest = made.frames[number].true_distance, still.frames[number].true_distance
        seen = (moved > 0) & (rest > 0)
        assert np.median(moved[seen] / rest[seen]) == pytest.approx(1.1 if number else 1.0, abs=0.03)
    shape = made.breathing.shape_at(0.1)
    assert shape.radius == pytest.approx(1.1 * made.tube.shape.radius)


def test_waves_run_along_the_colon():
    breathing = Breathing(colon(0).tube.shape, BreathingConfig(0.2, 4.0, 40.0))
    s = np.arange(0, 80.0)
    crest = [s[:40][breathing.factor(s[:40], t).argmax()] for t in (1.0, 2.0)]
    assert crest[1] - crest[0] in (10, -30) and breathing.factor(s, 0.0).min() == pytest.approx(0.8, abs=0.01)


def test_points_come_back_to_rest():
    breathing = Breathing(colon(0).tube.shape, BreathingConfig(0.2, 4.0, 40.0))
    points = colon(0).tube.shape.vertices[10:40].reshape(-1, 3)
    moved = breathing.at(points, 0.7)
    assert np.abs(moved - points).max() > 1
    assert np.quantile(np.abs(breathing.at_rest(moved, 0.7) - points), 0.95) < 0.1


def test_a_map_of_a_breathing_colon_has_its_points_between_where_the_keyframes_saw_them():
    made = render_sequence(0, 8, CAMERA, 8.0, SMALL, breathing=SLOW)
    config = SlamConfig(
        keyframe_every=1, maps=1, points_per_keyframe=300, spurious=0.0, point_noise=0.0, drift=0.0, pixel_noise=0.0
    )
    found = simulate_slam(made.frames, config, 0, made.breathing)
    (submap,) = found.map.submaps
    assert len(submap.points) > 200
    off = made.tube.distance_to_wall(in_world(found, submap)) / made.tube.shape.radius.mean()
    assert 0.02 < np.median(off) < 0.12
    assert np.median(submap.reprojection_errors()) > 0.2  # no rigid map explains all images
    still = slam(colon(0, 8, 8.0).frames, config=config)
    assert np.median(still.map.submaps[0].reprojection_errors()) < 0.2


def test_what_cannot_breathe_is_refused():
    for changes in ({"amplitude": 0.5}, {"period": 0.0}, {"wavelength_mm": -1.0}):
        with refused(where="BreathingConfig."):
            BreathingConfig(**changes)
    breathing = Breathing(colon(0).tube.shape, SLOW)
    with refused(where="--breathing.amplitude", cure="--slam.kind tracked"):
        simulate_slam(colon(0).frames, SlamConfig("independent"), 0, breathing)
