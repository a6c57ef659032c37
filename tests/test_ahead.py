"""A live surface judged by the points that the map measures after it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from colons import EXACT, colon, slam, truth
from test_judging import side_moved
from test_live import fed, points_of

from densify.config import LiveConfig
from densify.judging.ahead import NOTHING, Ahead, AheadConfig, running
from densify.judging.verdict import ahead_verdict
from densify.judging.withheld import Withheld
from densify.live.densifier import Densifier
from densify.live.play import Finished
from lightdepth.camera import Pinhole
from lightdepth.parallax import ParallaxConfig


@pytest.fixture(scope="module")
def frames():
    return colon(0, 10, 12.0).frames[:5]


@pytest.fixture(scope="module")
def submap(frames):
    return slam(frames, config=EXACT).map.submaps[0]


def judged(live: Densifier) -> Ahead:
    return Ahead.of(live.ahead, len(live.alignments), sum(a.ok for a in live.alignments))


def test_true_depth_agrees_with_points_that_come_later_and_a_constant_does_not(frames, submap):
    live = fed(Densifier(truth), frames, submap)
    known = set()
    for keyframe, errors in zip(submap.keyframes, live.ahead, strict=True):
        new = set(keyframe.point_ids.tolist()) - known
        assert len(errors) <= (len(new) if known else 0)
        known |= new
    found = judged(live)
    assert found.columns.count > 60 and found.number < 0.002 < found.columns.constant
    assert found.verdict.colour == "amber" and "not the images" in found.verdict.sentence
    assert found.record()["delivered"]["points"] == found.columns.count


def test_a_keyframe_s_new_points_are_asked_before_they_are_used(frames, submap):
    """They are all 1.3 times as far: depth from before knows nothing of that, however well they are fitted later."""
    one, two = submap.keyframes[:2]
    live = fed(Densifier(truth), frames, submap, [one])
    points, new = points_of(submap, two), ~np.isin(two.point_ids, one.point_ids)
    farther = one.center + np.where(new[:, None], 1.3, 1) * (points - one.center)
    live.add_keyframe(frames[1], two, farther)
    errors = live.ahead[1]
    assert len(errors) > 5 and np.median(errors[:, 4]) == pytest.approx(1 - 1 / 1.3, abs=0.03)


def test_a_surface_that_was_moved_is_asked_where_it_is_now(frames, submap):
    """The whole map moves aside and grows by a half: new points come in the new frame."""
    one, two = submap.keyframes[:2]
    still = fed(Densifier(truth), frames, submap, [one, two])

    def moved(keyframe):
        pose = keyframe.cam_from_map.copy()
        pose[:3, 3] = 1.5 * pose[:3, 3] - 1.5 * pose[:3, :3] @ [3.0, 1.0, 2.0]
        return replace(keyframe, cam_from_map=pose)

    live = fed(Densifier(truth), frames, submap, [one])
    live.update_poses({one.name: moved(one).cam_from_map}, submap.point_ids, 1.5 * (submap.points + [3.0, 1.0, 2.0]))
    live.add_keyframe(frames[1], moved(two), 1.5 * (points_of(submap, two) + [3.0, 1.0, 2.0]))
    assert np.allclose(live.ahead[1], still.ahead[1], atol=1e-3)


def test_what_nobody_asks_costs_nothing_and_is_not_judged(frames, submap):
    live = fed(Densifier(truth, LiveConfig(judge=AheadConfig(on=False))), frames, submap)
    assert not sum(map(len, live.ahead)) and judged(live).columns.count == 0
    assert judged(live).verdict.colour == "amber" and "too few" in judged(live).verdict.sentence


def test_points_of_a_submap_that_was_taken_over_are_new_no_more(frames, submap):
    first, last = submap.keyframes[:2], submap.keyframes[2:4]
    live, other = fed(Densifier(truth), frames, submap, first), fed(Densifier(truth), frames, submap, last)
    live.adopt(other, {k.name: k.cam_from_map for k in last})
    assert len(live.ahead) == 4
    again = replace(last[-1], name="77")
    live.add_keyframe(frames[3], again, points_of(submap, again))
    assert not len(live.ahead[-1])


def test_the_verdict_is_amber_at_best_and_red_where_new_points_are_far_off():
    def of(fused: float, constant: float, count: int = 100, aligned: int = 4):
        row = np.array([fused, fused, constant, constant, fused])
        return Ahead.of([np.tile(row, (count, 1))], 4, aligned)

    assert of(0.01, 0.3).verdict.colour == "amber" and "adds nothing" not in of(0.01, 0.3).verdict.sentence
    assert of(0.2, 0.3).verdict.colour == "red" and "20.0%" in of(0.2, 0.3).verdict.sentence
    assert "adds nothing" in of(0.05, 0.05).verdict.sentence
    assert "only 1 of 4" in of(0.01, 0.3, aligned=1).verdict.sentence
    assert of(0.01, 0.3, aligned=0).verdict.colour == "red"
    assert ahead_verdict(Ahead.of([], 4, 4).columns, np.inf, None, 4, 4).colour == "amber"


@pytest.mark.parametrize(("met", "colour"), [(0.02, "green"), (0.08, "amber"), (0.2, "red")])
def test_where_the_images_speak_the_verdict_is_by_them_as_in_densify(met, colour):
    """New points lie at the rim, where a surface is off by more: what they say is a remark."""
    row = np.array([0.2, 0.2, 0.4, 0.4, 0.2])
    errors, surface = [np.tile(row, (100, 1))], Withheld(500, met, 0.3, 0.0, met)
    found = Ahead.of(errors, 4, 4, surface)
    assert (found.verdict.colour, found.number, found.judge) == (colour, met, "images"), found.verdict
    assert "new points of the map were 20.0%" in found.verdict.sentence
    assert Ahead.of(errors, 4, 1, surface).verdict.colour != "green"
    assert Ahead.of(errors, 4, 4, replace(surface, points=20)).verdict.colour == "red"


def test_a_finished_surface_is_held_against_its_images_from_what_was_kept_of_them():
    """Points of one side that are farther together bend every keyframe, and the images see it."""
    frames = colon(0, 6, 10.0, Pinhole(128, 96, 70.0, 70.0, 64.0, 48.0)).frames
    submap = slam(frames, spurious=0.05, points_per_keyframe=120).map.submaps[0]
    right = fed(Densifier(truth), frames, submap)
    wrong = fed(Densifier(truth), frames, side_moved(submap, 1.1))
    good, bad = (Finished.of(live).by_images for live in (right, wrong))
    assert good.points > 60 and good.median_met < 0.03 and bad.median_met > 1.25 * good.median_met
    assert Densifier(truth, LiveConfig(judge=AheadConfig(parallax=ParallaxConfig(on=False)))).seen() == {}


def test_medians_run_over_all_keyframes_so_far():
    found = running([NOTHING, np.array([[0.1, 0.1, 0.4, 0.3, 0.1]]), NOTHING, np.full((2, 5), 0.2)])
    assert np.isnan(found[0]).all()
    assert np.allclose(found[1:], [[0.1, 0.3], [0.1, 0.3], [0.2, 0.2]])
