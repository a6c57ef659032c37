"""What is known of a surface without truth, on colons where the truth is known to the tests alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from colons import EXACT, colon, sequence, slam, truth
from raising import refused

from densify.config import DensifyConfig
from densify.dense_map import DenseMap
from densify.densified import Densified
from densify.fusion.volume import FusionConfig
from densify.judgement import Judge
from densify.judging.brake import Kept, Tried, kept, kept_of_finer
from densify.judging.columns import Columns
from densify.judging.config import JudgeConfig
from densify.judging.verdict import Judgement, Verdict, headline, proposal, worst
from densify.judging.withheld import Withheld
from densify.page import Gallery
from densify.pipeline import SubmapResult, densify_submap
from lightdepth.camera import Pinhole
from lightdepth.parallax import ParallaxConfig
from lightdepth.prediction import DepthPrediction
from lightdepth.sparse_map import Submap

COARSE = DensifyConfig(fusion=FusionConfig(voxels_per_distance=15.0))
CAMERA = Pinhole(160, 128, 86.0, 86.0, 80.0, 64.0)


@pytest.fixture(scope="module")
def frames():
    return colon(0, 6, 10.0, CAMERA).frames


@pytest.fixture(scope="module")
def submap(frames) -> Submap:
    return slam(frames, spurious=0.05, points_per_keyframe=120).map.submaps[0]


@pytest.fixture(scope="module")
def plain(submap, frames) -> tuple[Judgement, SubmapResult]:
    """True depth on a good map, judged."""
    return judged(submap, frames)


def side_moved(submap: Submap, factor: float, share: float = 0.45) -> Submap:
    """The points of one side of the wall farther from the cameras by a factor."""
    middle = np.mean([k.center for k in submap.keyframes], axis=0)
    off = submap.points - middle
    side = off @ submap.keyframes[0].cam_from_map[0, :3] / np.linalg.norm(off, axis=1)
    moved = side > np.quantile(side, 1 - share)
    return replace(submap, points=np.where(moved[:, None], middle + factor * off, submap.points))


def judged(submap, frames, model=truth, config=COARSE):
    result = densify_submap(submap, sequence(frames), model, config)
    assert result.judgement is not None
    return result.judgement, result


def test_true_depth_on_a_good_map_is_green_and_a_constant_distance_is_far_behind(plain):
    judgement, _ = plain
    assert judgement.verdict.colour == "green", judgement.verdict
    assert judgement.images.count > 100 and judgement.images.one_scale < 0.03
    assert judgement.blocks.one_scale < 0.03
    assert judgement.images.constant_one_scale > 5 * judgement.images.one_scale


def test_the_images_see_that_a_side_of_the_wall_was_moved_and_the_bend_is_undone(submap, frames):
    """True depth, which needs no bend: bent to the moved points, it is wrong by half of their factor."""
    moved = side_moved(submap, 1.3)
    unjudged = densify_submap(moved, sequence(frames), truth, replace(COARSE, judge=JudgeConfig(on=False)))
    assert all(a.bend is not None for a in unjudged.dense.alignments if a.ok)
    judgement, result = judged(moved, frames)
    aligned = [a for a in result.dense.alignments if a.ok]
    assert judgement.undone > 0.7 * len(aligned)
    assert all("the images" in a.unbent_because for a in aligned if a.bend is None)
    assert "against the images" in judgement.verdict.sentence


def test_where_the_map_is_right_the_bends_stay(submap, frames):
    """Depth that is wrong by a smooth field: the bend mends it, and the images agree."""

    def leaning(frame) -> DepthPrediction:
        right = truth(frame)
        across = np.linspace(-0.3, 0.3, right.distance.shape[1], dtype=np.float32)
        return replace(right, distance=right.distance * np.exp(across))

    judgement, _ = judged(submap, frames, leaning)
    assert judgement.undone == 0 and judgement.images.bent < 0.5 * judgement.images.one_scale
    assert judgement.verdict.colour == "green", judgement.verdict


def test_the_constant_gets_the_same_help_and_the_verdict_says_when_the_light_adds_nothing(submap, frames):
    def constant(frame) -> DepthPrediction:
        right = truth(frame)
        return replace(right, distance=np.ones_like(right.distance))

    judgement, _ = judged(submap, frames, constant)
    assert judgement.images.best == pytest.approx(judgement.images.constant, rel=0.05)
    assert "a constant distance does as well" in judgement.verdict.sentence


def test_white_frames_are_never_green(submap, frames):
    white = [replace(f, image=np.ones_like(f.image)) for f in frames]
    judgement, _ = judged(submap, white, truth)
    assert judgement.images.count == 0 and judgement.surface is None
    assert judgement.verdict.colour != "green" and "too little texture" in judgement.verdict.sentence


def test_images_that_were_not_used_are_not_said_to_have_too_little_texture(submap, frames):
    config = replace(COARSE, judge=JudgeConfig(parallax=ParallaxConfig(on=False)))
    judgement = densify_submap(submap, sequence(frames), truth, config).judgement
    assert judgement is not None and judgement.verdict.colour == "amber"
    assert "were not used" in judgement.verdict.sentence and "texture" not in judgement.verdict.sentence


def test_a_part_of_a_bend_that_its_points_do_not_trust_counts_as_undone(submap, frames, monkeypatch):
    monkeypatch.setattr("densify.judgement.kept", lambda tried: dict.fromkeys(tried, Kept(0.5, "half")))
    assert judged(submap, frames)[0].lessened > 3
    monkeypatch.setattr("densify.judgement.bent", lambda alone, *_: alone)
    judgement, result = judged(submap, frames)
    aligned = [a for a in result.dense.alignments if a.ok]
    assert (judgement.undone, judgement.lessened) == (len(aligned), 0)
    assert all(a.bend is None and "confirm no such part" in a.unbent_because for a in aligned)


def test_bends_of_keyframes_that_are_not_in_the_surface_are_not_counted(submap, frames, monkeypatch):
    monkeypatch.setattr("densify.judgement.kept", lambda tried: dict.fromkeys(tried, Kept(0.0, "none")))
    monkeypatch.setattr(
        "densify.pipeline.uncontradicted_keyframes",
        lambda keyframes, *_: [k.unread("gone") for k in keyframes[:2]] + list(keyframes[2:]),
    )
    judgement, result = judged(submap, frames)
    assert judgement.undone == judgement.aligned == sum(bool(a.unbent_because) for a in result.dense.alignments)


def test_the_surface_uses_every_point(submap, plain):
    _, result = plain
    for keyframe, alignment in zip(submap.keyframes, result.dense.alignments, strict=True):
        assert alignment.points == pytest.approx(len(submap.observed_points(keyframe)[0]), rel=0.05)


def test_points_drawn_one_by_one_flatter_where_the_map_errs_together(submap, frames):
    judgement, _ = judged(side_moved(submap, 1.3, 0.3), frames)
    assert judgement.drawn.bent < judgement.blocks.bent


def test_the_judge_can_be_switched_off_and_the_images_left_out(submap, frames):
    off = densify_submap(submap, sequence(frames), truth, replace(COARSE, judge=JudgeConfig(on=False)))
    assert (off.judgement is None and "judge" not in off.seconds) or off.seconds["judge"] < 1
    silent = JudgeConfig(parallax=ParallaxConfig(on=False))
    judgement, _ = judged(submap, frames, config=replace(COARSE, judge=silent))
    assert judgement.images.count == 0 and judgement.blocks.count > 100
    assert judgement.number == judgement.hidden.median


def test_fewer_than_two_folds_are_refused():
    with refused(where="JudgeConfig.folds", found="1", cure="from 2"):
        JudgeConfig(folds=1)


def some(count: int, *errors: float) -> np.ndarray:
    return np.tile(errors, (count, 1)).astype(float)


NONE = np.zeros((0, 2))


def speaking_for(share: float, count: int = 900, size: float = 0.1, noise: float = 0.05) -> np.ndarray:
    """Errors with none and all of a bend, of which distances ask for a share."""
    rng = np.random.default_rng(round(100 * share) + count)
    bend = rng.normal(0, size, count)
    wanted = share * bend + rng.normal(0, noise, count)
    wanted[: count // 10] += rng.choice([-1, 1], count // 10)  # wrong matches
    return np.stack([-wanted, bend - wanted], 1)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.7, 1.0])
def test_a_keyframe_keeps_what_the_images_speak_for_of_its_bend(share):
    found = kept({"a": Tried(speaking_for(share), NONE, 0.5)})["a"]
    assert found.share == pytest.approx(share, abs=0.11)
    assert (found.reason == "") == (found.share == 1) and ("is as good as none" in found.reason) == (found.share == 0)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_submap_keeps_of_a_finer_grid_what_the_images_speak_for(share):
    assert kept_of_finer(speaking_for(share, size=0.03)) == pytest.approx(share, abs=0.21)
    assert kept_of_finer(speaking_for(share, 30)) == 0  # too few
    assert kept_of_finer(speaking_for(share, size=0.03) + 0.2) == 0  # more than detail is wrong
    assert kept_of_finer(speaking_for(share, size=1e-4, noise=0.3)) == 0  # too unsure


def test_depth_is_bent_in_finer_detail_where_the_images_speak_for_it(submap, frames):
    """Depth that is wrong by a ripple four waves wide, which five bumps cannot follow, and points enough to tell."""

    def rippled(frame) -> DepthPrediction:
        right = truth(frame)
        height, width = right.distance.shape
        wave = np.outer(*(np.sin(8 * np.pi * np.arange(n) / n) for n in (height, width)))
        return replace(right, distance=right.distance * np.exp(0.15 * wave).astype(np.float32))

    def bent(submap, config) -> tuple[set[tuple[int, ...]], float]:
        """The grids of the bends, and the median error of the depth that they give."""
        alignments = judged(submap, frames, rippled, config)[1].dense.alignments
        bends = {k.number: a.bend for k, a in zip(submap.keyframes, alignments, strict=True) if a.bend is not None}
        ratios = [
            np.log(bend.applied(rippled(frames[n])).distance / truth(frames[n]).distance) for n, bend in bends.items()
        ]
        errors = np.concatenate([np.abs(r - np.median(r)).ravel() for r in ratios])
        return {grids for bend in bends.values() if (grids := bend.config.grids)}, float(np.median(errors))

    exact = slam(frames, config=EXACT, points_per_keyframe=400).map.submaps[0]
    silent = replace(COARSE, judge=JudgeConfig(parallax=ParallaxConfig(on=False)))
    (fine, error), (five, before) = (bent(exact, c) for c in (COARSE, silent))
    assert fine == {(5, 9)} and five == {(5,)} and error < 0.85 * before


def test_of_fine_detail_that_the_images_speak_against_nothing_is_kept(submap, frames, monkeypatch):
    """Points that are nearer and farther in turn around the axis, where depth is right."""
    first = submap.keyframes[0]
    off = submap.points - np.mean([k.center for k in submap.keyframes], axis=0)
    around = np.arctan2(*(off @ first.cam_from_map[:2, :3].T).T)
    wrong = replace(submap, points=submap.points + off * np.expm1(0.1 * np.sin(9 * around))[:, None])
    shares = []
    monkeypatch.setattr("densify.judgement.kept_of_finer", lambda e: shares.append(kept_of_finer(e)) or shares[-1])
    judged(wrong, frames)
    assert shares == [0.0]


def test_a_keyframe_with_few_distances_keeps_about_what_its_submap_keeps():
    right, wrong = ({f"{n}": Tried(speaking_for(s, 200 + n), NONE, 0.5) for n in range(5)} for s in (1.0, 0.0))
    few = {"few": Tried(speaking_for(0.0, 12), NONE, 0.5)}
    assert kept(right | few)["few"].share >= 0.7 and kept(right)["0"].share == 1
    of_the_wrong = {"few": Tried(speaking_for(1.0, 12), NONE, 0.5)}
    assert kept(of_the_wrong | wrong)["few"].share <= 0.6 and kept(wrong)["0"].share == 0


def test_where_the_images_cannot_tell_hidden_blocks_decide():
    blind = speaking_for(0.5, 300, size=0.003, noise=0.3)
    better, worse = some(900, 0.1, 0.03), some(900, 0.1, 0.2)
    assert kept({"a": Tried(blind, better, 0.5)})["a"].share == 1
    assert kept({"a": Tried(blind, worse, 0.5)})["a"].share == 0


def test_where_the_images_are_silent_hidden_blocks_decide_and_a_bend_beyond_its_prior_goes():
    tried = {
        "better": Tried(NONE, some(900, 0.1, 0.03), 0.8),
        "worse": Tried(NONE, some(900, 0.1, 0.2), 0.8),
        "large": Tried(NONE, some(900, 0.1, 0.03), 2.6),
    }
    found = kept(tried)
    assert {name: k.share for name, k in found.items()} == {"better": 1.0, "worse": 0.0, "large": 0.0}
    assert "hidden blocks" in found["worse"].reason and "2.6 times" in found["large"].reason


def test_a_bend_that_nothing_can_judge_is_undone():
    assert kept({"a": Tried(NONE, NONE, 0.1)})["a"].share == 0
    assert kept({}) == {}


def known(**changes) -> Judgement:
    good = Columns(500, 0.03, 0.02, 0.2, 0.1)
    made = Judgement(good, good, good, surface=Withheld(500, 0.02, 0.1, 0.0, 0.02), keyframes=10, aligned=10)
    return replace(made, **changes)


@pytest.mark.parametrize(
    ("colour", "sentence", "changes"),
    [
        ("green", "2.0%", {}),
        ("amber", "8.0%", {"surface": Withheld(500, 0.08, 0.2, 0.0, 0.08)}),
        ("red", "15.0%", {"surface": Withheld(500, 0.15, 0.3, 0.0, 0.15)}),
        ("amber", "only 4 of 10 keyframes", {"aligned": 4}),
        ("red", "no keyframe", {"aligned": 0}),
        ("green", "2.0% against 2.0%", {"images": Columns(500, 0.03, 0.02, 0.2, 0.02)}),
        ("green", "against the images (8.0% off", {"images": Columns(500, 0.03, 0.08, 0.2, 0.1), "undone": 6}),
        ("amber", "50% of what they see is not", {"surface": Withheld(500, np.inf, np.inf, 0.5, 0.02)}),
        ("red", "infinitely far", {"surface": None, "hidden": None}),
    ],
)
def test_the_verdict_has_a_colour_and_a_reason_with_figures(colour, sentence, changes):
    verdict = known(**changes).verdict
    assert verdict.colour == colour and sentence in verdict.sentence, verdict


def test_a_verdict_says_nothing_twice():
    for surface in (None, Withheld(20, 0.2, 0.3, 0.0, 0.2)):
        for off in (0.08, 0.2):
            said = known(surface=surface, hidden=Withheld(500, off, 0.3, 0.0, off)).verdict.sentence
            assert said.count("hidden blocks") == said.count("the images") == 1, said


def test_the_headline_says_what_of_the_wall_was_seen_well_and_of_several_maps_which_it_is_on():
    near, far = (replace(known(surface=Withheld(500, m, 0.3, 0.0, m)).verdict, seen_well=m * 10) for m in (0.02, 0.08))
    assert headline({0: near}).startswith("green, 20% of the wall seen well: the images put the wall 2.0%")
    assert headline({0: near, 3: far}).startswith("amber (map 3, the worst of 2), 80% of its wall seen well: ")
    assert headline({0: near}, ["doubt"]).startswith("amber, 20% of the wall seen well: doubt; ") and headline({}) == ""
    assert str(known().verdict).startswith("green: ")


@pytest.mark.parametrize("number", [0.02, 0.1, 0.2])
@pytest.mark.parametrize("silent", [True, False])
@pytest.mark.parametrize("aligned", [10, 7, 3])
def test_no_part_of_a_verdict_s_sentence_is_said_twice(number, silent, aligned):
    """Nor a figure, nor that keyframes were aligned where all were."""
    told = Withheld(500, number, 0.3, 0.5, number)
    made = known(surface=None, hidden=told) if silent else known(surface=told)
    against = replace(made, images=Columns(500, 0.031, 0.08, 0.083, 0.083), aligned=aligned)
    parts = against.verdict.sentence.split("; ")
    assert len(set(parts)) == len(parts) and sum(f"{number:.1%}" in part for part in parts) == 1, parts
    assert sum("images have" in part for part in parts) == silent
    assert sum("keyframes" in part for part in parts) == (aligned < 10)


def test_a_better_map_is_proposed_where_the_images_speak_against_it_and_only_there():
    bad, against = Columns(500, 0.07, 0.06, 0.1, 0.1), Columns(500, 0.03, 0.04, 0.1, 0.1)
    good, near, far = Columns(500, 0.03, 0.03, 0.1, 0.1), *(Withheld(500, m, 0.1, 0.0, m) for m in (0.02, 0.08))
    assert proposal(Judgement(good, good, good, surface=near)) == ""
    assert "8.0%" in proposal(Judgement(good, good, good, surface=far))
    assert "--repair-map" in proposal(Judgement(bad, bad, against, surface=near))
    assert proposal(Judgement(bad, bad, against)) == ""  # silent images accuse nobody


def test_the_verdict_on_a_run_is_that_of_its_worst_map():
    green, red = Verdict("green", "a"), Verdict("red", "b")
    assert worst([green, red, green]) is red and worst([]) is None


def test_of_maps_of_one_colour_the_one_that_is_farther_off_speaks_and_its_judge_with_it():
    near, far = (known(surface=Withheld(500, m, 0.3, 0.0, m)).verdict for m in (0.08, 0.11))
    by_map = known(surface=None, hidden=Withheld(500, 0.09, 0.3, 0.0, 0.09)).verdict
    assert {v.colour for v in (near, by_map, far)} == {"amber"}
    assert worst([near, by_map, far]) is far and (far.number, far.judge) == (0.11, "images")
    assert worst([near, by_map]) is by_map and by_map.judge == "map"


def test_a_judge_that_is_switched_off_hides_nothing(submap, monkeypatch):
    monkeypatch.setattr("densify.judgement.submap_folds", lambda *_: pytest.fail("blocks were drawn"))
    assert Judge(submap, DensifyConfig(judge=JudgeConfig(on=False))).braked([]) == []


def test_a_doubtful_pairing_of_frames_and_map_is_never_green():
    result = SubmapResult(DenseMap.empty(slam(colon(0).frames).map.submaps[0], "nothing"), known())
    work = Densified("mine", [result], Gallery(slam(colon(0).frames).map))
    assert work.verdict is not None and work.verdict.colour == "green"
    work.doubts = ("frames and map may be apart",)
    assert work.verdict.colour == "amber" and work.verdict.sentence.startswith("frames and map may be apart; ")
