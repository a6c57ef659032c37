"""Structure from motion on the inside of a textured box, whose walls are known exactly."""

import csv
import logging
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from colons import sequence
from raising import refused

from lightdepth.camera import CameraModel, KannalaBrandt, Pinhole, Scaramuzza
from lightdepth.datasets import FrameSequence, write_folder
from lightdepth.datasets.reading import image_files
from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.maps import read_map
from lightdepth.sfm.config import SfmConfig
from lightdepth.sfm.features import evened, far_matches, features_and_matches, usable_pixels, write_images
from lightdepth.sfm.known_poses import fitting_poses
from lightdepth.sfm.reconstruction import fisheye_fit, sparse_map_from_frames

HALF = np.array([22.0, 18.0, 45.0])  # the box reaches from -HALF to HALF, in mm
PINHOLE = Pinhole(240, 200, 150.0, 150.0, 119.0, 101.0)
SCARAMUZZA = Scaramuzza(240, 200, 119.0, 101.0, 140.0, 0.0, -2.2e-3, 1.5e-6, -1e-8, 0.9999, 0.02, -0.02)


def texture() -> np.ndarray:
    """(6, 256, 256) smooth noise in [0.1, 0.9], one sheet a wall, without a repeat."""
    rng = np.random.default_rng(0)
    sheets = np.zeros((6, 256, 256))
    for size in (16, 32, 64, 128):
        noise = rng.normal(size=(6, size, size))
        grid = np.arange(256) * size / 256
        low, share = grid.astype(int), grid % 1
        rows = noise[:, low] * (1 - share)[:, None] + noise[:, (low + 1) % size] * share[:, None]
        sheets += rows[:, :, low] * (1 - share) + rows[:, :, (low + 1) % size] * share
    return np.clip(0.5 + 0.16 * sheets, 0.1, 0.9)


def render(camera: CameraModel, world_from_cam: np.ndarray, sheets: np.ndarray) -> np.ndarray:
    """(H, W, 3) image of the box from inside: the wall is where the ray first leaves the box."""
    rays, valid = camera.rays()
    rays = rays @ world_from_cam[:3, :3].T
    with np.errstate(divide="ignore"):
        leaving = (np.sign(rays) * HALF - world_from_cam[:3, 3]) / rays
    axis = leaving.argmin(-1)
    hit = world_from_cam[:3, 3] + rays * leaving.min(-1)[..., None]
    side = np.take_along_axis(rays > 0, axis[..., None], -1)[..., 0]
    others = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    uv = 128 + np.take_along_axis(hit, others, -1) * 2.7  # texels of 0.37 mm
    low, share = np.floor(uv).astype(int), uv % 1
    value = np.zeros(axis.shape)
    for du in (0, 1):
        for dv in (0, 1):
            weight = np.abs(1 - du - share[..., 0]) * np.abs(1 - dv - share[..., 1])
            value += weight * sheets[2 * axis + side, (low[..., 0] + du) % 256, (low[..., 1] + dv) % 256]
    return np.repeat(np.where(valid, value, 0)[..., None], 3, -1).astype(np.float32)


def pose(step: int) -> np.ndarray:
    """world_from_cam (4, 4): forward 1.5 mm a frame, swinging sideways and turning a little."""
    angle = 0.02 * step
    result = np.eye(4)
    result[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    result[:3, 3] = [4 * np.sin(step / 2), 3 * np.cos(step / 2), -20 + 1.5 * step]
    return result


def film(camera: CameraModel, count: int, first: int = 10) -> list[Frame]:
    sheets = texture()
    return [Frame(f"{first + k}_color", render(camera, pose(k), sheets), camera) for k in range(count)]


def aligned(found: np.ndarray, true: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation, translation of the similarity that takes points (n, 3) closest to others (Umeyama 1991)."""
    a, b = found - found.mean(0), true - true.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ flip @ vt
    scale = (s * np.diag(flip)).sum() / (a**2).sum()
    return scale, rotation, true.mean(0) - scale * rotation @ found.mean(0)


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sfm") / "sparse"
    stages = []
    files = {10 + k: f"{10 + k:08d}.jpg" for k in range(7)}
    result = sparse_map_from_frames(film(PINHOLE, 8), folder, progress=lambda *p: stages.append(p), files=files)
    return result, folder, stages


def test_a_box_seen_from_inside_is_mapped_to_scale_and_its_points_lie_on_the_walls(mapped):
    (submap,) = mapped[0].submaps
    assert [k.number for k in submap.keyframes] == list(range(10, 18)) and mapped[0].unregistered == ()
    true = np.array([pose(k)[:3, 3] for k in range(8)])
    scale, rotation, translation = aligned(np.array([k.center for k in submap.keyframes]), true)
    centers = scale * np.array([k.center for k in submap.keyframes]) @ rotation.T + translation
    assert np.linalg.norm(centers - true, axis=1).max() < 0.2
    points = scale * submap.points @ rotation.T + translation
    off_wall = np.abs(np.abs(points) - HALF).min(1)
    assert len(points) > 100 and np.median(off_wall) < 0.3
    assert np.median(submap.reprojection_errors()) < 1


def test_the_written_model_is_the_returned_one(mapped):
    result, folder, _ = mapped
    read = read_map(folder)
    assert [p.name for p in folder.iterdir()] == ["0"] and result.source == read.source
    for a, b in zip(result.submaps, read.submaps, strict=True):
        assert np.array_equal(a.points, b.points)
        assert [k.name for k in a.keyframes] == [k.name for k in b.keyframes] == [f"{n:06d}.png" for n in range(10, 18)]
        assert all(k.camera == PINHOLE for k in b.keyframes)
    cameras = [line for line in (folder / "0" / "cameras.txt").read_text().splitlines() if not line.startswith("#")]
    assert len(cameras) == 1


def test_beside_a_model_is_the_way_back_from_its_images_to_the_frames_files(mapped):
    with (mapped[1] / "0" / "images.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    assert header == ["image", "source"] and [row[0] for row in rows] == [f"{n:06d}.png" for n in range(10, 18)]
    assert [row[1] for row in rows] == [*(f"{n:08d}.jpg" for n in range(10, 17)), film(PINHOLE, 8)[7].name]


def test_files_of_frames_are_known_by_number_and_a_video_has_none(tmp_path):
    write_folder(sequence(film(PINHOLE, 2)), tmp_path / "frames")
    assert image_files(tmp_path / "frames") == {
        k: f"{f.name}.png" for k, f in zip((10, 11), film(PINHOLE, 2), strict=True)
    }
    assert image_files(tmp_path / "video.mp4") == {}


def test_progress_goes_through_the_stages_to_their_ends(mapped):
    stages = mapped[2]
    assert list(dict.fromkeys(s for s, _, _ in stages)) == ["images", "features", "matches", "mapping"]
    for stage, total in (("images", 8), ("features", 8), ("matches", 28), ("mapping", 8)):
        assert [(d, n) for s, d, n in stages if s == stage][-1] == (total, total)


def test_nothing_is_left_beside_the_map_and_a_second_map_is_refused_there(mapped):
    _, folder, _ = mapped
    assert [p.name for p in folder.parent.iterdir()] == [folder.name]
    with refused(found="holds a map already"):
        sparse_map_from_frames(film(PINHOLE, 3), folder)


def test_equal_frames_give_equal_maps_and_a_black_one_is_reported_as_unregistered(mapped, tmp_path):
    frames = [*film(PINHOLE, 8), Frame("99_color", np.zeros((200, 240, 3), np.float32), PINHOLE)]
    again = sparse_map_from_frames(frames, tmp_path / "sparse")
    assert again.unregistered == ("99_color",)
    assert np.array_equal(again.submaps[0].points, mapped[0].submaps[0].points)


def test_a_scaramuzza_lens_is_mapped_and_given_back(tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        result = sparse_map_from_frames(film(SCARAMUZZA, 7), tmp_path / "sparse", SfmConfig(matching="sequential"))
    assert "residual" in caplog.text
    (submap,) = result.submaps
    assert len(submap.keyframes) == 7 and all(k.camera == SCARAMUZZA for k in submap.keyframes)
    assert np.median(submap.reprojection_errors()) < 1
    (on_disk,) = read_map(tmp_path / "sparse").submaps
    assert isinstance(on_disk.keyframes[0].camera, KannalaBrandt)
    # The skew of this lens is mostly a rotation about its axis: kept in the poses, not lost in the residual.
    pairs = zip(submap.keyframes, on_disk.keyframes, strict=True)
    turned = np.median([np.linalg.norm(a.cam_from_map - b.cam_from_map) for a, b in pairs])
    assert turned > 0.01


def test_a_fisheye_is_fitted_by_itself_exactly():
    camera = KannalaBrandt(90, 72, 48.0, 48.5, 44.0, 37.0, -0.13, -0.006, 0.0017, -8e-5)
    fit = fisheye_fit(camera, np.ones((72, 90), bool))
    assert fit.max_px < 1e-6
    assert np.allclose(fit.camera.params, camera.params, atol=1e-4)


def test_features_keep_away_from_the_mask_s_border_and_from_highlights():
    mask = np.ones((200, 240), bool)
    mask[:, :50] = False
    image = np.full((200, 240, 3), 0.5, np.float32)
    image[100, 150] = 1.0
    image[100, 200] = [1.0, 0.5, 0.5]  # red tissue close to the light is no highlight
    usable = usable_pixels(Frame("1", image, PINHOLE, mask=mask), SfmConfig(mask_erosion_px=4, highlight_margin_px=3))
    assert not usable[:, :54].any() and usable[:, 54].all()
    assert not usable[100, 147:154].any() and usable[100, 146] and usable[100, 154]
    assert usable[100, 200] and usable[0, 239]


def test_frames_that_cannot_be_mapped_are_refused_with_advice_and_leave_nothing(tmp_path, capfd):
    still = [Frame(f"{k}", np.full((200, 240, 3), 0.5, np.float32), PINHOLE) for k in range(4)]
    with refused("4 of 240x200 … 5 mm of travel … sharp … calibration … mask"):
        sparse_map_from_frames(still, tmp_path / "run" / "sparse")
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")  # COLMAP's own words would only be in the way


def test_too_few_frames_are_refused_before_any_work(tmp_path):
    with refused(where="the frames", found="2 of them", cure="at least 3"):
        sparse_map_from_frames(film(PINHOLE, 2), tmp_path / "sparse")
    assert list(tmp_path.iterdir()) == []


def test_frames_of_two_cameras_or_with_one_number_are_refused(tmp_path):
    black = np.zeros((200, 240, 3), np.float32)
    with refused(found="another camera than a1"):
        sparse_map_from_frames([Frame("a1", black, PINHOLE), Frame("a2", black, SCARAMUZZA)], tmp_path / "sparse")
    with refused(where="b7", found="and a7 are both frame 7"):
        sparse_map_from_frames([Frame("a7", black, PINHOLE), Frame("b7", black, PINHOLE)], tmp_path / "sparse")
    assert list(tmp_path.iterdir()) == []


def test_a_png_can_be_written_after_pycolmap_was_loaded(tmp_path):
    program = (
        "import lightdepth.sfm.reconstruction, sys; assert 'pycolmap' not in sys.modules\n"
        "from lightdepth.native import pycolmap; pycolmap()\n"
        "import cv2, numpy\n"
        f"assert cv2.imwrite({str(tmp_path / 'a.png')!r}, numpy.zeros((64, 64, 3), numpy.uint8))\n"
    )
    root = Path(__file__).resolve().parents[1]
    done = subprocess.run([sys.executable, "-c", program], cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_long_sequences_are_matched_by_looks_too_and_give_the_same_map_twice(tmp_path):
    config = SfmConfig(matching="sequential", overlap=2, alike=1, max_features=800)
    frames = film(PINHOLE, 6)
    first, second = (sparse_map_from_frames(frames, tmp_path / name, config) for name in ("a", "b"))
    for a, b in zip(first.submaps, second.submaps, strict=True):
        assert np.array_equal(a.points, b.points)
        for one, other in zip(a.keyframes, b.keyframes, strict=True):
            assert np.array_equal(one.cam_from_map, other.cam_from_map)


@pytest.mark.parametrize("camera", [PINHOLE, SCARAMUZZA], ids=lambda c: c.name)
def test_known_poses_stay_as_they_are_and_the_points_lie_on_the_walls_in_their_unit(camera, tmp_path):
    frames = film(camera, 4)
    poses = {10 + k: pose(k) for k in range(3)}
    found = sparse_map_from_frames(frames, tmp_path / "sparse", SfmConfig(max_features=800), poses=poses)
    (submap,) = found.submaps
    for keyframe in submap.keyframes:
        np.testing.assert_allclose(keyframe.cam_from_map @ poses[keyframe.number], np.eye(4), atol=1e-9)
    assert np.median(np.abs(np.abs(submap.points) - HALF).min(1)) < 0.3
    assert found.failed == {"13_color": "it has no known pose"}


def test_poses_of_other_frames_are_refused(tmp_path):
    with refused(where="known poses", found="0 of 3 frames", cure="at least 2"):
        sparse_map_from_frames(film(PINHOLE, 3), tmp_path / "sparse", poses={99: np.eye(4)})
    assert list(tmp_path.iterdir()) == []


def test_contrast_is_evened_inside_the_mask_and_left_alone_on_request():
    rng = np.random.default_rng(0)
    image = np.full((64, 64, 3), 40, np.uint8) + rng.integers(0, 6, (64, 64, 1)).astype(np.uint8)
    valid = np.ones((64, 64), bool)
    valid[:, :16] = False
    assert evened(image, valid, 2.0)[:, 20:].std() > 1.5 * image[:, 20:].std()
    assert evened(image, valid, 0) is image


def test_a_video_with_a_cut_in_the_middle_gives_two_submaps(tmp_path):
    sheets = np.random.default_rng(5).permutation(texture(), axis=0)[:, ::-1]
    other = [Frame(f"{6 + k}", render(PINHOLE, pose(k + 12), 1 - sheets), PINHOLE) for k in range(6)]
    found = sparse_map_from_frames([*film(PINHOLE, 6, 0), *other], tmp_path / "sparse", SfmConfig(max_features=1500))
    assert sorted([k.number for k in s.keyframes] for s in found.submaps) == [list(range(6)), list(range(6, 12))]


WRONG_POSES = {
    "inverted": (np.linalg.inv, "with the poses inverted: they are camera-from-world"),
    "OpenGL": (lambda p: p @ np.diag([1.0, -1, -1, 1]), "with the camera's y and z axes turned: they are OpenGL's"),
    "both": (
        lambda p: np.linalg.inv(p @ np.diag([1.0, -1, -1, 1])),
        "with the poses inverted: … and the camera's y and z axes turned",
    ),
}


def test_where_too_few_frames_can_be_read_the_first_that_cannot_is_named(tmp_path):
    def load(row: int) -> Frame:
        if row in (1, 3):
            raise InputError(f"{row}.png", "torn", "copy it again")
        return film(PINHOLE, 1, first=row)[0]

    frames = FrameSequence([f"{n:06d}" for n in range(4)], load, "the film")
    with pytest.raises(InputError, match=r"^1.png: torn"):
        sparse_map_from_frames(frames, tmp_path / "sparse", SfmConfig(max_features=400))
    assert not any(tmp_path.iterdir())


@pytest.fixture(scope="module")
def matched(tmp_path_factory):
    """Verified matches of a film, and its poses by file name, from which a map would be triangulated."""
    work = tmp_path_factory.mktemp("matched")
    for folder in ("images", "masks"):
        (work / folder).mkdir()
    config = SfmConfig(max_features=800)
    written = write_images(film(PINHOLE, 6), work / "images", work / "masks", config, lambda *_: None)
    names = sorted(written.names)
    features_and_matches(work, PINHOLE, names, config, lambda *_: None)
    return far_matches(work, names, 40), {name: pose(k) for k, name in enumerate(names)}


def test_matches_meet_in_front_of_cameras_whose_poses_are_right_and_rough_poses_are_not_accused(matched):
    matches, poses = matched
    fit = fitting_poses(matches, poses, PINHOLE, np.eye(4))
    assert fit.share > 0.9 and fit.px < 1 and fit.matches > 300 and not fit.poor
    rng = np.random.default_rng(0)
    rough = {name: p.copy() for name, p in poses.items()}
    for p in rough.values():
        p[:3, 3] += rng.normal(0, 1, 3)
    assert fitting_poses(matches, rough, PINHOLE, np.eye(4)).share < fit.share


@pytest.mark.parametrize("how", WRONG_POSES)
def test_poses_read_the_wrong_way_are_refused_with_the_reading_that_fits_and_both_figures(matched, how):
    matches, poses = matched
    change, message = WRONG_POSES[how]
    with refused(message, where="known poses", found="matches meet in front", cure="% meet ("):
        fitting_poses(matches, {name: change(p) for name, p in poses.items()}, PINHOLE, np.eye(4))


def test_poses_of_another_film_are_poor_and_no_reading_is_blamed(matched):
    matches, poses = matched
    rng = np.random.default_rng(1)
    others = dict(zip(poses, rng.permutation(list(poses.values())), strict=True))
    assert fitting_poses(matches, others, PINHOLE, np.eye(4)).share < 0.5
