"""Planted slips between frames and a map: each is refused and named, or the verdict says what it could not tell; and
honest set-ups, none of which is accused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from colons import colon, sequence, slam
from raising import refused

from densify.inputs import MapSource, map_and_frames
from lightdepth.camera import Brown, CameraModel, Pinhole
from lightdepth.datasets import FrameSequence, SequenceSource, write_folder
from lightdepth.datasets.counting import Counting
from lightdepth.detective import PairingConfig, Verdict, check_pairing, investigate
from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.maps.checks import OTHER_READINGS, checked, seen_by_projection
from lightdepth.maps.colmap import write_text_model
from lightdepth.maps.convention import distorted
from lightdepth.reporting.run import Run, plain
from lightdepth.sfm.config import SfmConfig
from lightdepth.sparse_map import Keyframe, SparseMap

CAMERA = Pinhole(128, 104, 70.0, 70.0, 64.0, 52.0)
SEED, OTHER = 4, 7


@cache
def film(seed: int = SEED) -> list[Frame]:
    return colon(seed, 44, 30.0, CAMERA).frames


@cache
def honest_map(seed: int = SEED, pixel_noise: float = 0.5, spurious: float = 0.05, first: int = 0) -> SparseMap:
    """Of every third frame up to the fortieth, from frame `first` on."""
    config = {"keyframe_every": 3, "pixel_noise": pixel_noise, "spurious": spurious}
    return slam(film(seed)[first:40], seed, **config).map


def shown(
    frames: list[Frame], later: int = 0, change: Callable[[np.ndarray], np.ndarray] | None = None
) -> FrameSequence:
    """The frames with their numbers moved and their images changed."""
    kept = [f for f in frames if f.number + later >= 0]
    images = [f.image if change is None else np.ascontiguousarray(change(f.image)) for f in kept]
    pairs = zip(kept, images, strict=True)
    return sequence([replace(f, name=f"{f.number + later:06d}", image=image) for f, image in pairs])


def each(sparse_map: SparseMap, change: Callable[[Keyframe], Keyframe]) -> SparseMap:
    submaps = (replace(s, keyframes=tuple(map(change, s.keyframes))) for s in sparse_map.submaps)
    return replace(sparse_map, submaps=tuple(submaps))


def counted(rate: float) -> SparseMap:
    """A map of every sixth frame, its times counted with `rate` times the frames a second."""
    return each(
        slam(film(), SEED, keyframe_every=6).map, lambda k: replace(k, name=f"{round(k.number * rate):06d}.png")
    )


def larger(sparse_map: SparseMap) -> SparseMap:
    """The map, with width and height of its camera doubled and nothing else."""
    return each(sparse_map, lambda k: replace(k, camera=replace(k.camera, width=256, height=208)))


LENS = Brown(128, 104, 70.0, 70.0, 64.0, 52.0, -0.3, 0.05, 0.0, 0.0)


def of_the_lens() -> SparseMap:
    """The map of a camera with that lens: its keypoints are where the lens put them."""
    return each(honest_map(), lambda k: replace(k, camera=LENS, pixels=distorted(LENS, k.pixels)))


def two_clips() -> FrameSequence:
    """Of the map's film up to frame 20, then another with the same numbers."""
    return sequence([*film()[:20], *film(OTHER)[20:]])


SLIPS: dict[str, tuple[Callable[[], SparseMap], Callable[[], FrameSequence], str]] = {
    "a frame late": (honest_map, lambda: shown(film(), 1), "1 frame later"),
    "a frame early": (lambda: honest_map(first=4), lambda: shown(film(), -1), "1 frame earlier"),
    "two frames late": (honest_map, lambda: shown(film(), 2), "2 frames later"),
    "two frames early": (lambda: honest_map(first=4), lambda: shown(film(), -2), "2 frames earlier"),
    "five frames late": (honest_map, lambda: shown(film(), 5), "5 frames later"),
    "25 for 30 frames a second": (lambda: counted(25 / 30), lambda: shown(film()), "1.2 times as many frames"),
    "60 for 30 frames a second": (lambda: counted(2.0), lambda: shown(film()), "0.5 times as many frames"),
    "another clip": (honest_map, lambda: shown(film(OTHER)), "are these the frames"),
    "two clips with the same numbers": (honest_map, two_clips, "frames"),
    "mirrored": (honest_map, lambda: shown(film(), 0, lambda image: image[:, ::-1]), "mirrored left for right"),
    "upside down": (honest_map, lambda: shown(film(), 0, lambda image: image[::-1, ::-1]), "upside down"),
    "camera twice its size": (lambda: larger(honest_map()), lambda: shown(film()), "half as large"),
    "images undistorted": (of_the_lens, lambda: shown(film()), "images are undistorted"),
}


@pytest.mark.parametrize("slip", SLIPS)
def test_a_slip_is_refused_and_the_reading_that_fits_named(slip):
    made, frames, named = SLIPS[slip]
    verdict = investigate(made(), frames())
    print(verdict.sentence, verdict.cure)
    assert verdict.judgement == "wrong", verdict.sentence
    assert named in f"{verdict.sentence}; {verdict.cure}"


def is_honest(verdict: Verdict) -> bool:
    print(verdict.sentence)
    return verdict.judgement in ("agrees", "cannot tell")


def ghost(seed: int) -> SparseMap:
    """The map with points where its poses put them, as a trajectory and a cloud have them."""
    (submap,) = honest_map(seed).submaps
    return SparseMap((seen_by_projection(submap, hide=True),), "a trajectory")


def grainy(image: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(int(1e4 * image.mean())).normal(0, 0.03, image.shape)
    return np.clip(image + noise, 0, 1).astype(np.float32)


def few_points(sparse_map: SparseMap) -> SparseMap:
    """Every eighth."""
    (submap,) = sparse_map.submaps
    return replace(
        sparse_map,
        submaps=(replace(submap, point_ids=submap.point_ids[::8].copy(), points=submap.points[::8].copy()),),
    )


HONEST: dict[str, tuple[Callable[[int], SparseMap], Callable[[int], FrameSequence]]] = {
    "as it is": (honest_map, lambda seed: shown(film(seed))),
    "2 px of noise": (lambda seed: honest_map(seed, 2.0), lambda seed: shown(film(seed))),
    "30 % wrong points": (lambda seed: honest_map(seed, 0.5, 0.3), lambda seed: shown(film(seed))),
    "blurred": (honest_map, lambda seed: shown(film(seed), 0, lambda image: cv2.GaussianBlur(image, (0, 0), 1.5))),
    "grainy": (honest_map, lambda seed: shown(film(seed), 0, grainy)),
    "few points": (lambda seed: few_points(honest_map(seed)), lambda seed: shown(film(seed))),
    "no keypoints": (ghost, lambda seed: shown(film(seed))),
}


@pytest.mark.parametrize("seed", [11, 12, 13])
@pytest.mark.parametrize("setup", HONEST)
def test_none_of_twenty_one_honest_set_ups_is_accused(setup, seed):
    made, frames = HONEST[setup]
    assert is_honest(investigate(made(seed), frames(seed)))


def test_a_film_that_stands_still_is_not_accused_and_what_it_could_not_tell_is_said():
    still = [replace(film()[0], name=f"{n:06d}") for n in range(24)]
    verdict = investigate(slam(still, 3, keyframe_every=3, pixel_noise=1.0).map, shown(still, 1, grainy))
    assert is_honest(verdict) and any("frame" in reading for reading in verdict.untold)
    assert "it could not tell" in verdict.sentence


@pytest.mark.parametrize(
    "start", ["with the inverse poses. ", "with the camera's y and z", "with the inverse poses and the camera's"]
)
def test_a_trajectory_read_the_wrong_way_round_is_refused(start):
    """By its images, or before, as no keyframe sees a point."""
    (change,) = (c for what, c in OTHER_READINGS.items() if what.startswith(start))
    (submap,) = honest_map().submaps
    try:
        turned = SparseMap((seen_by_projection(change(submap), hide=True),), "a trajectory")
    except InputError as error:
        assert "none has a point in its view" in error.found
        return
    assert investigate(turned, shown(film())).judgement == "wrong"


def test_half_a_pixel_is_doubted_where_keypoints_show_it_and_else_said_to_be_untold():
    (seen, unseen) = (
        investigate(each(honest_map(SEED, noise), lambda k: replace(k, pixels=k.pixels + 0.5)), shown(film()))
        for noise in (0.5, 2.0)
    )
    assert seen.judgement == "doubtful" and "half a pixel" in seen.sentence
    assert unseen.judgement == "agrees" and "half a pixel" in unseen.sentence


def test_black_frames_cannot_tell():
    verdict = investigate(honest_map(), shown(film(), 0, np.zeros_like))
    assert verdict.judgement == "cannot tell" and "contrast" in verdict.sentence


def test_a_camera_that_the_map_s_keypoints_contradict_is_refused():
    wide = Pinhole(128, 104, 50.0, 50.0, 64.0, 52.0)
    verdict = investigate(honest_map(), shown(film()), wide)
    assert verdict.judgement == "wrong" and "--camera" in verdict.cure
    assert is_honest(investigate(honest_map(), shown(film()), CAMERA))


def test_a_wrong_pairing_is_an_error_and_a_trusted_one_a_warning(tmp_path):
    late = shown(film(), 1)
    with refused(found="1 frame later", cure="--trust-map"):
        check_pairing(honest_map(), late)
    run = Run(tmp_path, tmp_path, "densify", {})
    with pytest.warns(UserWarning, match="1 frame later"):
        check_pairing(honest_map(), late, PairingConfig(trust_map=True), run)
    said = run.record["pairing"]
    assert said["judgement"] == "wrong" and "1 frame later" in said["sentence"]
    assert said["figures"]["at_hand"]["ncc"] < max(other["ncc"] for other in said["figures"]["others"])
    json.dumps(plain(said), allow_nan=False)


TURN = np.diag([1.0, -1, -1, 1])
MISREAD: dict[str, tuple[Callable[[Keyframe], Keyframe], str]] = {
    "c2w": (lambda k: replace(k, cam_from_map=np.linalg.inv(k.cam_from_map)), "with the inverse poses. "),
    "OpenGL": (lambda k: replace(k, cam_from_map=TURN @ k.cam_from_map), "y and z axes turned over, as OpenGL has"),
    "NeRF": (lambda k: replace(k, cam_from_map=np.linalg.inv(TURN @ k.cam_from_map)), "as OpenGL and NeRF have them"),
    "poses in cm, points in mm": (lambda k: replace(k, cam_from_map=farther(k, 0.1)), "10 times as far apart"),
    "poses in mm, points in m": (lambda k: replace(k, cam_from_map=farther(k, 1000.0)), "0.001 times as far apart"),
    "mirrored": (lambda k: replace(k, pixels=np.abs((128, 0) - k.pixels)), "keypoints mirrored"),
    "half size": (lambda k: replace(k, pixels=k.pixels / 2), "camera at half its size"),
}


def farther(keyframe: Keyframe, scale: float) -> np.ndarray:
    pose = keyframe.cam_from_map.copy()
    pose[:3, 3] *= scale
    return pose


@pytest.mark.parametrize("slip", MISREAD)
def test_a_map_whose_keypoints_contradict_its_reading_is_refused_and_the_right_one_named(slip):
    """Without any image: as it is read."""
    change, named = MISREAD[slip]
    (submap,) = each(honest_map(), change).submaps
    with refused(cure=named):
        checked(submap, Path("a map"))


def test_frames_and_a_map_on_disk_meet_only_where_the_images_agree(tmp_path):
    run, recipe = Run(tmp_path, tmp_path, "densify", {}), SfmConfig()
    write_folder(shown(film()), tmp_path / "right")
    write_folder(shown(film(), 2), tmp_path / "late")
    write_text_model(honest_map().submaps[0], tmp_path / "map")
    map_and_frames(run, SequenceSource(tmp_path / "right"), MapSource(map=tmp_path / "map"), recipe)
    assert run.record["pairing"]["judgement"] == "agrees"
    with refused(where="map", found="2 frames later", cure="frame_offset"):
        map_and_frames(run, SequenceSource(tmp_path / "late"), MapSource(map=tmp_path / "map"), recipe)
    with pytest.warns(UserWarning, match="2 frames later"):
        map_and_frames(run, SequenceSource(tmp_path / "late"), MapSource(True, tmp_path / "map"), recipe)


def test_of_several_submaps_the_one_that_does_not_belong_is_named():
    """Two clips with frames of the same numbers; the frames of one are given."""
    (own,), (other,) = honest_map().submaps, honest_map(OTHER).submaps
    verdict = investigate(SparseMap((own, replace(other, id=1)), "two maps"), shown(film()))
    assert verdict.judgement == "wrong" and verdict.submap == 1


def test_a_keyframe_is_counted_by_rate_then_offset():
    keyframe = Keyframe("000010.png", CAMERA, np.eye(4), np.zeros((0, 2)), np.zeros(0, int))
    assert Counting().number(keyframe) == 10 and Counting(1.2, -1).number(keyframe) == 11
    assert shown(film()).of_keyframe(keyframe, Counting(offset=2)).number == 12


def by_camera(camera: CameraModel) -> FrameSequence:
    """The film, whose own camera is another one."""
    return sequence([replace(f, camera=camera) for f in film()])


def test_a_camera_beside_the_frames_that_puts_the_map_s_points_elsewhere_is_doubted_and_the_pixels_said():
    other = Pinhole(128, 104, 60.0, 60.0, 64.0, 52.0)
    verdict = investigate(honest_map(), by_camera(other))
    (submap,) = honest_map().submaps
    moved = [
        np.linalg.norm(other.project(points)[0] - CAMERA.project(points)[0], axis=1)
        for points in (k.in_camera(submap.observed_points(k)[1]) for k in submap.keyframes)
    ]
    assert verdict.judgement == "doubtful" and "make the map anew" in verdict.cure
    assert f"{np.median(np.concatenate(moved)):.1f} px" in verdict.sentence
    assert is_honest(investigate(honest_map(), by_camera(Pinhole(128, 104, 70.5, 70.5, 64.0, 52.0))))


def test_the_pinhole_of_undistorted_keypoints_is_no_other_camera_than_its_lens():
    assert is_honest(investigate(honest_map(), by_camera(LENS)))


def test_a_given_camera_is_doubted_by_a_map_without_keypoints_too():
    verdict = investigate(ghost(SEED), shown(film()), Pinhole(128, 104, 45.0, 45.0, 64.0, 52.0))
    assert verdict.judgement == "wrong" and "--camera" in verdict.cure
    assert is_honest(investigate(ghost(SEED), shown(film()), CAMERA))
