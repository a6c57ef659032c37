"""Colours of map points as votes: they tell slips that patches leave unsaid, and accuse no honest set-up."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from test_detective import SEED, film, grainy, honest_map, is_honest, larger, shown

from lightdepth.detective import investigate
from lightdepth.maps import read_map
from lightdepth.maps.colmap import read_submap, write_text_model
from lightdepth.sparse_map import PointColors, SparseMap, Submap


def colored(sparse_map: SparseMap) -> SparseMap:
    """As COLMAP has it: each point in the mean colour of the pixels that observed it."""
    (submap,) = sparse_map.submaps
    total, count = np.zeros((len(submap.points), 3)), np.zeros((len(submap.points), 1))
    for keyframe in submap.keyframes:
        ids, _, pixels = submap.observed_points(keyframe)
        u, v = (pixels - 0.5).astype(np.float32).T
        seen = cv2.remap(film()[keyframe.number].image, u[:, None], v[:, None], cv2.INTER_LINEAR)[:, 0]
        rows = submap.rows_of(ids)[0]
        total[rows] += seen
        count[rows] += 1
    values = np.rint(255 * total / count.clip(1)) / 255
    return replace(sparse_map, submaps=(replace(submap, colors=PointColors(submap.point_ids, values)),))


def observed_once(sparse_map: SparseMap) -> SparseMap:
    """No two keyframes share a point, so that there are no patches to compare."""
    (submap,) = sparse_map.submaps
    turn = np.random.default_rng(0).integers(len(submap.keyframes), size=submap.point_ids.max() + 1)
    kept = [(k, turn[k.point_ids] == n) for n, k in enumerate(submap.keyframes)]
    keyframes = tuple(replace(k, pixels=k.pixels[own], point_ids=k.point_ids[own]) for k, own in kept)
    return replace(sparse_map, submaps=(replace(submap, keyframes=keyframes),))


def warm(image: np.ndarray) -> np.ndarray:
    """Another gain for each channel of each frame."""
    gains = np.random.default_rng(int(1e4 * image.mean())).uniform(0.7, 1.2, 3)
    return np.clip(image * gains, 0, 1).astype(np.float32)


def mirrored(image: np.ndarray) -> np.ndarray:
    return image[:, ::-1]


SLIPS: dict[str, tuple[int, int, Callable[[np.ndarray], np.ndarray] | None, str]] = {
    "a frame late": (0, 1, None, "1 frame later"),
    "two frames early": (4, -2, None, "2 frames earlier"),
    "mirrored": (0, 0, mirrored, "mirrored left for right"),
}


@pytest.mark.parametrize("slip", SLIPS)
def test_colours_name_a_slip_where_no_two_keyframes_share_a_point(slip):
    first, later, change, named = SLIPS[slip]
    made, frames = observed_once(colored(honest_map(first=first))), shown(film(), later, change)
    verdict = investigate(made, frames)
    assert verdict.judgement == "wrong" and named in verdict.sentence, verdict.sentence
    (bare,) = made.submaps
    without = investigate(replace(made, submaps=(replace(bare, colors=None),)), frames)
    assert without.judgement == "cannot tell" and without.colours is None


def test_a_camera_of_another_size_is_named_by_colours():
    verdict = investigate(larger(observed_once(colored(honest_map()))), shown(film()))
    assert verdict.judgement == "wrong" and "half as large" in verdict.sentence


def test_another_clip_is_doubted_by_colours_alone():
    verdict = investigate(observed_once(colored(honest_map())), shown(film(7)))
    assert verdict.judgement == "doubtful" and "order of their colours" in verdict.sentence


@pytest.mark.parametrize("change", [None, grainy, warm])
@pytest.mark.parametrize("keep", [lambda sparse_map: sparse_map, observed_once])
def test_honest_colours_accuse_nobody(keep, change):
    verdict = investigate(keep(colored(honest_map())), shown(film(), 0, change))
    assert is_honest(verdict) and verdict.judgement == "agrees" and verdict.colours is not None


def test_colours_that_are_none_of_the_images_do_not_outvote_patches():
    (submap,) = honest_map().submaps
    painted = PointColors(submap.point_ids, np.random.default_rng(0).random(submap.points.shape))
    assert is_honest(investigate(SparseMap((replace(submap, colors=painted),), "painted"), shown(film())))


def test_colours_are_read_with_the_points_and_stay_with_the_ids(tmp_path):
    (submap,) = honest_map().submaps
    images = {k.name: film()[k.number].image for k in submap.keyframes}
    write_text_model(submap, tmp_path / "map", images)
    found = read_submap(tmp_path / "map", 0)
    assert isinstance(found, Submap) and found.colors is not None
    (own,) = colored(honest_map()).submaps
    ids = submap.point_ids[::7]
    assert np.median(np.abs(found.colors.of(ids) - own.colors.of(ids))) < 0.05
    assert np.isnan(found.colors.of(np.array([10**9]))).all()
    write_text_model(submap, tmp_path / "grey")
    assert read_map(tmp_path / "grey").submaps[0].colors is None  # all the same: none is known


def test_the_figures_of_colours_are_recorded():
    said = investigate(colored(honest_map(SEED)), shown(film())).record()
    assert said["figures"]["colours"]["at_hand"]["ncc"] > 0.5
