"""Real endoscopy: sinus frames with a COLMAP map, the same map as two submaps, a C3VD frame with true depth.

The data are not part of the project; without them these tests are skipped. The light of the sinus endoscope is unknown:
gamma=2.2,mu=0 stands for it.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from densify.agreement import AgreementConfig
from densify.config import DensifyConfig
from densify.evaluation.errors import evaluate_depth
from densify.evaluation.judge import judge_gap
from densify.evaluation.judged_map import read_run
from densify.inputs import fitted_to_frames
from densify.judging.config import JudgeConfig
from densify.pipeline import SubmapResult, densify
from lightdepth.datasets import FrameSequence, open_sequence, read_c3vd
from lightdepth.frame import Frame
from lightdepth.maps import read_map
from lightdepth.models import ConstantModel, DeclineModel
from lightdepth.sparse_map import SparseMap
from train.selecting.covisibility import SIFT_NODES, MapRules, select_by_map, select_by_matching
from train.selecting.matching import OrientationDescriptor, SiftMatcher

SINUS = "example_training_data_root/bag_1/_start_004259_end_004629_stride_25_segment_13"


@cache
def read_once(folder: Path, sparse_map: Path) -> FrameSequence:
    """The sinus frames, kept in memory; the camera is the map's."""
    mask, camera = folder / "undistorted_mask.bmp", read_map(sparse_map).submaps[0].keyframes[0].camera
    on_disk = open_sequence(folder, light="gamma=2.2,mu=0", mask=mask, map_camera=camera)

    @cache
    def load(i: int) -> Frame:
        return on_disk[i]

    return FrameSequence(on_disk.names, load, on_disk.source)


def dense_and_constant(realdata: Path, every: int) -> tuple[SubmapResult, SubmapResult]:
    """The sinus map's keyframes, so many of them, made dense by the closed form and by a constant distance."""
    map_folder = realdata / "sinus" / "derived_colmap" / "sparse_txt" / "0"
    frames = read_once(realdata / "sinus" / SINUS, map_folder)
    (submap,) = read_map(map_folder).submaps
    chosen = SparseMap((replace(submap, keyframes=submap.keyframes[::every]),), "sinus")
    fitted = fitted_to_frames(chosen, *frames.image_size())
    models = DeclineModel(details=False), ConstantModel()
    rigid = DensifyConfig(agreement=AgreementConfig(on=False))  # bent to the map, a constant would be the map's merit
    right, constant = (densify(frames, fitted, model, rigid)[0] for model in models)
    print(
        f"{len(right.dense.aligned)} of {len(right.dense.alignments)} aligned, seen {right.seen_share:.3f}, "
        f"{right.judgement.summary}; {right.judgement.verdict}"
    )
    return right, constant


@pytest.mark.parametrize("every", [3, pytest.param(1, marks=pytest.mark.slow)])
def test_the_sinus_map_becomes_a_surface_better_than_a_constant_s(realdata, every):
    """At one scale each, as a bend is the map's merit."""
    right, _ = dense_and_constant(realdata, every)
    assert len(right.dense.alignments) == -(-35 // every) and len(right.dense.aligned) >= 30 / every
    assert right.seen_share >= 0.8
    blocks = right.judgement.blocks
    assert blocks.one_scale <= 0.75 * blocks.constant_one_scale


@pytest.mark.slow
def test_two_submaps_of_the_sinus_stay_apart_and_fit_together_by_their_known_similarity(realdata, tmp_path):
    """Each has its own scale; nothing but the file says how they are related."""
    root = realdata / "sinus"
    frames = read_once(root / SINUS, root / "derived_colmap" / "sparse_txt" / "0")
    found = read_map(root / "derived_multimap")
    shared = sorted({k.number for k in found.submaps[0].keyframes} & {k.number for k in found.submaps[1].keyframes})
    assert shared == [4599, 4600, 4601, 4602]
    chosen = [replace(s, keyframes=s.keyframes[-6:] if s.id == 0 else s.keyframes[:6]) for s in found.submaps]
    fitted = fitted_to_frames(SparseMap(tuple(chosen), "sinus"), *frames.image_size())
    results = densify(frames, fitted, DeclineModel(details=False), DensifyConfig(judge=JudgeConfig(on=False)))
    for result in results:
        assert len(result.dense.aligned) == 6
        result.dense.write(tmp_path / f"map_{result.dense.submap.id:03d}")
    maps = read_run(tmp_path)
    join = {"first": 0, "second": 1, "scale": 0.37, "translation": [1.5, -0.7, 2.0]}
    join["rotation"] = (0.9 * np.array([0.6, 0, 0.8])).tolist()
    (tmp_path / "join.json").write_text(json.dumps(join))
    gap = judge_gap(maps, tmp_path / "join.json").gap
    assert gap.median < 0.02 and gap.both_share > 0.8  # seen: 0.5 %, 91 %
    (tmp_path / "join.json").write_text(json.dumps({**join, "scale": 0.37 * 1.2}))
    assert judge_gap(maps, tmp_path / "join.json").gap.median > 2 * gap.median


def test_a_real_c3vd_trajectory_is_read_the_same_from_either_order(realdata, tmp_path):
    """cecum_t1_a, 276 poses, brought back from NeRF's axes and unit: 0.199 mm a frame, a path of 54.7 mm."""
    found = json.loads((realdata / "c3vd_poses" / "c1v1" / "transforms_test.json").read_text())
    poses = np.array([frame["transform_matrix"] for frame in found["frames"]])
    numbers = [int(Path(frame["file_path"]).stem.removesuffix("_color")) for frame in found["frames"]]
    poses = poses[np.argsort(numbers)]
    poses[:, :3, :3] = poses[:, :3, :3] @ np.diag([1.0, -1, -1])
    poses[:, :3, 3] = poses[:, :3, 3] / found["scene_scale"] - np.array(found["scene_T"])[:3, 3]
    image = np.full((80, 100, 3), 99, np.uint8)
    for rows in (slice(None, 12), slice(-12, None)):
        image[rows, :12] = image[rows, -12:] = 0  # the octagon's corners: without them it looks undistorted
    read = {}
    for order in ("row by row", "column by column"):
        folder = tmp_path / order
        folder.mkdir()
        for i in range(len(poses)):
            cv2.imwrite(str(folder / f"{i}_color.png"), image)
        lines = poses if order == "row by row" else poses.transpose(0, 2, 1)
        np.savetxt(folder / "pose.txt", lines.reshape(-1, 16), delimiter=",", fmt="%.6g")  # as the data set's
        read[order] = np.array([f.true_world_from_cam for f in open_sequence(folder)])
    np.testing.assert_array_equal(read["row by row"], read["column by column"])
    np.testing.assert_allclose(read["row by row"], poses, atol=1e-3)
    steps = np.linalg.norm(np.diff(read["row by row"][:, :3, 3], axis=0), axis=1)
    assert len(poses) == 276 and abs(steps.mean() - 0.199) < 0.001 and abs(steps.sum() - 54.7) < 0.1


def test_the_closed_form_on_a_real_c3vd_frame_is_as_good_as_measured(realdata):
    (frame,) = read_c3vd(realdata / "c3vd_frame" / "c3vd_layout_derived")
    errors = evaluate_depth(DeclineModel(details=False)(frame), frame)
    assert errors["rmse_mm_median"] < 6.5 and errors["abs_rel_median"] < 0.22  # seen: 4.5 mm, 0.183
    assert errors["share_of_truth"] > 0.98
    constant = evaluate_depth(ConstantModel()(frame), frame)
    assert errors["abs_rel_median"] < 0.6 * constant["abs_rel_median"]


def test_real_frames_are_kept_and_blurred_copies_among_them_rejected(realdata):
    """Twelve sharp frames, six moved ones, twelve sharp, six out of focus, eleven sharp."""
    map_folder = realdata / "sinus" / "derived_colmap" / "sparse_txt" / "0"
    real = read_once(realdata / "sinus" / SINUS, map_folder)

    def spoilt(frame: Frame, how: str) -> Frame:
        if how == "moved":
            return replace(frame, image=cv2.blur(frame.image, (121, 1)))
        return replace(frame, image=cv2.GaussianBlur(frame.image, (0, 0), 20)) if how else frame

    shown = [(i, "") for i in range(12)] + [(i, "moved") for i in range(12, 18)]
    shown += [(i, "") for i in range(12, 24)] + [(i, "unfocused") for i in range(24, 30)]
    shown += [(i, "") for i in range(24, 35)]

    class Shown(list):
        def __getitem__(self, row):
            return spoilt(real[shown[row][0]], shown[row][1])

    names = [f"{row:06d}" for row in range(len(shown))]
    verdicts = select_by_matching(Shown(), names, OrientationDescriptor(), SiftMatcher(), SIFT_NODES)
    kept, sharp = np.array([v.kept for v in verdicts]), np.array([not how for _, how in shown])
    assert kept[sharp].mean() >= 0.9 and not kept[~sharp].any()


def test_the_real_map_vouches_for_all_of_its_frames(realdata):
    map_folder = realdata / "sinus" / "derived_colmap" / "sparse_txt" / "0"
    verdicts = select_by_map(read_once(realdata / "sinus" / SINUS, map_folder).names, read_map(map_folder), MapRules())
    assert all(v.kept for v in verdicts)
