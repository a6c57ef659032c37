"""What contradicts itself in a sequence is said when it is opened, with what would be right; what is right is not."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from colons import CAMERA, colon, sequence
from raising import refused

from densify.evaluation.truth import check_truth
from lightdepth.calibration import write_light
from lightdepth.camera import KannalaBrandt, Pinhole
from lightdepth.datasets import FrameSequence, open_sequence, write_c3vd, write_folder
from lightdepth.datasets.checks import check_sequence, comb_ratio, fitting_reading
from lightdepth.files.images import read_image
from lightdepth.frame import Frame
from lightdepth.photometry import PhotometricCalibration
from lightdepth.pose_readings import AS_GIVEN
from lightdepth.tube import lens

LENS = lens("c3vd", 100, 80)


def frames(seed: int = 0, camera=CAMERA, travel: float = 12.0) -> list[Frame]:
    made = colon(seed, 10, travel, camera).frames
    return [made[0], made[5], made[9]]


def with_poses(given: list[Frame], change) -> list[Frame]:
    return [replace(f, true_world_from_cam=change(f.true_world_from_cam.copy())) for f in given]


def scaled(factor: float):
    def change(pose: np.ndarray) -> np.ndarray:
        pose[:3, 3] *= factor
        return pose

    return change


def transposed(pose: np.ndarray) -> np.ndarray:
    pose[:3, :3] = pose[:3, :3].T
    return pose


def turned(pose: np.ndarray) -> np.ndarray:
    return pose @ np.diag([1.0, -1, -1, 1])


def mirrored(pose: np.ndarray) -> np.ndarray:
    return np.diag([1.0, -1, 1, 1]) @ pose @ np.diag([1.0, -1, 1, 1])


WRONG_POSES = {
    "inverse": (np.linalg.inv, "with the poses inverted: they are camera-from-world"),
    "metres": (scaled(0.001), "translations multiplied by 1000: they are in metres, the distances in millimetres"),
    "centimetres": (scaled(0.1), "translations multiplied by 10: they are in centimetres"),
    "too large": (scaled(1000), "translations divided by 1000"),
    "transposed": (transposed, "with the rotations transposed: they are written column by column"),
    "OpenGL": (turned, "the camera's y and z axes turned: they are OpenGL's"),
    "Unity": (mirrored, "left-handed axes, as Unity's"),
    "inverse, metres": (lambda p: scaled(0.001)(np.linalg.inv(p)), "inverted: … translations multiplied by 1000"),
}


@pytest.mark.parametrize("how", WRONG_POSES)
@pytest.mark.parametrize("seed", [0, 1])
def test_poses_that_do_not_fit_the_true_distances_are_refused_with_the_reading_that_does(how, seed):
    change, message = WRONG_POSES[how]
    with refused(message, found="poses and true distances contradict each other:", cure="agree to 0"):
        check_sequence(sequence(with_poses(frames(seed), change)))


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "c3vd"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_poses_and_distances_that_fit_are_taken_without_a_word(camera, seed):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_sequence(sequence(frames(seed, camera, 6.0)))
    fit = fitting_reading(frames(seed, camera, 6.0))
    assert fit.best == AS_GIVEN and fit.error < 0.005


def test_coarse_and_noisy_truth_is_no_contradiction():
    """Depth in steps of 0.78 mm as in SimCol3D, and poses off by a third of a millimetre."""
    rng, ray_z = np.random.default_rng(0), CAMERA.rays()[0][..., 2].astype(np.float32)
    step = np.float32(200 / 255)
    coarse = [replace(f, true_distance=step * np.rint(f.true_distance * ray_z / step) / ray_z) for f in frames()]

    def shaken(pose: np.ndarray) -> np.ndarray:
        pose[:3, 3] += rng.normal(0, 0.3, 3)
        return pose

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_sequence(sequence(coarse))
        check_sequence(sequence(with_poses(frames(), shaken)))


def contradicting(how: str, folder: Path) -> FrameSequence:
    """A sequence whose poses and truth contradict each other, and no known reading explains it."""
    rng = np.random.default_rng(0)
    if how == "undistorted, read by the built-in fisheye":
        write_c3vd(colon(0, 10, 12.0, Pinhole(100, 80, 70, 70, 50, 40)).frames, folder)
        return open_sequence(folder)

    def elsewhere(pose: np.ndarray) -> np.ndarray:
        pose[:3, 3] += rng.normal(0, 2 if how == "shaken by 2 mm" else 1e9, 3)
        return pose

    return sequence(with_poses(frames()[:1] + colon(0, 10, 12.0).frames[1:4], elsewhere))


@pytest.mark.parametrize(
    "how, said",
    [
        ("undistorted, read by the built-in fisheye", r"differ by 1\d\.\d% \(median; at most 2% is expected\)"),
        ("shaken by 2 mm", r"differ by \d\.\d% \(median"),
        ("far apart", "by its poses no frame sees the wall that the next one sees"),
    ],
)
def test_a_contradiction_that_no_reading_explains_is_warned_of_with_its_figure_and_nothing_is_judged_by_it(
    how, said, tmp_path
):
    with pytest.warns(UserWarning, match=f"poses and true distances contradict each other: .*{said}"):
        opened = check_sequence(contradicting(how, tmp_path / "seq"))
    with refused(found="poses and true distances contradict each other", cure="--trust-truth"):
        check_truth(opened)
    check_truth(opened, trusted=True)


def test_pixels_whose_truth_or_ray_is_no_number_do_not_hide_a_contradiction():
    rng = np.random.default_rng(0)

    def shaken(pose: np.ndarray) -> np.ndarray:
        pose[:3, 3] += rng.normal(0, 2, 3)
        return pose

    def holed(frame: Frame) -> Frame:
        distance = frame.true_distance.copy()
        distance[:30], distance[50:] = np.nan, np.inf
        return replace(frame, true_distance=distance)

    fit = fitting_reading([holed(f) for f in with_poses(frames(), shaken)])
    assert np.isfinite(fit.error_as_given) and fit.error_as_given > 0.02


def test_frames_that_are_far_apart_and_see_nothing_in_common_are_judged_by_their_neighbours():
    made = colon(0, 10, 12.0).frames
    far = [replace(f, true_world_from_cam=pose) for f, pose in zip(made, poses_of_three_places(made), strict=True)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_sequence(sequence(far))


def poses_of_three_places(made: list[Frame]) -> list[np.ndarray]:
    """Poses of which first, middle and last are metres apart, each with its neighbour beside it."""
    found = []
    for i, frame in enumerate(made):
        pose = frame.true_world_from_cam.copy()
        pose[0, 3] += 1e6 * (i // 3 if i < 9 else 3)
        found.append(pose)
    return found


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda d: d / 255, r"would be 0\.\d+ mm \(median\): it may be in metres, or a code"),
        (lambda d: np.rint(d * 255 / d.max()), "whole numbers from .* alone, as codes of 8 bits do"),
        (lambda d: np.rint(d * 655), r"would be \d+.* mm \(median\)"),
    ],
    ids=["codes from 0 to 1", "codes of 8 bits", "codes of 16 bits"],
)
def test_truth_in_codes_is_warned_of_with_its_figure_and_nothing_is_judged_by_it(change, said):
    coded = [
        replace(f, true_distance=change(f.true_distance).astype(np.float32), true_world_from_cam=None) for f in frames()
    ]
    says(coded, said)
    with refused(found="nothing can be judged by its truth", cure="--trust-truth"):
        check_truth(sequence(coded))


def test_truth_of_few_levels_is_warned_of_and_still_judges():
    step = np.float32(200 / 255)
    coarse = [replace(f, true_distance=step * np.rint(f.true_distance / step)) for f in frames()]
    says(coarse, r"only \d+ different values, 0\.78 mm apart")
    check_truth(sequence(coarse))


def test_depth_taken_for_distance_and_the_other_way_round_is_seen():
    ray_z = LENS.rays()[0][..., 2].astype(np.float32)
    depth = [replace(f, true_distance=f.true_distance * ray_z) for f in frames(0, LENS)]
    with refused(cure="truth taken as depth along the axis and divided by the ray's z"):
        check_sequence(sequence(depth))
    twice = [replace(f, true_distance=f.true_distance / np.maximum(ray_z, 0.1)) for f in frames(0, LENS)]
    with refused(cure="truth multiplied by the ray's z"):
        check_sequence(sequence(twice))


def test_what_was_deformed_or_does_not_move_says_nothing_about_poses():
    still = [replace(frames()[0], name=str(i)) for i in range(3)]
    assert fitting_reading(still).best == AS_GIVEN
    rng = np.random.default_rng(1)
    wild = [replace(f, true_distance=f.true_distance * rng.uniform(0.5, 2, CAMERA.rays()[1].shape)) for f in frames()]
    assert fitting_reading(wild).best == AS_GIVEN
    assert fitting_reading(frames()[:1]) is None
    assert fitting_reading([replace(f, true_distance=None) for f in frames()]) is None


@pytest.fixture
def folder(tmp_path) -> Path:
    write_folder(colon(0).frames[:4], tmp_path / "seq")
    return tmp_path / "seq"


def test_a_mirrored_pose_is_refused_by_frame():
    broken = with_poses(frames(), lambda p: p @ np.diag([-1.0, 1, 1, 1]))
    with refused(where="frames in memory: 000000", found="the pose is not a rotation"):
        check_sequence(sequence(broken))


def test_a_frame_that_cannot_be_read_does_not_keep_the_others_from_being_read(folder, capfd):
    for name in ("000000", "000003"):
        (folder / "frames" / f"{name}.png").write_bytes(b"no image")
    read = open_sequence(folder)
    assert read[1].number == 1
    with refused(where="000003.png", found="not a readable image"):
        read[3]


def test_three_frames_are_looked_at_however_many_there_are():
    asked = []

    class Counting(list):
        def __getitem__(self, i):
            asked.append(i)
            return super().__getitem__(i)

    given = Counting(colon(0).frames)
    check_sequence(sequence(given))
    assert [i for i in asked if isinstance(i, int)] == [0, 5, 9]


def says(given: list[Frame], message: str) -> None:
    with pytest.warns(UserWarning, match=f"frames in memory: .*{message}"):
        check_sequence(sequence(given))


def blank(camera=CAMERA, **changes) -> list[Frame]:
    image = np.full((camera.height, camera.width, 3), 0.5, np.float32)
    return [Frame(str(i), image, camera, **changes) for i in range(3)]


def test_a_camera_of_another_image_is_doubted():
    says(blank(replace(CAMERA, cx=90.0)), r"principal point \(90, 41\) is far from the middle of 96x80")
    says(blank(replace(CAMERA, fx=4.3, fy=4.3)), r"field of view would be 1\d\d degrees .*is the focal length in mm")
    says(blank(replace(CAMERA, fx=900.0, fy=900.0)), "field of view would be 6 degrees")
    fisheye = KannalaBrandt(96, 80, 4.0, 4.0, 48.0, 40.0, 0, 0, 0, 0)
    says(blank(fisheye), r"field of view would be 1\d\d\d degrees")


@pytest.mark.parametrize(
    "camera", [CAMERA, LENS, lens("fisheye", 96, 72), Pinhole(1280, 1024, 1035, 1035, 596, 520)], ids=lambda c: c.name
)
def test_a_plausible_camera_is_not_doubted(camera):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_sequence(sequence(blank(camera)))


def test_a_calibration_with_width_and_height_swapped_says_so(folder):
    (folder / "camera.json").write_text(
        '{"model": "PINHOLE", "width": 80, "height": 96, "params": [52.0, 52.0, 41.0, 47.0]}'
    )
    with refused(found="the image is 96x80, the camera 80x96: width and height are swapped"):
        open_sequence(folder)[0]


def test_a_light_that_no_endoscope_has_is_doubted(tmp_path):
    says(blank(light=PhotometricCalibration(gamma=0.45)), r"gamma is 0\.45; a camera's is between 1 and 3")
    says(blank(light=PhotometricCalibration(position_mm=(0, 0, 3790.0))), "light is 3790 mm from the lens")
    write_light(PhotometricCalibration(position_mm=(0.1, -1.1, 3.6)), tmp_path / "light.xml")
    text = (tmp_path / "light.xml").read_text()
    (tmp_path / "light.xml").write_text(text.replace("0.0036", "3.6").replace("-0.0011", "-1.1"))
    with refused("expected metres, below 0.1 … looks like millimetres: divide it", found="P is 3.7"):
        open_sequence(tmp_path, light=tmp_path / "light.xml", map_camera=CAMERA)


def test_a_mask_that_is_inverted_or_masks_all_or_nothing_is_doubted():
    inside = np.zeros((80, 96), bool)
    inside[10:70, 10:86] = True
    image = np.where(inside[..., None], 0.6, 0.03).astype(np.float32).repeat(3, -1)

    def masked(mask: np.ndarray) -> list[Frame]:
        return [replace(f, image=image, mask=mask) for f in blank()]

    says(masked(~inside), r"mask keeps the dark part of the image \(brightness 0\.03, 0\.60 outside\)")
    says(masked(np.ones_like(inside)), r"4\d% of the image is a black border, and the mask leaves it in")
    speck = np.zeros_like(inside)
    speck[40, 40:50] = True
    says(masked(speck), r"mask leaves 0\.1% of the image")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_sequence(sequence(masked(inside)))


def test_truth_that_knows_nothing_is_doubted():
    says(blank(true_distance=np.zeros((80, 96), np.float32)), r"true distance is unknown \(0\) everywhere in 0, 1, 2")
    says(blank(true_distance=np.full((80, 96), 7, np.float32)), "true distance is the same number everywhere")


def woven(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Every second row of another frame: two fields of an interlaced video."""
    image = first.copy()
    image[1::2] = second[1::2]
    return image


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_interlaced_images_are_told_from_progressive_ones_in_motion_and_noise(seed):
    rng = np.random.default_rng(seed)
    made = colon(seed).frames
    progressive = [f.image for f in made]
    assert max(comb_ratio(image) for image in progressive) < 1.1
    assert max(comb_ratio(i + rng.normal(0, 0.02, i.shape)) for i in progressive) < 1.15
    fields = [woven(a, b) for a, b in zip(progressive, progressive[1:], strict=False)]
    assert min(comb_ratio(image) for image in fields) > 1.5
    combed = [replace(f, image=i, true_distance=None) for f, i in zip(made, fields, strict=False)]
    says(combed, "images look interlaced .*deinterlace the video")
    assert comb_ratio(np.zeros((80, 96, 3), np.float32)) == 1


def test_real_frames_are_progressive_but_for_c3vd_s(realdata):
    """Seen: 1.43 for C3VD, whose video is interlaced, 1.04 for EndoMapper, at most 1.09 for the sinus."""
    assert comb_ratio(read_image(realdata / "c3vd_frame" / "color.png")) > 1.35
    assert comb_ratio(read_image(realdata / "endomapper_assets" / "sample_frame.png")) < 1.15
    sinus = sorted((realdata / "sinus").rglob("0000*.jpg"))[::10]
    assert sinus and max(comb_ratio(read_image(image)) for image in sinus) < 1.15


def test_warnings_name_the_sequence_and_come_once_when_it_is_opened(folder):
    cv2.imwrite(str(folder / "mask.png"), np.full((80, 96), 255, np.uint8))
    with pytest.warns(UserWarning, match="seq: .*black border") as found:
        read = open_sequence(folder)
    assert len(found) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        list(read)
