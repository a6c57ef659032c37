"""The likely reason for every frame that found no place, and which frames are matched at all."""

import warnings

import numpy as np
import pytest

from lightdepth.image_quality import Measures
from lightdepth.sfm.retrieval import frame_pairs, vlad
from lightdepth.sfm.unmapped import Matching, reasons, summary

USUAL = {"brightness": 120.0, "saturated": 0.02, "sharpness": 0.1}


def judged(count: int, mapped: list[int], features=500, matches=(), **images: dict[int, float]) -> list[str]:
    """Reasons for frames as usual but for `images`: {measure: {frame: value}}; matches (i, j, n, flat)."""
    values = {name: np.full(count, usual) for name, usual in USUAL.items()}
    for name, changes in images.items():
        for i, value in changes.items():
            values[name][i] = value
    rest = {n: np.ones(count) for n in ("dark", "change", "combing", "red", "green", "blue")}
    rows = np.array(matches, int).reshape(-1, 4)
    found = Matching(np.broadcast_to(features, count), rows[:, :2], rows[:, 2], rows[:, 3] > 0)
    return reasons(Measures(**values, **rest), found, np.isin(np.arange(count), mapped))


@pytest.mark.parametrize(
    "images, reason",
    [
        ({"brightness": {3: 10.0}}, "too dark: mean brightness 10 of 255"),
        ({"saturated": {3: 0.6}}, "saturated: 60% of its pixels are white"),
        ({"sharpness": {3: 0.03}}, "blurred: 30% of the sharpness of the mapped frames"),
        ({"brightness": {3: np.nan}}, "nothing of it is inside the mask"),
    ],
)
def test_an_image_that_is_to_blame_is_blamed(images, reason):
    assert judged(4, [0, 1, 2], **images) == ["", "", "", reason]


def test_a_good_image_fails_for_its_features_its_matches_its_parallax_or_the_agreement():
    assert judged(4, [0, 1, 2], features=np.array([500, 500, 500, 20]))[3] == "few features: 20"
    assert judged(4, [0, 1, 2], matches=[(0, 3, 9, 0)])[3] == "no matches: 9 at most with any other frame"
    flat = [(0, 3, 90, 1), (1, 3, 80, 1), (2, 3, 70, 0)]
    assert judged(4, [0, 1, 2], matches=flat)[3].startswith("no parallax: a turn or a plane explains 67%")
    assert judged(4, [0, 1, 2], matches=[(0, 3, 90, 0)])[3].startswith("no agreement: up to 90 matches")


def test_where_no_frame_is_mapped_the_sharpest_tell_the_blurred_ones():
    found = judged(10, [], sharpness=dict.fromkeys(range(3), 0.02))
    assert all("blurred" in r for r in found[:3]) and all("no matches" in r for r in found[3:])
    assert summary(found) == "7 no matches, 3 blurred"


def sights(count: int, places: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Descriptors of frames: each place has features of its own, seen with noise."""
    known = rng.gamma(0.5, 40, (places.max() + 1, 60, 128))
    return [np.clip(known[p] + rng.normal(0, 4, (60, 128)), 0, 255) for p in places[:count]]


def test_a_place_seen_again_is_matched_with_its_first_sight_and_neighbours_are_anyway():
    places = np.concatenate([np.arange(20), np.arange(5)])
    pairs = frame_pairs(sights(25, places, np.random.default_rng(0)), overlap=3, alike=1, seed=0)
    assert {(i, i + 20) for i in range(5)} <= set(pairs)
    assert {(i, j) for i in range(25) for j in range(i + 1, min(i + 4, 25))} <= set(pairs)
    assert len(pairs) < 100 and pairs == sorted(set(pairs))


def test_frames_without_features_are_like_no_other():
    descriptors = [*sights(8, np.arange(8), np.random.default_rng(1)), np.zeros((0, 128))]
    assert not vlad(descriptors, 0)[-1].any()
    assert all(8 not in pair or pair[0] == 7 for pair in frame_pairs(descriptors, overlap=1, alike=2, seed=0))
    assert frame_pairs([np.zeros((0, 128))] * 4, overlap=1, alike=2, seed=0) == [(0, 1), (1, 2), (2, 3)]


def test_equal_features_give_equal_pairs():
    descriptors = sights(30, np.arange(30) % 11, np.random.default_rng(2))
    assert frame_pairs(descriptors, 2, 3, 5) == frame_pairs(descriptors, 2, 3, 5)


def test_a_sequence_with_fewer_sights_than_words_is_described_without_a_warning():
    descriptors = [np.repeat(d[:2], 30, axis=0) for d in sights(9, np.arange(9) % 3, np.random.default_rng(3))]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        looks = vlad(descriptors, 0)
    np.testing.assert_allclose(np.linalg.norm(looks, axis=1), 1, rtol=1e-5)
