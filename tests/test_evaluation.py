"""Errors against truth, with slow references, and what cannot be judged."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from colons import CAMERA, colon, sequence, slam, truth
from raising import refused
from scenes import PINHOLE, sphere
from scipy.spatial.transform import Rotation

from densify.config import DensifyConfig
from densify.dense_map import DenseMapFiles
from densify.evaluation.errors import evaluate_depth, rms_ate, surface_gap, true_cloud
from densify.evaluation.judge import judge_gap, judge_maps
from densify.evaluation.judge_depth import judge_depth
from densify.evaluation.judged_map import dense_models, read_run
from densify.evaluation.truth import read_truth
from densify.judging.config import JudgeConfig
from densify.pipeline import densify
from densify.similarity import Similarity, fit_similarity
from lightdepth.camera import Pinhole
from lightdepth.prediction import DepthPrediction

KNOWN = Similarity(0.37, Rotation.from_rotvec(0.9 * np.array([0.6, 0, 0.8])).as_matrix(), np.array([1.5, -0.7, 2.0]))


def centers(n: int = 12, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, 3)) * (5, 2, 1)


def test_a_known_similarity_is_found_again():
    source = centers()
    found = fit_similarity(source, KNOWN.apply(source))
    assert found.scale == pytest.approx(0.37, rel=1e-12)
    np.testing.assert_allclose(found.rotation, KNOWN.rotation, atol=1e-12)
    np.testing.assert_allclose(found.translation, KNOWN.translation, atol=1e-12)
    assert rms_ate(source, KNOWN.apply(source), found) < 1e-12


def test_no_similarity_nearby_fits_better_and_none_mirrors():
    rng = np.random.default_rng(1)
    source = centers()
    target = KNOWN.apply(source) * (1, 1, -1) + 0.1 * rng.normal(size=source.shape)  # mirrored: no exact answer
    found = fit_similarity(source, target)
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    best = rms_ate(source, target, found)
    for _ in range(50):
        turn = Rotation.from_rotvec(0.02 * rng.normal(size=3)).as_matrix()
        moved = 0.01 * rng.normal(size=3)
        near = Similarity(found.scale * np.exp(0.02 * rng.normal()), turn @ found.rotation, found.translation + moved)
        assert rms_ate(source, target, near) > best


def test_rms_ate_is_the_root_of_the_mean_square_distance():
    source = np.zeros((2, 3))
    target = np.array([[3.0, 0, 0], [0, 4, 0]])
    assert rms_ate(source, target, Similarity(1.0, np.eye(3), np.zeros(3))) == pytest.approx(np.sqrt(12.5))


def test_what_cannot_fix_a_similarity_is_refused():
    line = np.arange(6)[:, None] * np.array([1.0, 2, 3])
    with refused(where="poses", found="2 in common", cure="at least 3"):
        fit_similarity(centers(2), centers(2))
    with refused(where="map camera centres", found="lie on a line"):
        fit_similarity(line, centers(6))
    with refused(where="true camera centres", found="lie on a line"):
        fit_similarity(centers(6), line)
    with refused(found="or in one place"):
        fit_similarity(np.ones((5, 3)), centers(5))


def test_the_true_cloud_lies_on_the_wall_and_thins_out_evenly():
    sequence = colon(0)
    cloud = true_cloud(sequence.frames)
    assert sequence.tube.distance_to_wall(cloud).max() < 1e-2
    assert len(true_cloud(sequence.frames, 1, 0.01)) == pytest.approx(4 * len(cloud), rel=0.1)
    few = true_cloud(sequence.frames, cube=2.0)
    assert len(few) < len(cloud) / 4 and len(np.unique(np.floor(few / 2), axis=0)) == len(few)
    blind = [replace(f, true_distance=None) for f in sequence.frames]
    with refused(found="both valid true distance and a true pose"):
        true_cloud(blind)
    zero = [replace(f, true_distance=np.zeros_like(f.true_distance)) for f in sequence.frames]
    with refused(where="the truth", found="true distance"):
        true_cloud(zero)


CAMERA_SMALL = PINHOLE.resized(64, 48)


def test_depth_errors_are_of_depth_in_mm_over_what_is_valid_in_truth_and_prediction():
    scene = sphere(CAMERA_SMALL, radius=20.0)
    frame, prediction = scene.frame(), scene.prediction(scale=3.0)
    exact = evaluate_depth(prediction, frame)
    assert exact["rmse_mm_median"] < 1e-4 and exact["delta1_median"] == 1 and exact["share_of_truth"] == 1
    unaligned = evaluate_depth(prediction, frame, alignments=["none"])
    assert unaligned["abs_rel_none"] == pytest.approx(2, rel=1e-5)
    assert unaligned["medae_mm_none"] == pytest.approx(40 * np.median(CAMERA_SMALL.rays()[0][..., 2]), rel=1e-4)
    half = prediction.valid & (np.arange(64) < 32)
    assert evaluate_depth(replace(prediction, valid=half), frame)["share_of_truth"] == 0.5
    near = evaluate_depth(prediction, frame, max_depth_mm=19.0)
    assert 0 < near["pixels"] < exact["pixels"] == 64 * 48


def test_depth_that_cannot_be_judged_is_refused_with_the_reason():
    scene = sphere(CAMERA_SMALL)
    frame, prediction = scene.frame("7"), scene.prediction()
    cases = {
        "no true depth": replace(frame, true_distance=None),
        "the true depth is invalid everywhere": replace(frame, true_distance=np.zeros_like(frame.true_distance)),
        "the true depth is invalid everywhere (0, or at least 100": replace(
            frame, true_distance=frame.true_distance * 50
        ),
        "the true depth is NaN or infinite at 3072 pixels … expected 0 where": replace(
            frame, true_distance=frame.true_distance * np.nan
        ),
        "the prediction is 64x48, the truth 32x24": sphere(CAMERA_SMALL.resized(32, 24)).frame(),
    }
    for message, case in cases.items():
        with refused(message):
            evaluate_depth(prediction, case)
    with refused(found="the prediction is valid nowhere"):
        evaluate_depth(replace(prediction, valid=np.zeros_like(prediction.valid)), frame)
    holes = np.where(np.arange(64) < 2, np.nan, prediction.distance).astype(np.float32)
    with refused(found="the predicted depth is NaN or infinite at 96 pixels that are marked valid"):
        evaluate_depth(replace(prediction, distance=holes), frame)


def ball(radius: float, sim: Similarity = Similarity(1.0, np.eye(3), np.zeros(3)), id: int = 0, numbers=(0, 1)):
    """A sphere around the origin as a dense map, seen from its centre and carried away by `sim`."""
    mesh = trimesh.creation.icosphere(4, radius)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = sim.rotation, sim.apply(np.zeros((1, 3)))[0]
    return DenseMapFiles(
        id,
        sim.apply(np.asarray(mesh.vertices)),
        np.asarray(mesh.faces, int),
        np.zeros((0, 3)),
        np.zeros(0, bool),
        np.array(numbers),
        np.tile(pose, (len(numbers), 1, 1)),
        Pinhole(64, 48, 40.0, 40.0, 32.0, 24.0),
    )


def test_the_gap_to_a_larger_copy_is_by_how_much_it_is_larger():
    gap = surface_gap(ball(10.0), ball(11.0, KNOWN, 1), KNOWN, stride=4)
    assert gap.median == pytest.approx(0.1, abs=2e-3) and gap.p90 == pytest.approx(0.1, abs=2e-3)
    assert gap.both_share == 1 and gap.rays == 2 * 16 * 12
    assert surface_gap(ball(10.0), ball(10.0, KNOWN, 1), KNOWN, stride=4).p90 < 2e-3


def test_the_gap_is_seen_from_shared_keyframes_or_from_all_where_there_are_none():
    one = ball(10.0, numbers=(0, 1, 2))
    assert surface_gap(one, ball(10.0, KNOWN, 1, (2, 3)), KNOWN, 8).rays == 8 * 6
    assert surface_gap(one, ball(10.0, KNOWN, 1, (7, 8)), KNOWN, 8).rays == 3 * 8 * 6


def test_surfaces_that_no_ray_meets_both_of_have_no_gap():
    far = replace(KNOWN, translation=KNOWN.translation + 1e4)
    with refused(where="surfaces", found="no ray meets both", cure="is the Sim(3) right"):
        surface_gap(ball(10.0), ball(10.0, KNOWN, 1), far)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """Two dense maps of a colon made with true depth, with a tenth of wrong points."""
    folder = tmp_path_factory.mktemp("run")
    frames = colon(0).frames
    config = DensifyConfig(judge=JudgeConfig(on=False))
    for result in densify(sequence(frames), slam(frames, maps=2, spurious=0.1).map, truth, config):
        result.dense.write(folder / f"map_{result.dense.submap.id:03d}")
    return folder


@pytest.fixture(scope="module")
def world():
    return read_truth(sequence(colon(0).frames))


def test_maps_made_with_true_depth_are_judged_as_true(run, world):
    judged = judge_maps(dense_models(read_run(run)), world).judged
    assert [m.map_id for m in judged.maps] == [0, 1]
    for found in judged.maps:
        assert found.aligned.rms_ate_mm < 0.3
        dense, sparse, inliers = (found.clouds[name] for name in ("dense", "sparse", "sparse_inliers"))
        # Not zero: the true cloud is every second pixel of small images, a millimetre apart.
        assert dense.median_mm < 1.2 and dense.rms_mm < 3
        assert dense.to_mesh.median_mm < dense.median_mm
        assert sparse.rms_mm > 5 * inliers.rms_mm
        assert inliers.points < sparse.points
    whole, parts = judged.pooled["dense"], [m.clouds["dense"] for m in judged.maps]
    assert whole.points == sum(part.points for part in parts)
    assert whole.completeness.median_mm < min(part.completeness.median_mm for part in parts)
    assert whole.f_score["5mm"] > 0.9 and whole.f_score["1mm"] < whole.f_score["2mm"] < whole.f_score["5mm"]


def test_a_map_that_cannot_be_judged_says_why_and_the_others_are(run, world):
    first, second = dense_models(read_run(run))
    t = first.trajectory
    alone = replace(first, trajectory=replace(t, numbers=t.numbers[:2], centers=t.centers[:2], keyframe=t.keyframe[:2]))
    judged = judge_maps([alone, second], world).as_dict()
    expected = {"map": 0, "keyframes": 2, "error": "poses: 2 in common; expected at least 3: a similarity needs them"}
    assert judged["maps"][0] == expected and "dense" in judged["maps"][1]
    stranger = replace(first, trajectory=replace(t, numbers=t.numbers + 500))
    with refused(where="map 0", found="none of its frames is among the poses: it has frames 0 to 9, they"):
        judge_maps([stranger], world)
    with refused(found="none could be evaluated", cure="map 0: poses: 2 in common"):
        judge_maps([alone], world)


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with refused(found="neither map_* folders nor .npz files"):
        read_run(tmp_path)


def join(path: Path, **changes) -> Path:
    data = {"first": 0, "second": 1, "scale": 0.37, "rotation": [0.54, 0, 0.72], "translation": [1.5, -0.7, 2.0]}
    path.write_text(json.dumps({**data, **changes}))
    return path


def test_the_gap_is_read_from_a_file_with_either_rotation(tmp_path):
    maps = [ball(10.0), ball(11.0, KNOWN, 1)]
    expected = judge_gap(maps, join(tmp_path / "a.json"))
    assert expected.gap.median == pytest.approx(0.1, abs=2e-3) and (expected.first, expected.second) == (0, 1)
    as_matrix = judge_gap(maps, join(tmp_path / "b.json", rotation=KNOWN.rotation.tolist()))
    assert as_matrix.gap.median == pytest.approx(expected.gap.median, rel=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"second": 7}, "map 7 is not in the run … [0, 1]"),
        ({"scale": None}, "expected first, second, scale, rotation, translation"),
        ({"rotation": [1, 2]}, "expected first, second, scale, rotation, translation"),
        ({"translation": [1, 2]}, "expected first, second, scale, rotation, translation"),
        ({"scale": 0}, "scale 0"),
        ({"scale": float("nan")}, "scale nan"),
        ({"rotation": [[2, 0, 0], [0, 2, 0], [0, 0, 2]]}, "not a rotation and translation"),
    ],
)
def test_a_join_that_cannot_be_used_is_refused_by_name(tmp_path, changes, message):
    with refused(message, where="join.json"):
        judge_gap([ball(10.0), ball(11.0, KNOWN, 1)], join(tmp_path / "join.json", **changes))


def predictions(folder: Path, frames, scale: float = 1.0) -> Path:
    folder.mkdir()
    for frame in frames:
        truth(frame).scaled(scale).save(folder / f"{frame.name}.npz")
    return folder


def test_predictions_are_judged_frame_by_frame_and_frames_without_truth_are_skipped(tmp_path):
    frames = list(colon(0).frames[:3])
    folder = predictions(tmp_path / "p", frames, scale=0.1)
    frames[1] = replace(frames[1], true_distance=None)
    judged = judge_depth(folder, sequence(frames)).judged
    assert list(judged.frames) == ["000000", "000002"]
    assert judged.skipped == {"000001": "000001: no true depth"}
    assert judged.mean.errors["abs_rel_median"] < 1e-6 < 0.5 < judged.mean.errors["abs_rel_none"]
    assert judged.frames_judged == 2 and judged.frames_predicted == 3 and judged.predicted_unit == "up to scale"


def test_predictions_without_a_true_frame_are_refused(tmp_path):
    folder = predictions(tmp_path / "p", colon(0).frames[:3])
    with refused(found="none of its frames is among the predictions: it has frames 4 to 9, they are"):
        judge_depth(folder, sequence(colon(0).frames[4:]))
    with refused("the truth … or --common", found="1 match (frame 2), 2 do not (0, 1)"):
        judge_depth(folder, sequence(colon(0).frames[2:]))
    assert list(judge_depth(folder, sequence(colon(0).frames[2:]), common=True).judged.frames) == ["000002"]
    with refused(found="no frame has valid true depth", cure="the first reason: 000000: no true depth"):
        judge_depth(folder, sequence([replace(f, true_distance=None) for f in colon(0).frames]))


def test_a_damaged_prediction_is_refused_by_name(tmp_path):
    folder = predictions(tmp_path / "p", colon(0).frames[:1])
    file = folder / "000000.npz"
    file.write_bytes(file.read_bytes()[:400])
    with refused(where="000000.npz", found="not a prediction"):
        judge_depth(folder, sequence(colon(0).frames))


def test_a_prediction_of_another_camera_size_is_refused(tmp_path):
    small = CAMERA.resized(48, 40)
    folder = tmp_path / "p"
    folder.mkdir()
    DepthPrediction("000000", np.ones((40, 48), np.float32), np.ones((40, 48), bool), small, "x").save(
        folder / "000000.npz"
    )
    with refused(cure="predict at the size of the truth"):
        judge_depth(folder, sequence(colon(0).frames))
