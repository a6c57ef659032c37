"""Poses that stray from the map's own points are put where these see them, and no others."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from colons import EXACT, colon, slam
from raising import refused
from scipy.spatial.transform import Rotation
from verbs import by_options

from densify.agreement import AgreementConfig
from densify.commands.densify import densify
from densify.judging.config import JudgeConfig
from lightdepth.datasets.folder import write_folder
from lightdepth.maps import read_map, write_text_model
from lightdepth.sfm.polish import polished_submap
from lightdepth.sparse_map import Keyframe, Submap, typical_distance

COUNT = 6
TURN_DEG, SHARE = 1.0, 0.02


def submap(spurious: float = 0.0, pixel_noise: float = 0.5) -> Submap:
    found = slam(colon(0).frames[:COUNT], config=replace(EXACT, pixel_noise=pixel_noise), spurious=spurious)
    (made,) = found.map.submaps
    return made


def astray(keyframe: Keyframe, made: Submap, seed: int) -> Keyframe:
    """The keyframe a degree and two hundredths of a typical distance beside its place."""
    rng, pose = np.random.default_rng(seed), np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.radians(TURN_DEG) * rng.choice([-1, 1], 3) / np.sqrt(3)).as_matrix()
    pose[:3, 3] = SHARE * typical_distance(made) * rng.choice([-1, 1], 3) / np.sqrt(3)
    return replace(keyframe, cam_from_map=pose @ keyframe.cam_from_map)


def strayed(made: Submap, rows: range = range(COUNT)) -> Submap:
    return replace(made, keyframes=tuple(astray(k, made, i) if i in rows else k for i, k in enumerate(made.keyframes)))


def turns(one: Submap, other: Submap) -> np.ndarray:
    """Between keyframes, degrees (n,)."""
    pairs = zip(one.keyframes, other.keyframes, strict=True)
    poses = [a.cam_from_map[:3, :3] @ b.cam_from_map[:3, :3].T for a, b in pairs]
    result: np.ndarray = np.degrees(Rotation.from_matrix(poses).magnitude())
    return result


def shifts(one: Submap, other: Submap) -> np.ndarray:
    """Between camera centres, map units (n,)."""
    return np.array([np.linalg.norm(a.center - b.center) for a, b in zip(one.keyframes, other.keyframes, strict=True)])


@pytest.mark.parametrize("spurious", [0.0, 0.3])
def test_poses_that_strayed_from_their_points_come_back(spurious):
    right = submap(spurious)
    wrong = strayed(right)
    new, polish = polished_submap(wrong)
    assert polish.moved == COUNT and polish.left == ""
    assert turns(wrong, right).min() > 0.99 and turns(new, right).max() < 0.6 and np.median(turns(new, right)) < 0.25
    assert np.median(shifts(new, right)) < 0.2 * np.median(shifts(wrong, right))
    assert polish.hidden_px[1] < 0.7 * polish.hidden_px[0] and 0.5 < polish.turn_deg < 1.5 and 0 < polish.shift < 0.1
    assert "6 of 6 poses moved" in str(polish)


def test_points_pixels_and_who_observed_what_stay():
    wrong = strayed(submap())
    new = polished_submap(wrong)[0]
    assert np.array_equal(new.points, wrong.points) and np.array_equal(new.point_ids, wrong.point_ids)
    for a, b in zip(new.keyframes, wrong.keyframes, strict=True):
        assert (a.name, a.camera) == (b.name, b.camera)
        assert np.array_equal(a.pixels, b.pixels) and np.array_equal(a.point_ids, b.point_ids)


@pytest.mark.parametrize("pixel_noise", [0.0, 0.5, 2.0])
def test_a_map_whose_poses_fit_its_points_stays_what_it_is(pixel_noise):
    right = submap(0.3, pixel_noise)
    new, polish = polished_submap(right)
    assert new is right and polish.moved == 0 and "no closer to their pixels" in polish.left


def test_only_the_keyframe_that_strayed_is_moved():
    right = submap()
    wrong = strayed(right, range(2, 3))
    new, polish = polished_submap(wrong)
    assert polish.moved == 1 and turns(new, right)[2] < 0.25
    assert [a is b for a, b in zip(new.keyframes, wrong.keyframes, strict=True)] == [i != 2 for i in range(COUNT)]


def test_the_same_map_gives_the_same_poses():
    one, other = (polished_submap(strayed(submap(0.3)))[0] for _ in range(2))
    assert all(
        np.array_equal(a.cam_from_map, b.cam_from_map) for a, b in zip(one.keyframes, other.keyframes, strict=True)
    )


def test_a_map_that_cannot_judge_poses_keeps_them_and_says_why():
    wrong = strayed(submap())
    few = tuple(replace(k, pixels=k.pixels[:19], point_ids=k.point_ids[:19]) for k in wrong.keyframes)
    none = tuple(replace(k, pixels=k.pixels[:0], point_ids=k.point_ids[:0]) for k in wrong.keyframes)
    behind = tuple(replace(k, cam_from_map=np.diag([1.0, -1, -1, 1]) @ k.cam_from_map) for k in wrong.keyframes)
    for bad, why in (
        (replace(wrong, weak_visibility=True), "guessed by these very poses"),
        (replace(wrong, keyframes=few), "no keyframe observes 20 points"),
        (replace(wrong, keyframes=none), "no keyframe observes any"),
        (replace(wrong, keyframes=behind), "no closer"),
    ):
        new, polish = polished_submap(bad)
        assert new is bad and polish.moved == 0 and why in str(polish), str(polish)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A sequence, and a map of it in two submaps: the poses of the first strayed, those of the second did not."""
    folder = tmp_path_factory.mktemp("polish")
    write_folder(colon(0).frames[:COUNT], folder / "frames")
    for number, made in enumerate((strayed(submap()), submap())):
        write_text_model(made, folder / "map" / str(number))
    return folder


def test_densify_writes_the_polished_submap_and_says_what_became_of_each(data):
    quick = {"judge": JudgeConfig(on=False), "agreement": AgreementConfig(on=False), "merge": False}
    asked = {"checkpoint": "decline", "light": "gamma=2.2,mu=2.767", "map": data / "map", "polish_map": True}
    by_options(densify)(data / "frames", data / "out", **asked, **quick)
    moved, left = json.loads((data / "out" / "run.json").read_text())["polish"]
    assert moved["moved"] == COUNT and moved["left"] == "" and left["moved"] == 0
    assert [folder.name for folder in (data / "out" / "polished").iterdir()] == ["0"]
    (new,), (right,) = (read_map(folder).submaps for folder in (data / "out" / "polished", data / "map" / "1"))
    assert turns(new, right).max() < 0.25 and len(new.points) == len(right.points)
    log, page = ((data / "out" / name).read_text() for name in ("log.txt", "report.html"))
    for told in (moved, left):
        assert f"poses: {told['sentence']}" in log and f"Poses: map {told['map']}: " in page


def test_a_map_that_pycolmap_makes_is_not_polished(data):
    with refused(where="--polish-map", found="without --map"):
        by_options(densify)(data / "frames", data / "none", checkpoint="decline", polish_map=True)
