"""A surface that grows with its map: what the batch makes at the end, at any time; and after loop closures too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from colons import CAMERA, colon, sequence, slam, truth
from raising import refused
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from densify.agreement import AgreementConfig
from densify.config import DensifyConfig
from densify.contradiction import ContradictionConfig
from densify.coverage import coverage
from densify.fusion.volume import FusionConfig
from densify.judging.config import JudgeConfig
from densify.live.densifier import Densifier
from densify.live.packed import PackedView, Packing, _read, _written
from densify.pipeline import densify_submap
from lightdepth.frame import Frame
from lightdepth.models import DeclineModel
from lightdepth.prediction import DepthPrediction
from lightdepth.sparse_map import Keyframe, Submap

ALONE = DensifyConfig(
    judge=JudgeConfig(on=False), agreement=AgreementConfig(on=False), contradiction=ContradictionConfig(on=False)
)
"""What needs no other keyframe: here live and batch are the same."""

DECLINE = DeclineModel(details=False)


def setting(maps: int = 1, count: int = 5, **changes):
    """Frames, submaps, and a configuration whose voxels are 1.2 mm in the first."""
    frames = colon(0, 10, 12.0).frames[:count]
    found = slam(frames, maps=maps, **changes)
    voxel = 1.2 * found.map_from_world[0][0]
    return frames, found, replace(ALONE, fusion=FusionConfig(voxel=voxel))


def points_of(submap: Submap, keyframe: Keyframe) -> np.ndarray:
    return submap.points[submap.rows_of(keyframe.point_ids)[0]]


def fed(densifier: Densifier, frames, submap: Submap, keyframes=None) -> Densifier:
    by_number = {f.number: f for f in frames}
    for keyframe in submap.keyframes if keyframes is None else keyframes:
        densifier.add_keyframe(by_number[keyframe.number], keyframe, points_of(submap, keyframe))
    return densifier


def packed_view(prediction: DepthPrediction, image: np.ndarray) -> tuple[PackedView, DepthPrediction]:
    """What is kept of a keyframe, and its prediction as it will come back."""
    packing = Packing(image)
    rounded = packing.round(prediction)
    return packing.done(), rounded


def as_kept(frame: Frame) -> tuple[Frame, DepthPrediction]:
    """A frame and its true distance as live keeps them: rounded to 16 bits, and through JPEG."""
    view, prediction = packed_view(truth(frame), frame.image)
    return replace(frame, image=view.image()), prediction


def farthest(one: np.ndarray, other: np.ndarray, voxel: float) -> float:
    """The largest distance from a vertex of either to the nearest of the other, in voxels."""
    return max(cKDTree(a).query(b)[0].max() for a, b in ((one, other), (other, one))) / voxel


def test_a_live_surface_is_the_batch_s():
    frames, found, config = setting()
    (submap,) = found.map.submaps
    live = fed(Densifier(truth, config), frames, submap).dense_map()
    kept = {f.name: as_kept(f) for f in frames}
    rounded = sequence([frame for frame, _ in kept.values()])
    batch = densify_submap(submap, rounded, lambda frame: kept[frame.name][1], config).dense
    assert [a.scale for a in live.alignments] == [a.scale for a in batch.alignments]
    assert [set(a.inlier_ids) for a in live.alignments] == [set(a.inlier_ids) for a in batch.alignments]
    for name in ("vertices", "triangles", "colors", "weights", "views"):
        assert np.array_equal(getattr(live, name), getattr(batch, name)), name
    assert len(live.vertices) > 1500 and live.voxel == batch.voxel
    assert live.contributions == batch.contributions
    assert coverage(live).record() == coverage(batch).record()
    assert all(0 < c.views <= len(frames) and c.fused_share > 0.5 for c in live.contributions.values())
    # Rounding is all that is between it and the batch's own.
    exact = densify_submap(submap, sequence(frames), truth, config).dense
    assert abs(len(exact.vertices) / len(live.vertices) - 1) < 0.01
    near = cKDTree(exact.vertices).query(live.vertices)[0] / config.fusion.voxel
    assert np.quantile(near, 0.95) < 0.05


def test_a_keyframe_s_depth_is_bent_by_its_own_points_as_in_a_submap_of_its_own():
    frames, found, config = setting()
    (submap,) = found.map.submaps
    keyframe = submap.keyframes[0]
    single = replace(submap, keyframes=(keyframe,))
    bending = replace(config, agreement=AgreementConfig())
    live = fed(Densifier(DECLINE, bending), frames, single).dense_map()
    frame = replace(frames[0], camera=keyframe.camera)
    view, rounded = packed_view(DECLINE(frame), frame.image)
    kept = sequence([replace(frame, image=view.image())])
    batch = densify_submap(single, kept, lambda _: rounded, bending).dense
    (one,), (other,) = live.alignments, batch.alignments
    assert one.bend is not None and np.array_equal(one.bend.weights, other.bend.weights)
    assert np.abs(one.bend.weights[1:]).max() > 1e-3
    assert np.array_equal(live.vertices, batch.vertices) and len(live.vertices) > 300


def test_the_surface_is_whole_at_any_time_and_only_what_changed_is_made_again():
    frames, found, config = setting()
    (submap,) = found.map.submaps
    live, kept = Densifier(truth, config), {}
    for n, keyframe in enumerate(submap.keyframes, 1):
        fed(live, frames, submap, [keyframe])
        mesh = live.mesh()
        known = {tuple(place) for place in mesh.renewed.tolist()}
        stayed = [k for k, patch in kept.items() if mesh.patches.get(k) is patch]
        assert len(known) > 0 and len(live.mesh().renewed) == 0  # nothing changes by looking
        kept = dict(mesh.patches)
        if n in (2, 4):
            now = fed(Densifier(truth, config), frames, submap, submap.keyframes[:n]).mesh().joined()
            assert len(now[0]) == len(mesh.joined()[0])
            assert farthest(now[0], mesh.joined()[0], config.fusion.voxel) < 1e-3
    assert stayed


def nudged(poses: dict[str, np.ndarray], rng: np.random.Generator, size: float) -> dict[str, np.ndarray]:
    """Poses bent away smoothly, as a loop closure does; the first stays. `size` in map units per keyframe."""
    out = {}
    axis, way = rng.normal(size=3), rng.normal(size=3)
    for i, (name, pose) in enumerate(poses.items()):
        change = np.eye(4)
        change[:3, :3] = Rotation.from_rotvec(0.01 * i * axis / np.linalg.norm(axis)).as_matrix()
        change[:3, 3] = size * i * way
        out[name] = pose @ change
    return out


@pytest.mark.parametrize("moved", [2, 5], ids=["some", "all"])
def test_after_a_loop_closure_the_surface_is_that_of_a_fresh_run(moved):
    frames, found, config = setting()
    (submap,) = found.map.submaps
    voxel = config.fusion.voxel
    live = fed(Densifier(truth, config), frames, submap)
    live.mesh()
    start = live.dense_map()
    chosen = {k.name: k.cam_from_map for k in submap.keyframes[-moved:]}
    poses = nudged(chosen, np.random.default_rng(0), 0.4 * voxel)
    assert live.update_poses(poses) == moved - 1  # the first of them stays where it was
    fresh = Densifier(truth, config)
    by_number = {f.number: f for f in frames}
    for old in submap.keyframes:
        new = replace(old, cam_from_map=poses.get(old.name, old.cam_from_map))
        points = (old.in_camera(points_of(submap, old)) - new.cam_from_map[:3, 3]) @ new.cam_from_map[:3, :3]
        fresh.add_keyframe(by_number[old.number], new, points)
    ours, theirs = live.dense_map(), fresh.dense_map()
    assert abs(len(ours.vertices) / len(theirs.vertices) - 1) < 0.002
    assert np.quantile(cKDTree(theirs.vertices).query(ours.vertices)[0], 0.999) < 0.01 * voxel
    assert farthest(ours.vertices, theirs.vertices, voxel) < 0.5
    assert farthest(start.vertices, theirs.vertices, voxel) > 1
    assert [a.scale for a in ours.alignments] == pytest.approx([a.scale for a in theirs.alignments], rel=1e-6)


def test_a_map_that_changes_its_unit_is_made_again_in_the_new_one():
    frames, found, _ = setting()
    (submap,) = found.map.submaps
    # Rounding decides on pixels whose expected error is the limit, and along a round wall many are alike: without one.
    alone = replace(ALONE, fusion=replace(ALONE.fusion, max_error=1000.0))
    live = fed(Densifier(truth, alone), frames, submap)
    before = live.dense_map()
    poses = {}
    for k in submap.keyframes:
        poses[k.name] = k.cam_from_map.copy()
        poses[k.name][:3, 3] *= 2.5
    assert live.update_poses(poses, submap.point_ids, 2.5 * submap.points) == len(frames)
    after = live.dense_map()
    assert after.voxel == pytest.approx(2.5 * before.voxel)
    assert [a.scale for a in after.alignments] == pytest.approx([2.5 * a.scale for a in before.alignments])
    assert farthest(after.vertices, 2.5 * before.vertices, after.voxel) < 0.5
    np.testing.assert_allclose(after.submap.points, 2.5 * before.submap.points)


def test_points_that_were_corrected_align_their_keyframes_anew():
    frames, found, config = setting(spurious=0.0)
    (submap,) = found.map.submaps
    live = fed(Densifier(truth, config), frames, submap)
    first = submap.keyframes[0]
    ids = first.point_ids
    points = first.center + 1.1 * (points_of(submap, first) - first.center)
    others = {a.keyframe: a.scale for a in live.alignments if not _sees(submap, a.keyframe, ids)}
    before = live.alignments[0].scale
    assert live.update_poses({}, ids, points) > 1
    assert live.alignments[0].scale == pytest.approx(1.1 * before, rel=1e-6)
    assert all(a.scale == others[a.keyframe] for a in live.alignments if a.keyframe in others)


def _sees(submap: Submap, name: str, ids: np.ndarray) -> bool:
    return any(np.isin(k.point_ids, ids).any() for k in submap.keyframes if k.name == name)


def test_a_culled_keyframe_leaves_no_trace():
    frames, found, config = setting()
    (submap,) = found.map.submaps
    live = fed(Densifier(truth, config), frames, submap)
    live.mesh()
    live.remove_keyframes([k.name for k in submap.keyframes[3:]])
    fewer = fed(Densifier(truth, config), frames, submap, submap.keyframes[:3])
    assert farthest(live.dense_map().vertices, fewer.dense_map().vertices, config.fusion.voxel) < 0.01
    assert live.kept_bytes == fewer.kept_bytes
    live.remove_keyframes([k.name for k in submap.keyframes[:3]])
    assert not live.mesh().patches and live.kept_bytes == 0


def test_a_merged_submap_comes_into_the_other_s_frame_and_unit():
    frames, found, config = setting(maps=2, count=8)
    one, two = found.map.submaps
    live = fed(Densifier(truth, config), frames, one)
    other = fed(Densifier(truth, replace(ALONE)), frames, two)
    (s1, r1, t1), (s2, r2, t2) = (found.map_from_world[i] for i in (0, 1))

    def brought(points):  # from map 1 to map 0, by way of the world
        return s1 * ((points - t2) @ r2 / s2) @ r1.T + t1

    poses = {}
    for k in two.keyframes:
        pose = np.eye(4)
        pose[:3, :3] = k.cam_from_map[:3, :3] @ r2 @ r1.T
        pose[:3, 3] = -pose[:3, :3] @ brought(k.center)
        poses[k.name] = pose
    count = live.adopt(other, poses, two.point_ids, brought(two.points))
    shared = len({k.name for k in one.keyframes} & {k.name for k in two.keyframes})
    assert count == len(two.keyframes) - shared
    dense = live.dense_map()
    scales = [a.scale for a in dense.aligned]
    assert scales == pytest.approx([s1] * len(scales), rel=0.03)
    world = (dense.vertices - t1) @ r1 / s1
    assert np.median(colon(0).tube.distance_to_wall(world)) < 0.15


def test_what_is_kept_of_a_keyframe_is_small_and_comes_back():
    frame = colon(0).frames[0]
    prediction = DeclineModel(details=True)(frame)
    sigma = np.random.default_rng(0).uniform(0.01, 1, prediction.distance.shape).astype(np.float32)
    view, back = packed_view(replace(prediction, uncertainty=sigma), frame.image)
    again = view.prediction()
    for name in ("distance", "valid", "uncertainty"):
        assert np.array_equal(getattr(again, name), getattr(back, name))
    valid = prediction.valid
    assert np.array_equal(again.valid, valid) and again.albedo is None and again.normals is None
    assert np.abs(again.distance / prediction.distance - 1)[valid].max() < 1e-4
    assert np.abs(again.uncertainty / sigma - 1)[valid].max() < 0.01
    assert np.abs(view.image() - frame.image).mean() < 0.02
    view, _ = packed_view(prediction, frame.image)
    assert view.size < 0.15 * (prediction.distance.nbytes + frame.image.nbytes)
    nothing, back = packed_view(replace(prediction, valid=np.zeros_like(valid)), frame.image)
    assert not back.valid.any() and not nothing.prediction().valid.any()


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (48, 64), (0, 5)])
def test_codes_come_back_as_they_were_however_far_they_jump(shape):
    rng = np.random.default_rng(0)
    smooth = (30000 + 200 * np.add.outer(np.arange(shape[0]), np.arange(shape[1]))).astype(np.uint16)
    jumping = rng.choice(np.array([0, 1, 127, 128, 32767, 32768, 65535], np.uint16), shape)
    for codes in (smooth, jumping, rng.integers(0, 65536, shape).astype(np.uint16)):
        back = _read(_written(codes), codes.shape)
        assert back.dtype == np.uint16 and np.array_equal(back, codes)


def test_a_keyframe_without_trust_takes_no_part_until_its_points_are_corrected():
    frames, found, config = setting(spurious=0.0)
    (submap,) = found.map.submaps
    keyframe = submap.keyframes[0]
    points = points_of(submap, keyframe)
    wrong = points * np.random.default_rng(0).uniform(0.05, 20, (len(points), 1))
    live = Densifier(truth, config)
    assert not live.add_keyframe(frames[0], keyframe, wrong).ok
    assert not live.mesh().patches
    assert live.update_poses({}, keyframe.point_ids, points) == 1
    assert live.alignments[0].ok and live.mesh().patches
    nothing = replace(submap.keyframes[1], point_ids=np.zeros(0, int), pixels=np.zeros((0, 2)))
    assert live.add_keyframe(frames[1], nothing, np.zeros((0, 3))).reason == "it observed no points of the map"


def test_an_image_may_be_an_array_of_bytes_with_the_densifier_s_light_and_mask():
    frames, found, config = setting()
    (submap,) = found.map.submaps
    frame, keyframe = frames[0], submap.keyframes[0]
    pixels = np.rint(255 * frame.image).astype(np.uint8)
    seen = []
    live = Densifier(lambda f: seen.append(f) or truth(replace(frame, mask=f.mask)), config, light=frame.light)
    live.add_keyframe(pixels, keyframe, points_of(submap, keyframe))
    assert (
        seen[0].light == frame.light and seen[0].camera == CAMERA and np.abs(seen[0].image - frame.image).max() < 0.01
    )


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda live, k, p: live.add_keyframe(colon(0).frames[0], k, p), "already there"),
        (lambda live, k, p: live.add_keyframe(colon(0).frames[1], replace(k, name="77"), p[:3]), r"points of shape"),
        (lambda live, k, p: live.add_keyframe(colon(0).frames[1], replace(k, name="77"), p * np.nan), "not finite"),
        (lambda live, k, p: live.update_poses({"other": np.eye(4)}), "keyframe other … not among the 1 of map 0"),
        (lambda live, k, p: live.update_poses({k.name: np.ones((4, 4))}), "not a rotation and translation"),
        (lambda live, k, p: live.update_poses({}, np.arange(3)), "expected both or neither"),
        (lambda live, k, p: live.update_poses({}, np.arange(3), np.zeros((2, 3))), "one for each of point_ids"),
        (lambda live, k, p: live.update_poses({}, np.arange(2), np.full((2, 3), np.inf)), "point 0 … its position"),
        (lambda live, k, p: live.remove_keyframes(["other"]), "keyframe other … not among"),
    ],
)
def test_what_does_not_fit_is_refused_and_changes_nothing(wrong, message):
    frames, found, config = setting()
    (submap,) = found.map.submaps
    live = fed(Densifier(truth, config), frames, submap, submap.keyframes[:1])
    before = live.dense_map()
    with refused(message):
        wrong(live, submap.keyframes[0], points_of(submap, submap.keyframes[0]))
    after = live.dense_map()
    assert np.array_equal(before.vertices, after.vertices) and before.alignments == after.alignments


def test_a_map_without_keyframes_has_no_surface_yet():
    live = Densifier(DeclineModel(details=False))
    assert not live.mesh().patches and [len(a) for a in live.mesh().joined()] == [0, 0, 0]
    with refused(where="map 0", found="no keyframe yet"):
        live.dense_map()
    live.warm_up(CAMERA)
    assert not live.alignments
