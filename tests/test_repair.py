"""Maps made anew from the images of their keyframes: a SLAM's drift goes, its frame of reference and scale stay."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from raising import refused
from test_detective_real import stella_frames, stella_map
from test_sfm import HALF, PINHOLE, SCARAMUZZA, aligned, film, pose
from verbs import by_options

from densify.commands.sparse import sparse
from lightdepth.camera import CameraModel
from lightdepth.files.tum import read_tum
from lightdepth.frame import Frame
from lightdepth.maps import read_map
from lightdepth.sfm.config import SfmConfig
from lightdepth.sfm.reconstruction import sparse_map_from_frames
from lightdepth.sfm.repair import repaired_submap
from lightdepth.sparse_map import Submap
from lightdepth.tube.map_errors import MapErrors, with_errors

COUNT, FEW = 6, SfmConfig(max_features=700)


def filmed(camera: CameraModel, folder: Path) -> tuple[list[Frame], Submap]:
    """Frames of the inside of a box, and their map without an error."""
    frames = film(camera, COUNT)
    (right,) = sparse_map_from_frames(frames, folder, FEW, poses={10 + k: pose(k) for k in range(COUNT)}).submaps
    return frames, right


@pytest.fixture(scope="module")
def seen(tmp_path_factory) -> tuple[list[Frame], Submap]:
    return filmed(PINHOLE, tmp_path_factory.mktemp("repair") / "sparse")


def ate(submap: Submap) -> float:
    """Of the camera centres after a similarity, mm, RMS."""
    centers = np.array([k.center for k in submap.keyframes])
    true = np.array([pose(k.number - 10)[:3, 3] for k in submap.keyframes])
    scale, rotation, translation = aligned(centers, true)
    return float(np.sqrt(((scale * centers @ rotation.T + translation - true) ** 2).sum(1).mean()))


def off_wall(submap: Submap) -> float:
    """Median distance of the points from the walls as they are, without any alignment, mm."""
    return float(np.median(np.abs(np.abs(submap.points) - HALF).min(1)))


@pytest.mark.parametrize("camera", [PINHOLE, SCARAMUZZA], ids=lambda c: c.name)
def test_scale_and_poses_that_drifted_are_repaired_in_the_frame_and_scale_of_the_map(camera, seen, tmp_path):
    frames, right = seen if camera == PINHOLE else filmed(camera, tmp_path / "right")
    wrong = with_errors(right, MapErrors(drift=1.1, pose_drift=0.03, pose_drift_deg=1.0, points_follow=True), 0)
    new, repair = repaired_submap(wrong, frames, tmp_path / "sparse" / "0", FEW)
    assert repair.left == "" and len(new.keyframes) == COUNT
    assert ate(new) < 0.25 * ate(wrong) and ate(new) < 0.1
    assert repair.agree[1] > repair.agree[0] and repair.agree_px[1] < repair.agree_px[0] and 0 < repair.moved < 0.1
    size, middle = (lambda c: np.linalg.norm(c - c.mean(0))), (lambda c: c.mean(0))
    a, b = (np.array([k.center for k in submap.keyframes]) for submap in (wrong, new))
    assert size(b) == pytest.approx(size(a), rel=1e-6) and np.allclose(middle(a), middle(b))
    assert all(k.camera == f.camera for k, f in zip(new.keyframes, frames, strict=True))
    assert [p.name for p in (tmp_path / "sparse").iterdir()] == ["0"]
    (on_disk,) = read_map(tmp_path / "sparse").submaps
    assert len(on_disk.points) == repair.points[1] and len(on_disk.keyframes) == COUNT


def test_a_map_without_an_error_stays_where_it_is(seen, tmp_path):
    frames, right = seen
    new, repair = repaired_submap(right, frames, tmp_path / "0", FEW)
    assert len(new.keyframes) == COUNT and ate(new) < 0.1 and off_wall(new) < 0.3
    assert repair.moved < 0.005


def test_poses_in_the_wrong_order_and_even_backwards_ones_are_found_again(seen, tmp_path):
    frames, right = seen
    pairs = zip(right.keyframes, right.keyframes[::-1], strict=True)
    shuffled = [replace(k, cam_from_map=other.cam_from_map) for k, other in pairs]
    new, repair = repaired_submap(replace(right, keyframes=tuple(shuffled)), frames, tmp_path / "0", FEW)
    assert len(new.keyframes) == COUNT and ate(new) < 0.1 and repair.moved > 0.3
    back = np.diag([-1.0, 1, -1, 1])
    turned = [replace(k, cam_from_map=back @ k.cam_from_map) if k.number % 2 else k for k in right.keyframes]
    new, repair = repaired_submap(replace(right, keyframes=tuple(turned)), frames, tmp_path / "1", FEW)
    assert len(new.keyframes) == COUNT and ate(new) < 0.1 and repair.begun == "the images alone"


def test_a_map_that_its_images_do_not_hold_is_left_as_it_was_with_the_reason(seen, tmp_path):
    frames, right = seen
    plain = [replace(f, image=np.full_like(f.image, 0.5)) for f in frames]
    new, repair = repaired_submap(right, plain, tmp_path / "0", FEW)
    assert new is right and "hold 0 of 6 keyframes" in repair.left
    assert len(read_map(tmp_path / "0").submaps[0].points) == len(right.points)
    new, repair = repaired_submap(right, frames[:2], tmp_path / "1", FEW)
    assert new is right and "2 of its 6 keyframes have a frame" in repair.left


def test_poses_and_a_map_to_repair_are_not_given_together(tmp_path):
    with refused(where="--repair", found="--poses"):
        by_options(sparse)(tmp_path, tmp_path / "out", poses="truth", repair=tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["good", "unix_clock", "drifting"])
def test_a_real_slam_s_map_is_repaired(realdata: Path, tmp_path: Path, kind: str):
    """Seen: ATE .24 -> .040 mm, .26 -> .044 and .43 -> .050."""
    stella, frames = realdata / "stella", stella_frames(realdata / "stella")
    (submap,) = stella_map(stella, kind, 30, tmp_path).submaps
    seen = [k for k in submap.keyframes if k.number in frames.numbers]
    new, repair = repaired_submap(submap, [frames.of_keyframe(k) for k in seen], tmp_path / "sparse" / "0")
    times, world_from_cam = read_tum(stella / "truth" / "poses.tum")
    true = dict(zip((30 * times).round().astype(int).tolist(), world_from_cam[:, :3, 3], strict=True))
    centers, target = np.array([k.center for k in new.keyframes]), np.array([true[k.number] for k in new.keyframes])
    scale, rotation, translation = aligned(centers, target)
    error = np.sqrt(((scale * centers @ rotation.T + translation - target) ** 2).sum(1).mean())
    assert len(new.keyframes) == len(submap.keyframes) and error < 0.1, str(repair)
