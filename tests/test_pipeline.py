"""Frames and a sparse map in, surfaces out: exact depth gives the colon's wall, wrong points do it no harm."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from colons import CAMERA, EXACT, colon, sequence, slam, truth
from raising import refused
from scipy.spatial import cKDTree

from densify.alignment import Alignment
from densify.config import DensifyConfig
from densify.coverage import seen_share
from densify.dense_map import DenseMap
from densify.evaluation.errors import closest, true_cloud
from densify.fusion.volume import FusionConfig
from densify.inputs import fitted_to_frames
from densify.judging.config import JudgeConfig
from densify.judging.withheld import Withheld
from densify.pipeline import SubmapResult, densify, densify_submap
from densify.similarity import fit_similarity
from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.models import ConstantModel, DeclineModel
from lightdepth.observations import observed_distances
from lightdepth.sparse_map import Keyframe, SparseMap, typical_distance
from lightdepth.tube import lens

FISHEYE = lens("fisheye", 120, 96)
JUDGED = DensifyConfig(fusion=FusionConfig(voxels_per_distance=15.0))
UNJUDGED = DensifyConfig(judge=JudgeConfig(on=False))


def result_of(frames, recipe: DensifyConfig = UNJUDGED, model=truth, **slam_changes):
    found = slam(frames, **slam_changes)
    return densify(sequence(frames), found.map, model, recipe)[0], found


def off_wall_voxels(tube, result: SubmapResult, found) -> np.ndarray:
    """How far each vertex of the surface is from the true wall, in voxels."""
    scale, rotation, translation = found.map_from_world[result.dense.submap.id]
    world = (result.dense.vertices - translation) @ rotation / scale
    return tube.distance_to_wall(world) * scale / result.dense.voxel


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=lambda c: c.name)
def test_exact_depth_on_an_exact_map_gives_the_wall_to_a_tenth_of_a_voxel(camera):
    rendered = colon(0, camera=camera)
    result, found = result_of(rendered.frames, UNJUDGED, config=EXACT)
    assert len(result.dense.aligned) == len(rendered.frames)
    scale = found.map_from_world[0][0]
    assert [a.scale for a in result.dense.alignments] == pytest.approx([scale] * 10, rel=1e-3)
    off = off_wall_voxels(rendered.tube, result, found)
    assert len(off) > 5000 and np.median(off) < 0.1
    assert result.seen_share > 0.9 and result.judgement is None


def test_equal_inputs_give_equal_surfaces():
    frames = colon(0).frames
    first, second = (result_of(frames, JUDGED)[0] for _ in range(2))
    assert first.judgement == second.judgement
    assert [a.scale for a in first.dense.alignments] == [a.scale for a in second.dense.alignments]
    assert sorted(map(tuple, first.dense.vertices.round(6))) == sorted(map(tuple, second.dense.vertices.round(6)))


def with_keyframe(submap, index: int, **changes):
    keyframes = list(submap.keyframes)
    keyframes[index] = replace(keyframes[index], **changes)
    return replace(submap, keyframes=tuple(keyframes))


def reasons(result: SubmapResult) -> dict[str, str]:
    return {a.keyframe: a.reason for a in result.dense.alignments if not a.ok}


def test_a_keyframe_with_fewer_than_eight_points_is_skipped_and_says_so():
    frames = colon(0).frames
    (submap,) = slam(frames).map.submaps
    keyframe = submap.keyframes[3]
    few = with_keyframe(submap, 3, pixels=keyframe.pixels[:7], point_ids=keyframe.point_ids[:7])
    result = densify_submap(few, sequence(frames), truth, UNJUDGED)
    assert reasons(result) == {"000003.png": "7 observed points with a prediction; at least 8"}
    assert len(result.dense.aligned) == 9 and len(result.dense.triangles) > 1000


def test_a_map_whose_keyframes_all_have_too_few_points_gives_an_empty_surface_with_reasons():
    frames = colon(0).frames
    (submap,) = slam(frames).map.submaps
    keyframes = tuple(replace(k, pixels=k.pixels[:7], point_ids=k.point_ids[:7]) for k in submap.keyframes)
    result = densify_submap(replace(submap, keyframes=keyframes), sequence(frames), truth, JUDGED)
    assert len(reasons(result)) == 10 and all("at least 8" in r for r in reasons(result).values())
    assert result.dense.vertices.shape == (0, 3) and result.seen_share == 0
    assert result.judgement.verdict.colour == "red"


def test_a_keyframe_that_observed_nothing_is_skipped_and_a_map_without_observations_is_refused():
    frames = colon(0).frames
    (submap,) = slam(frames).map.submaps
    nothing = {"pixels": np.zeros((0, 2)), "point_ids": np.zeros(0, int)}
    result = densify_submap(with_keyframe(submap, 0, **nothing), sequence(frames), truth, UNJUDGED)
    assert reasons(result) == {"000000.png": "0 observed points with a prediction; at least 8"}
    blind = replace(submap, keyframes=tuple(replace(k, **nothing) for k in submap.keyframes))
    with refused(where="map 0", found="no keyframe observes any of its points"):
        densify_submap(blind, sequence(frames), truth, UNJUDGED)


def test_a_keyframe_without_a_frame_and_one_whose_frame_is_broken_are_skipped_with_the_reason():
    frames = list(colon(0).frames)
    (submap,) = slam(frames).map.submaps
    del frames[4]

    def load(i: int) -> Frame:
        if frames[i].number == 7:
            raise InputError("000007.png", "not a readable image", "copy it again")
        return frames[i]

    read = FrameSequence([f.name for f in frames], load, "the folder")
    result = densify_submap(submap, read, truth, UNJUDGED)
    assert reasons(result) == {
        "000004.png": "the folder: no frame number 4; expected the frames that the map was made from",
        "000007.png": "000007.png: not a readable image; copy it again",
    }
    assert len(result.dense.aligned) == 8


def test_a_pose_that_is_none_is_refused_before_any_work():
    (submap,) = slam(colon(0).frames).map.submaps
    with refused(where="keyframe 000000.png", found="the pose has NaN"):
        replace(submap.keyframes[0], cam_from_map=np.full((4, 4), np.nan))


def test_frames_of_another_size_than_the_map_s_camera_are_skipped_with_the_cure():
    frames = colon(0).frames
    smaller = [
        Frame(f.name, f.image[::2, ::2], CAMERA.resized(48, 40), f.light, None, None, f.true_distance[::2, ::2])
        for f in frames
    ]
    (submap,) = slam(frames).map.submaps
    result = densify_submap(submap, sequence(smaller), truth, UNJUDGED)
    assert len(reasons(result)) == 10
    assert "the image is 48x40, the camera 96x80: ratio 0.5" in reasons(result)["000000.png"]
    fitted = fitted_to_frames(SparseMap((submap,), "map"), 48, 40)
    assert not reasons(densify(sequence(smaller), fitted, truth, UNJUDGED)[0])


def test_a_map_made_at_half_size_is_fitted_with_camera_and_keypoints():
    (submap,) = slam(colon(0).frames).map.submaps
    half = replace(
        submap,
        keyframes=tuple(replace(k, camera=k.camera.resized(48, 40), pixels=k.pixels / 2) for k in submap.keyframes),
    )
    (fitted,) = fitted_to_frames(SparseMap((half,), "map"), 96, 80).submaps
    assert all(k.camera == CAMERA for k in fitted.keyframes)
    np.testing.assert_allclose(fitted.reprojection_errors(), submap.reprojection_errors(), atol=1e-9)
    other = replace(CAMERA, fx=60.0)
    assert fitted_to_frames(SparseMap((half,), "map"), 96, 80, other).submaps[0].keyframes[0].camera == other
    with refused(where="map: keyframe 000000.png", found="cropped or padded"):
        fitted_to_frames(SparseMap((half,), "map"), 96, 70)


def test_a_model_that_predicts_nothing_leaves_every_keyframe_out():
    frames = colon(0).frames

    def blind(frame: Frame):
        return replace(truth(frame), valid=np.zeros((80, 96), bool))

    result, _ = result_of(frames, model=blind)
    assert len(reasons(result)) == 10 and len(result.dense.triangles) == 0
    for reason in reasons(result).values():
        assert reason.startswith("0 observed points with a prediction; at least 8; of ")
        assert reason.endswith(" where nothing is predicted")


def test_points_behind_the_camera_are_told_and_the_other_keyframes_go_on():
    frames = colon(0).frames
    (submap,) = slam(frames).map.submaps
    about = np.diag([-1.0, 1, -1, 1])  # looks backwards
    turned = with_keyframe(submap, 3, cam_from_map=about @ submap.keyframes[3].cam_from_map)
    result = densify_submap(turned, sequence(frames), truth, UNJUDGED)
    assert list(reasons(result)) == ["000003.png"]
    count = len(submap.keyframes[3].point_ids)
    assert reasons(result)["000003.png"].endswith(f"of {count} observations {count} behind the camera")
    assert len(result.dense.aligned) == 9 and len(result.dense.triangles) > 1000


def test_observations_of_points_that_do_not_exist_are_told():
    frames = colon(0).frames
    (submap,) = slam(frames).map.submaps
    ids = submap.keyframes[3].point_ids
    result = densify_submap(
        with_keyframe(submap, 3, point_ids=ids + 10**6),
        sequence(frames),
        truth,
        UNJUDGED,
    )
    expected = f"0 observed points with a prediction; at least 8; of {len(ids)} observations {len(ids)} of points that"
    assert reasons(result)["000003.png"].startswith(expected)


@pytest.mark.parametrize("wrong", [0.0, np.nan, np.inf])
def test_predictions_that_are_no_distance_make_no_scale(wrong):
    frames = colon(0).frames

    def broken(frame: Frame):
        right = truth(frame)
        return right if frame.number != 3 else replace(right, distance=np.full_like(right.distance, wrong))

    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        result, _ = result_of(frames, model=broken)
    assert list(reasons(result)) == ["000003.png"] and len(result.dense.triangles) > 1000


def test_a_submap_of_one_keyframe_and_a_constant_depth_give_a_surface():
    frames = colon(0).frames
    (submap,) = slam(frames).map.submaps
    one = replace(submap, keyframes=submap.keyframes[:1])
    assert len(densify_submap(one, sequence(frames), truth, UNJUDGED).dense.triangles) > 500
    constant = densify_submap(submap, sequence(frames), ConstantModel(), UNJUDGED)
    assert np.isfinite(constant.dense.vertices).all()


def test_a_submap_that_cannot_be_made_says_why_and_the_others_go_on():
    frames = colon(0).frames
    found = slam(frames, maps=2).map
    nothing = {"pixels": np.zeros((0, 2)), "point_ids": np.zeros(0, int)}
    blind = replace(found.submaps[0], keyframes=tuple(replace(k, **nothing) for k in found.submaps[0].keyframes))
    first, second = densify(
        sequence(frames), SparseMap((blind, found.submaps[1]), "map"), truth, DensifyConfig(recipe="paper")
    )
    assert len(first.dense.triangles) == 0 and len(second.dense.triangles) > 1000
    assert all("no keyframe observes any of its points" in r for r in reasons(first).values())


def test_the_paper_s_recipe_crops_and_neither_bends_nor_agrees():
    frames = colon(0, camera=FISHEYE).frames
    paper, full = (result_of(frames, replace(UNJUDGED, recipe=r))[0] for r in ("paper", "full"))
    assert all(a.bend is None for a in paper.dense.alignments) and "agree" not in paper.seconds
    assert all(a.bend is not None for a in full.dense.aligned)
    assert paper.seen_share < full.seen_share
    with refused(where="recipe", found="'best'"):
        DensifyConfig(recipe="best")


def test_what_is_not_kept_between_passes_is_made_again():
    frames = colon(0).frames[:5]
    kept, again = (result_of(frames, replace(UNJUDGED, keep_mb=mb))[0] for mb in (1000, 0.3))
    np.testing.assert_array_equal(np.sort(kept.dense.vertices, 0), np.sort(again.dense.vertices, 0))


def test_every_submap_has_its_own_scale_and_every_keyframe_is_shown_once():
    frames = colon(0).frames
    found = slam(frames, maps=2)
    shown = []
    results = densify(sequence(frames), found.map, truth, UNJUDGED, lambda *view: shown.append(view))
    for result in results:
        scale = found.map_from_world[result.dense.submap.id][0]
        assert np.median([a.scale for a in result.dense.aligned]) == pytest.approx(scale, rel=0.03)
        steps = {"read", "predict", "align", "agree", "integrate", "extract", "cover", "judge"}
        assert steps == set(result.seconds)
    assert [(submap.id, aligned.keyframe.number) for submap, aligned, _ in shown] == [
        (s.id, k.number) for s in found.map.submaps for k in s.keyframes
    ]
    assert all(seen.frame and seen.prediction and aligned.observed for _, aligned, seen in shown)


def test_the_surface_reaches_no_farther_than_the_points_allow():
    frames = colon(0).frames
    near, far = (result_of(frames, replace(UNJUDGED, fusion=FusionConfig(far=f)))[0] for f in (0.6, 3.0))
    assert np.ptp(near.dense.vertices, 0).max() < np.ptp(far.dense.vertices, 0).max()
    assert near.seen_share < far.seen_share


def test_a_point_whose_ray_misses_the_surface_counts_as_infinitely_far():
    """Half of the surface cut away: the median over all is then beyond any number, that of the rays that met is not."""
    frames = colon(0).frames
    result, _ = result_of(frames, UNJUDGED, config=EXACT)
    dense, keyframe = result.dense, result.dense.submap.keyframes[0]
    observed = observed_distances(keyframe, dense.submap, truth(frames[0]))
    whole = Withheld.of(dense, [(keyframe, observed)])
    nearest = np.linalg.norm(dense.vertices[dense.triangles].mean(1) - keyframe.center, axis=1)
    cut = replace(dense, triangles=dense.triangles[nearest < np.quantile(observed.mapped, 0.2)])
    half = Withheld.of(cut, [(keyframe, observed)])
    assert whole.median < 0.02 and whole.miss < 0.1
    assert half.miss > 0.6 and np.isinf(half.median) and np.isinf(half.p90) and half.median_met < 0.05
    assert seen_share(cut, sequence(frames)) < 0.5 * seen_share(dense, sequence(frames))


def test_an_empty_surface_is_missed_by_every_point():
    frames = colon(0).frames
    (submap,) = slam(frames).map.submaps
    empty = np.zeros((0, 3))
    dense = DenseMap(submap, empty, empty.astype(int), empty, (Alignment("x"),) * 10, 1.0)
    keyframe: Keyframe = submap.keyframes[0]
    found = Withheld.of(dense, [(keyframe, observed_distances(keyframe, submap, truth(frames[0])))])
    assert found.miss == 1 and np.isinf(found.median_met)
    assert Withheld.of(dense, []) is None


def test_the_voxel_follows_the_map_s_unit():
    frames = colon(0).frames
    result, found = result_of(frames)
    (submap,) = found.map.submaps
    assert result.dense.voxel == pytest.approx(typical_distance(submap) / 52)
    given, _ = result_of(frames, replace(UNJUDGED, fusion=FusionConfig(voxel=0.25)))
    assert given.dense.voxel == 0.25


@cache
def judge_tree(seed: int) -> cKDTree:
    return cKDTree(true_cloud(colon(seed).frames, stride=1))


def rms(seed: int, spurious: float, voxel_mm: float, judged: bool) -> dict[str, float]:
    """RMS accuracy [mm] of the sparse and of the dense map, as densify/judge takes it, by the closed form's depth."""
    rendered = colon(seed)
    found = slam(rendered.frames, seed, spurious=spurious)
    fusion = FusionConfig(voxel=voxel_mm * found.map_from_world[0][0])
    config = DensifyConfig(fusion=fusion, judge=JudgeConfig(on=judged))
    dense = densify(sequence(rendered.frames), found.map, DeclineModel(details=False), config)[0].dense
    true = {f.number: f.true_world_from_cam[:3, 3] for f in rendered.frames}
    keyframes = dense.submap.keyframes
    similarity = fit_similarity(np.stack([k.center for k in keyframes]), np.stack([true[k.number] for k in keyframes]))
    clouds = {"sparse": dense.submap.points, "dense": dense.vertices}
    errors = {name: closest(similarity.apply(cloud), judge_tree(seed)) for name, cloud in clouds.items()}
    return {name: float(np.sqrt(np.mean(e**2))) for name, e in errors.items()}


def test_thirty_percent_of_wrong_points_spoil_the_sparse_map_but_not_the_dense_one():
    """The promise of the method. Same colons, same voxels, with and without wrong points.

    Seen: sparse 0.85 to 130 mm, dense 1.30 to 1.31 mm (what is left is the closed form's own error). Only on the last
    colon does the judge undo a bend, so that the other does without its seconds.
    """
    clean, spoilt = ([rms(seed, share, 1.0, judged=seed == 2) for seed in (0, 2)] for share in (0.0, 0.3))
    sparse = [np.mean([r["sparse"] for r in rows]) for rows in (clean, spoilt)]
    dense = [np.mean([r["dense"] for r in rows]) for rows in (clean, spoilt)]
    print(f"RMS accuracy, 0 % and 30 % wrong: sparse {np.round(sparse, 2)} mm, dense {np.round(dense, 2)} mm")
    print("dense by seed:", [(round(a["dense"], 2), round(b["dense"], 2)) for a, b in zip(clean, spoilt, strict=True)])
    assert sparse[1] > 5 * sparse[0]
    assert dense[1] <= 1.15 * dense[0]
