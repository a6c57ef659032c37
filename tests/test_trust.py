"""The error that is expected of a surface, on colons where all keyframes err together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from colons import colon, sequence, slam, truth
from scipy.stats import spearmanr

from densify.alignment import Alignment
from densify.config import DensifyConfig
from densify.coverage import CoverageConfig, seen_well
from densify.dense_map import DenseMap, read_dense_map
from densify.judging.config import JudgeConfig
from densify.judging.images import Seen
from densify.pipeline import densify
from densify.trust import coarse_sigma, expected_error
from lightdepth.observations import ObservedDistances
from lightdepth.sparse_map import Submap

FRAMES = colon(3).frames
DOME_MM = 30.0
MAP = slam(FRAMES, 3, spurious=0.2)


def domed(frame):
    """A model that closes the lumen: nothing is farther than some 30 mm, in every frame alike."""
    right = truth(frame)
    flat = DOME_MM * np.tanh((right.distance / DOME_MM) ** 4) ** 0.25
    return replace(right, distance=flat.astype(np.float32), uncertainty=np.full_like(right.distance, 0.1))


@pytest.fixture(scope="module")
def dense() -> DenseMap:
    return densify(sequence(FRAMES), MAP.map, domed, DensifyConfig(judge=JudgeConfig(on=False)))[0].dense


@pytest.fixture(scope="module")
def off(dense) -> np.ndarray:
    scale, rotation, translation = MAP.map_from_world[0]
    result: np.ndarray = colon(3).tube.distance_to_wall((dense.vertices - translation) @ rotation / scale)
    return result


def sigmas(value: float) -> dict[str, np.ndarray]:
    return {k.name: np.full((10, 12), value, np.float16) for k in MAP.map.submaps[0].keyframes}


def test_a_dome_that_every_keyframe_sees_is_not_seen_well(dense, off):
    dome = off > 2
    by_looks = seen_well(replace(dense, expected_error=None))
    well = seen_well(dense)
    order = spearmanr(dense.confidence, off)[0]
    shares = [[x[w].mean() for x in (by_looks, well)] for w in (dome, ~dome)]
    print(f"dome {dome.mean():.2f} of the wall; well by looks, and now: {np.round(shares, 2)}; order {order:.2f}")
    assert dome.mean() > 0.05 and by_looks[dome].mean() > 0.9
    assert well[dome].mean() < 0.05 and well[~dome].mean() > 0.3 and order < -0.4


def test_most_vertices_are_off_by_less_than_is_expected(dense, off):
    assert 0.5 < (off * MAP.map_from_world[0][0] < dense.expected_error).mean() < 0.9


def test_a_model_that_says_it_is_unsure_makes_the_surface_less_trusted(dense):
    sure, middle, unsure = (expected_error(dense, sigmas(s)) for s in (0.02, 0.1, 0.5))
    assert (sure <= middle).all() and (middle <= unsure).all() and np.median(unsure) > 1.5 * np.median(sure)
    np.testing.assert_allclose(expected_error(dense, {}), middle, rtol=1e-3)  # what a model without a word is taken for


def test_wall_beside_points_that_the_surface_does_not_meet_is_trusted_less(dense):
    """Points of one half of the map are moved away from the cameras, as when one side of the wall has drifted."""
    submap = dense.submap
    side = submap.points[:, 0] > np.median(submap.points[:, 0])
    moved = np.where(side[:, None], submap.points * 1.2, submap.points)
    drifted = replace(dense, submap=Submap(submap.id, submap.keyframes, submap.point_ids, moved))
    ratio = expected_error(drifted, {}) / expected_error(dense, {})
    there = dense.vertices[:, 0] > np.quantile(submap.points[:, 0], 0.75)
    elsewhere = dense.vertices[:, 0] < np.quantile(submap.points[:, 0], 0.25)
    assert np.median(ratio[there]) > 1.5 and np.median(ratio[elsewhere]) == pytest.approx(1, abs=0.1)


def told(dense: DenseMap, farther: float, pixels: int = 40) -> dict[str, Seen]:
    """What images would tell whose parallax puts the wall as far as the surface, and `farther` times as far where x is
    above the middle of the map."""
    found = {}
    rng = np.random.default_rng(0)
    for k in dense.submap.keyframes:
        at = rng.uniform(0, 1, (pixels, 2)) * (k.camera.width, k.camera.height)
        rays, valid = k.camera.unproject(at)
        hit = dense.surface.cast(k.center, rays @ k.cam_from_map[:3, :3])
        far = (k.center + np.where(np.isfinite(hit), hit, 0)[:, None] * (rays @ k.cam_from_map[:3, :3]))[:, 0]
        mapped = np.where(far > np.median(dense.submap.points[:, 0]), farther, 1.0) * hit
        seen = ObservedDistances(np.arange(pixels), mapped, hit, at, rays).subset(valid & np.isfinite(hit))
        half = np.arange(len(seen)) % 2 == 0
        found[k.name] = Seen(seen.subset(half), seen.subset(~half))
    return found


def test_wall_that_the_images_put_elsewhere_is_trusted_less(dense):
    agreed, moved = (expected_error(dense, {}, told(dense, factor)) for factor in (1.0, 1.2))
    there = dense.vertices[:, 0] > np.quantile(dense.submap.points[:, 0], 0.75)
    elsewhere = dense.vertices[:, 0] < np.quantile(dense.submap.points[:, 0], 0.25)
    assert np.median((moved / agreed)[there]) > 1.5
    assert np.median((moved / agreed)[elsewhere]) == pytest.approx(1, abs=0.1)


def test_a_few_pixels_of_the_images_are_not_asked(dense):
    np.testing.assert_array_equal(expected_error(dense, {}, told(dense, 1.2, 2)), expected_error(dense, {}))


def test_a_unit_changes_lengths_and_no_confidence(dense):
    submap = dense.submap
    keyframes = []
    for k in submap.keyframes:
        pose = k.cam_from_map.copy()
        pose[:3, 3] *= 3
        keyframes.append(replace(k, cam_from_map=pose))
    larger = replace(
        dense,
        submap=Submap(submap.id, tuple(keyframes), submap.point_ids, 3 * submap.points),
        vertices=3 * dense.vertices,
        voxel=3 * dense.voxel,
        alignments=tuple(replace(a, range_90=3 * a.range_90) for a in dense.alignments),
    )
    small, large = (replace(d, expected_error=expected_error(d, {})) for d in (dense, larger))
    assert np.median(np.abs(large.confidence - small.confidence)) < 0.01  # a vertex may fall into another cell
    assert np.median(large.expected_error / small.expected_error) == pytest.approx(3, rel=0.02)


def test_more_error_is_let_pass_where_told(dense):
    shares = [seen_well(dense, CoverageConfig(error=e)).mean() for e in (0.0, 0.02, 0.03, 1e9)]
    assert shares == sorted(shares) and shares[0] == 0 and len(set(shares)) == 4


def test_without_a_map_or_a_surface_nothing_is_expected_and_weights_speak(dense):
    lost = replace(dense, alignments=tuple(Alignment(a.keyframe, reason="lost") for a in dense.alignments))
    assert expected_error(lost, {}) is None
    assert expected_error(DenseMap.empty(dense.submap, "nothing"), {}) is None
    np.testing.assert_allclose(replace(dense, expected_error=None).confidence, dense.weights / (1 + dense.weights))


def test_what_is_expected_is_in_the_ply_in_its_unit(dense, tmp_path):
    dense.write(tmp_path / "map_000", mm_per_unit=2.0)
    read = read_dense_map(tmp_path / "map_000")
    np.testing.assert_allclose(read.expected_error, 2 * dense.expected_error, rtol=1e-5)


def test_uncertainty_is_kept_coarsely_and_not_where_it_means_nothing():
    found = domed(FRAMES[0])
    coarse = coarse_sigma(found)
    assert coarse.shape == (10, 12) and coarse.dtype == np.float16
    np.testing.assert_array_equal(np.isnan(coarse), ~found.valid[4::8, 4::8])
    assert coarse_sigma(truth(FRAMES[0])) is None
