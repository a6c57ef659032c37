"""Keyframes that agree: smooth errors are found from points and overlap; nearer views contradict farther ones."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from colons import EXACT, colon, slam, truth

from densify.agreement import AgreementConfig, View, agree
from densify.bending import BendingConfig
from densify.contradiction import ContradictionConfig, share_at, uncontradicted
from lightdepth.observations import observed_distances
from lightdepth.prediction import DepthPrediction
from lightdepth.robust import lmeds_scale
from lightdepth.sparse_map import covisibility

ALONE = AgreementConfig(overlap=0)
RIGID = BendingConfig(on=False)


@cache
def scene(spurious: float = 0.0):
    frames = colon(0).frames[:6]
    found = slam(frames, config=replace(EXACT, spurious=spurious), spurious=spurious)
    (submap,) = found.map.submaps
    return frames, submap, found.map_from_world[0][0], covisibility(submap)


def tilted(frame, factor: float = 1.0, tilt: float = 0.3) -> DepthPrediction:
    """Truth times a factor, with an error that grows smoothly from left to right."""
    right = truth(frame)
    across = np.linspace(-0.5, 0.5, frame.camera.width, dtype=np.float32)
    return replace(right, distance=right.distance * np.float32(factor) * np.exp(tilt * across)[None])


def views_of(predictions, start: float = 1.0, spurious: float = 0.0, points: int | None = None) -> list[View]:
    _, submap, scale, _ = scene(spurious)
    made = []
    for i, (keyframe, p) in enumerate(zip(submap.keyframes, predictions, strict=True)):
        observed = observed_distances(keyframe, submap, p)
        if points is not None and i == 2:
            observed = observed.subset(np.arange(len(observed)) < points)
        made.append(View.of(keyframe, observed, p, start * scale))
    return made


def errors(bends, predictions, spurious: float = 0.0) -> list[float]:
    """Median relative error of each bent depth map."""
    frames, _, scale, _ = scene(spurious)
    return [
        float(np.median(np.abs(bend.applied(p).distance[p.valid] / (scale * f.true_distance[p.valid]) - 1)))
        for bend, p, f in zip(bends, predictions, frames, strict=True)
    ]


@pytest.mark.parametrize("overlap", [0.0, 0.1])
@pytest.mark.parametrize("spurious", [0.0, 0.3])
def test_a_smooth_error_is_bent_away_and_one_scale_cannot(overlap, spurious):
    predictions = [tilted(f) for f in scene()[0]]
    views, shared = views_of(predictions, spurious=spurious), scene(spurious)[3]
    config = AgreementConfig(overlap=overlap)
    rigid, bent = (errors(agree(views, shared, config, b), predictions, spurious) for b in (RIGID, BendingConfig()))
    assert min(rigid) > 0.05 and max(bent) < 0.012


def test_true_depth_stays_as_it_is():
    predictions = [truth(f) for f in scene()[0]]
    bends = agree(views_of(predictions), scene()[3], AgreementConfig(), BendingConfig())
    assert max(errors(bends, predictions)) < 0.004
    assert [b.scale for b in bends] == pytest.approx([scene()[2]] * 6, rel=0.01)


def test_overlap_holds_a_keyframe_whose_few_points_cannot():
    """Keyframe 2 has eight points, all 10 % too far."""
    predictions = [truth(f) for f in scene()[0]]
    views = views_of(predictions, points=8)
    views[2] = replace(views[2], observed=replace(views[2].observed, mapped=1.1 * views[2].observed.mapped))
    alone, together = (errors(agree(views, scene()[3], c, RIGID), predictions)[2] for c in (ALONE, AgreementConfig()))
    assert alone > 0.09 and together < 0.02


def test_equal_views_give_equal_fields_and_off_keeps_the_scales():
    predictions = [tilted(f) for f in scene()[0]]
    views, shared = views_of(predictions, start=1.03), scene()[3]
    one, other = (agree(views, shared, AgreementConfig(), BendingConfig()) for _ in range(2))
    assert all(np.array_equal(a.weights, b.weights) for a, b in zip(one, other, strict=True))
    off = agree(views, shared, AgreementConfig(on=False), BendingConfig())
    assert all(b.scale == pytest.approx(1.03 * scene()[2]) and not b.weights[1:].any() for b in off)


def test_a_single_keyframe_and_a_constant_depth_are_no_trouble():
    first = replace(truth(scene()[0][0]), distance=np.ones_like(truth(scene()[0][0]).distance))
    frames, submap, scale, _ = scene()
    observed = observed_distances(submap.keyframes[0], submap, first)
    view = View.of(submap.keyframes[0], observed, first, 30 * scale)
    (bend,) = agree([view], np.array([[len(observed)]]), AgreementConfig(), BendingConfig())
    distance = bend.applied(first).distance / scale
    middle = np.median(frames[0].true_distance[first.valid])
    assert np.isfinite(distance).all() and np.median(distance[first.valid]) == pytest.approx(middle, rel=0.2)


def test_depth_with_holes_in_every_other_column_has_no_overlap_to_speak_of_and_is_no_trouble():
    predictions = [tilted(f) for f in scene()[0]]
    holes = np.arange(predictions[0].valid.shape[1]) % 2 == 1
    predictions = [replace(p, valid=p.valid & ~holes) for p in predictions]
    views = views_of(predictions)
    assert not any(len(view.grid(16)) for view in views) and all(len(view.observed) > 100 for view in views)
    bends = agree(views, scene()[3], AgreementConfig(), BendingConfig())
    assert max(errors(bends, predictions)) < 0.02


def test_what_floats_before_a_nearer_view_s_surface_is_contradicted_and_truth_is_not():
    frames, _, _, shared = scene()
    right = [truth(f) for f in frames]
    patch = np.zeros(right[0].valid.shape, bool)
    patch[34:46, 42:54] = True  # the far middle of the first image, seen better by those ahead
    wrong = replace(right[0], distance=np.where(patch, 0.6 * right[0].distance, right[0].distance))
    config, still = ContradictionConfig(), AgreementConfig(on=False)
    for first, low, high in ((right[0], 0.9, 1.0), (wrong, 0.0, 0.2)):
        views = views_of([first, *right[1:]])
        bends = agree(views, shared, still, BendingConfig())
        stays = uncontradicted(views, bends, shared, config)
        kept = [p.valid * share_at(s, p.valid.shape) for p, s in zip([first, *right[1:]], stays, strict=True)]
        assert low <= kept[0][patch].mean() <= high
        assert np.mean([k.sum() / p.valid.sum() for k, p in zip(kept, right, strict=True)]) > 0.9


def erring(points: int, spurious: float, size: float) -> tuple[list[View], list[DepthPrediction]]:
    """Views with few points of depth maps that err smoothly, each in its own way."""
    frames, submap, _, _ = scene(spurious)
    predictions, views = [], []
    for i, (keyframe, frame) in enumerate(zip(submap.keyframes, frames, strict=True)):
        right, bumps = truth(frame), np.random.default_rng(i).standard_normal((5, 6)).astype(np.float32)
        error = cv2.resize(bumps, right.distance.shape[::-1], interpolation=cv2.INTER_CUBIC)
        prediction = replace(right, distance=right.distance * np.exp(size * error))
        observed = observed_distances(keyframe, submap, prediction)
        few = observed.subset(np.random.default_rng(i).permutation(len(observed)) < points)
        views.append(View.of(keyframe, few, prediction, lmeds_scale(few.mapped, few.predicted).scale))
        predictions.append(prediction)
    return views, predictions


def test_depth_maps_that_err_each_in_its_own_way_are_not_flattened_so_that_they_agree():
    """Flat maps agree best: with few points, overlap must help and not win."""
    views, predictions = erring(30, 0.3, 0.2)
    alone, together = (agree(views, scene(0.3)[3], c, BendingConfig()) for c in (ALONE, AgreementConfig()))
    assert min(bend.weights[1] for bend in together) > -0.55  # -1 is flat
    assert np.mean(errors(together, predictions, 0.3)) < 0.9 * np.mean(errors(alone, predictions, 0.3))


@pytest.mark.parametrize(("points", "at_most"), [(40, 0.14), (400, 0.05)])
def test_nearly_half_of_the_points_being_wrong_and_too_far_does_not_pull_the_scales(points, at_most):
    views, predictions = erring(points, 0.45, 0.2)
    bends = agree(views, scene(0.45)[3], AgreementConfig(), BendingConfig())
    assert np.mean(errors(bends, predictions, 0.45)) < at_most


def test_a_fit_that_begins_at_another_one_ends_where_it_would_have_ended():
    predictions = [tilted(f) for f in scene()[0]]
    views, shared = views_of(predictions), scene()[3]
    config, coarse = AgreementConfig(rounds=12, tolerance=1e-5), BendingConfig()
    finer = coarse.with_finer()
    start = [bend.with_finer() for bend in agree(views, shared, config, coarse)]
    afresh, on = (agree(views, shared, config, finer, s) for s in (None, start))
    off = [errors(bends, predictions) for bends in (afresh, on)]
    assert max(off[0]) < 0.01 and off[1] == pytest.approx(off[0], abs=2e-3)
