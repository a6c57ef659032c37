"""A predicted uncertainty calibrated on hidden points: what it says of known errors, and of what it cannot know."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from colons import EXACT, INDEPENDENT, colon, sequence, slam, truth
from raising import refused
from verbs import by_options

from densify.config import DensifyConfig
from densify.densified import Densified
from densify.fusion.volume import FusionConfig
from densify.judging.config import JudgeConfig
from densify.judging.doubts import calibrated_together, sigma_at
from densify.page import Gallery
from densify.pipeline import densify_submap
from lightdepth.camera import Pinhole
from lightdepth.checkpoint import load_model
from lightdepth.commands.predict import predict as predict_verb
from lightdepth.hidden_uncertainty import HiddenErrors, calibrated, read_factor
from lightdepth.models import DeclineModel
from lightdepth.parallax import ParallaxConfig
from lightdepth.prediction import read_prediction
from lightdepth.sparse_map import Keyframe, Submap
from lightdepth.triangulation import PointNoise
from lightdepth.tube.export import write_synthetic
from lightdepth.tube.tracked import smooth_field

predict = by_options(predict_verb)
COARSE = DensifyConfig(
    fusion=FusionConfig(voxels_per_distance=12.0), judge=JudgeConfig(parallax=ParallaxConfig(on=False))
)


def hidden(factor: float, noise: float = 0.0, wrong: float = 0.0, keyframes: int = 40, seed: int = 0):
    """Keyframes whose true error is smooth and `factor` times what is predicted, on a map with `noise` of its own."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(keyframes):
        place = rng.uniform(0, (1, 0.8), (150, 2))
        sigma = rng.uniform(0.05, 0.15) * np.ones(150)
        spread = rng.uniform(0.5, 2, 150)
        smooth = smooth_field(np.pad(place, ((0, 0), (0, 1))), 0.3, rng)
        error = factor * sigma * smooth + noise * spread * rng.standard_normal(150)
        error = error + (rng.random(150) < wrong) * rng.choice([-1, 1], 150) * rng.uniform(0.5, 1.5, 150)
        fold = (place[:, 0] > 0.5).astype(int) + 2 * (place[:, 1] > 0.4)
        found.append(HiddenErrors(error, sigma, 3 * spread, fold, place))
    return found


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.5])
def test_the_factor_is_that_of_the_errors_and_the_map_s_own_noise_is_taken_out(factor):
    exact, noisy = calibrated(hidden(factor)), calibrated(hidden(factor, noise=0.03))
    assert exact.ok and noisy.ok
    assert exact.factor == pytest.approx(factor, rel=0.12) and exact.noise < 0.012 * factor
    assert noisy.factor == pytest.approx(exact.factor, rel=0.1)
    assert noisy.noise == pytest.approx(0.0375, rel=0.2)
    assert np.abs(np.array(noisy.after) - (0.5, 0.68, 0.9)).max() < 0.06


def test_wrong_points_stick_out_from_their_neighbours_and_do_not_widen_it():
    clean, fouled = calibrated(hidden(1.0, noise=0.02)), calibrated(hidden(1.0, noise=0.02, wrong=0.2))
    assert fouled.factor == pytest.approx(clean.factor, rel=0.15)
    assert fouled.points < 0.88 * clean.points


def test_without_a_spread_among_points_all_are_taken_for_equally_noisy():
    unknown = [replace(k, spread=np.full(150, np.nan)) for k in hidden(2.0, noise=0.03)]
    assert calibrated(unknown).factor == pytest.approx(2.0, rel=0.15)


def test_it_says_so_where_there_are_too_few_points_or_other_blocks_say_something_else():
    few = calibrated(hidden(1.0, keyframes=1))
    assert not few.ok and few.factor == 1 and "150 hidden points" in str(few) and "not calibrated" in str(few)
    nowhere = calibrated([])
    assert not nowhere.ok and nowhere.points == 0
    patchy = [replace(k, sigma=k.sigma / np.where(k.fold == 0, 30, 1)) for k in hidden(1.0)]
    assert "other blocks" in calibrated(patchy).reason
    exact = [replace(k, error=0 * k.error) for k in hidden(1.0)]
    assert "map's own error explains" in calibrated(exact).reason


def two_views(baseline: float, distance: float, pixel_noise: float, count: int = 400) -> Submap:
    """Points straight ahead at one distance, seen by two cameras side by side with noise in the pixels."""
    rng, camera = np.random.default_rng(0), Pinhole(200, 200, 100.0, 100.0, 100.0, 100.0)
    points = np.array([0.0, 0.0, distance]) + rng.uniform(-0.2, 0.2, (count, 3)) * (1, 1, 0)
    keyframes = []
    for i, aside in enumerate((0.0, baseline)):
        pose = np.eye(4)
        pose[0, 3] = -aside
        pixels = camera.project(points + pose[:3, 3])[0]
        keyframes.append(
            Keyframe(f"{i}", camera, pose, pixels + pixel_noise * rng.standard_normal((count, 2)), np.arange(count))
        )
    return Submap(0, tuple(keyframes), np.arange(count), points)


def test_a_point_s_noise_is_that_of_triangulation():
    """Of two views a baseline b apart the distance d errs by sqrt(2) d² sigma_px / (f b)."""
    for distance in (10.0, 20.0):
        submap = two_views(1.0, distance, 0.5)
        noise = PointNoise(submap)
        # All four residuals of a point are its own here: nothing was fitted to them, and one of four counts as free.
        assert noise.sigma_px == pytest.approx(0.5 * 2, rel=0.1)
        relative = noise.along(submap.keyframes[0], submap.point_ids) / noise.sigma_px
        assert np.median(relative) == pytest.approx(np.sqrt(2) * distance / 100, rel=0.05)


def test_what_pixels_do_not_tell_is_not_known():
    submap = two_views(1.0, 10.0, 0.5)
    alone = replace(submap, keyframes=submap.keyframes[:1])
    guessed = replace(submap, weak_visibility=True)
    for each in (alone, guessed, two_views(0.0, 10.0, 0.5)):
        assert np.isnan(PointNoise(each).along(each.keyframes[0], each.point_ids)).all()
    assert np.isnan(PointNoise(submap).along(submap.keyframes[0], np.array([-5]))).all()


@pytest.fixture(scope="module")
def frames():
    return colon(0, 6, 10.0, Pinhole(160, 128, 86.0, 86.0, 80.0, 64.0)).frames


def doubting(frame):
    """True distance with a smooth error of 15 %, of which a third is admitted."""
    right = truth(frame)
    rng = np.random.default_rng(frame.number)
    rows, columns = np.mgrid[: right.distance.shape[0] : 8, : right.distance.shape[1] : 8] / 160.0
    place = np.stack([columns.ravel(), rows.ravel(), 0 * rows.ravel()], 1)
    coarse = smooth_field(place, 0.3, rng).reshape(rows.shape)
    error = np.kron(0.15 * coarse, np.ones((8, 8)))
    sigma = np.full(right.distance.shape, 0.05, np.float32)
    return replace(right, distance=(right.distance * np.exp(error)).astype(np.float32), uncertainty=sigma)


def test_densify_says_how_far_a_boastful_model_is_to_be_believed(frames):
    submap = slam(frames, config=INDEPENDENT, spurious=0.05, points_per_keyframe=200).map.submaps[0]
    judgement = densify_submap(submap, sequence(frames), doubting, COARSE).judgement
    assert judgement is not None and judgement.doubts is not None
    found = judgement.doubts.calibration
    assert 2 < found.predicted.factor < 4.5
    assert found.delivered.factor < found.predicted.factor
    assert judgement.record()["uncertainty"]["predicted"]["factor"] == found.predicted.factor
    assert calibrated_together([None, judgement.doubts]) == found
    distrusted = replace(judgement.doubts, against="the map is wrong")
    assert calibrated_together([distrusted, judgement.doubts]) == found
    assert str(calibrated_together([distrusted])) == "not calibrated: the map is wrong"


def test_a_model_that_predicts_none_has_none_to_calibrate(frames):
    submap = slam(frames, config=EXACT).map.submaps[0]
    result = densify_submap(submap, sequence(frames), truth, COARSE)
    assert result.judgement is not None and result.judgement.doubts is None
    work = Densified("truth", [result], Gallery(slam(frames).map))
    assert work.of_uncertainty == "not calibrated: truth predicts none"
    assert "nothing was judged" in Densified("truth", [replace(result, judgement=None)], work.gallery).of_uncertainty
    assert sigma_at(truth(frames[0]), np.ones((2, 2))) is None


def test_predict_takes_the_factor_of_a_run_and_of_the_same_checkpoint_only(frames, tmp_path):
    data = tmp_path / "data"
    write_synthetic(frames[:2], slam(frames), data)
    model = load_model(details=False)
    plain = model(frames[0]).uncertainty
    run = tmp_path / "run"
    run.mkdir()
    with refused(found="no uncertainty.json"):
        read_factor(run, model.name)
    (run / "uncertainty.json").write_text(json.dumps({"checkpoint": model.name, "factor": 3.0}))
    predict(data, tmp_path / "out", uncertainty=run, previews=False)
    written = read_prediction(sorted((tmp_path / "out").glob("*.npz"))[0]).uncertainty
    assert np.median(written / plain) == pytest.approx(3.0, rel=0.02)
    assert json.loads((tmp_path / "out" / "run.json").read_text())["uncertainty_factor"] == 3.0
    with refused(found=f"checkpoint {model.name}"):
        read_factor(run / "uncertainty.json", DeclineModel.name)
    (run / "uncertainty.json").write_text(json.dumps({"checkpoint": "decline", "factor": -1.0}))
    with refused(found="factor: -1"):
        read_factor(run, "decline")
    with refused("--uncertainty"):
        predict(data, tmp_path / "more", uncertainty=run, refine=2)
