from dataclasses import replace

import numpy as np
import pytest
from colons import colon, sequence, slam
from colons import truth as known_truth

from lightdepth.models import ConstantModel
from train.adapting.map_teacher import MapTeacher
from train.adapting.wall_judge import FOLDS, compared, wall_judge


@pytest.fixture(scope="module")
def frames():
    return sequence(colon(count=10).frames)


@pytest.fixture(scope="module")
def found_map(frames):
    return slam(list(frames)).map


def truth(frame):
    """What is true of a frame, asked of one that has lost its truth."""
    return known_truth(colon(count=10).frames[frame.number])


def bent(frame, by: float = 1.2):
    """The truth with its left half too far."""
    said = truth(frame)
    wrong = said.distance.copy()
    wrong[:, : wrong.shape[1] // 2] *= by
    return replace(said, distance=wrong)


def judge_of(frames, found_map, taught=False):
    return wall_judge(frames, frames[8:], found_map, taught, 0)


def test_blocks_tell_the_better_of_two_models_in_spite_of_wrong_points(frames, found_map):
    judge = judge_of(frames, found_map)
    right, wrong = judge.errors(truth), judge.errors(bent)
    better, worse = compared(wrong, right), compared(right, wrong)
    assert better is not None and worse is not None and better.blocks >= 8
    assert better.change < -2 * better.deviation and worse.change > 2 * worse.deviation
    assert better.before == pytest.approx(worse.after) and set(right.frames) == set(frames[8:].numbers)
    same = compared(right, right)
    assert same is not None and same.change == 0 and same.deviation == 0


def test_the_scale_of_each_frame_says_nothing(frames, found_map):
    judge = judge_of(frames, found_map)

    def scaled(frame):
        said = truth(frame)
        return replace(said, distance=said.distance * (1.0 + 0.3 * frame.number))

    found = compared(judge.errors(truth), judge.errors(scaled))
    assert found is not None and abs(found.change) < 1e-4


def test_what_judges_is_hidden_from_the_teacher_in_whole_blocks(frames, found_map):
    judge, submap = judge_of(frames, found_map, taught=True), found_map.submaps[0]
    hidden, part = judge.hidden()[submap.id], judge.parts[submap.id]
    assert 0.1 < len(hidden) / len(submap.points) < 0.35
    for block in np.unique(part.blocks[part.blocks >= 0]):
        assert len(np.unique(part.folds[part.blocks == block])) == 1

    def shown(of):
        taught = MapTeacher(frames, replace(found_map, submaps=(of,)), (48, 40), frames[8:].numbers, 0, judge.hidden())
        return [k.distances for k in taught.keyframes]

    moved = np.where(np.isin(submap.point_ids, hidden)[:, None], submap.points + 7.0, submap.points)
    for before, after in zip(shown(submap), shown(replace(submap, points=moved)), strict=True):
        assert np.array_equal(before, after)


def test_where_the_map_teaches_only_hidden_blocks_and_held_out_frames_judge(frames, found_map):
    judge, submap = judge_of(frames, found_map, taught=True), found_map.submaps[0]
    before = judge.errors(bent)
    part = judge.parts[submap.id]
    seen = np.isin(submap.point_ids, np.concatenate([k.point_ids for k in submap.keyframes if k.number in judge.held]))
    judging = {(submap.id, i) for i in submap.point_ids[(part.folds == 0) | seen].tolist()}
    assert len(before.points) > 0 and set(before.points) <= judging
    assert max(part.folds) == FOLDS - 1


def test_too_few_blocks_tell_nothing(frames, found_map):
    submap = found_map.submaps[0]
    few = replace(found_map, submaps=(replace(submap, point_ids=submap.point_ids[:20], points=submap.points[:20]),))
    judge = judge_of(frames, few)
    assert compared(judge.errors(truth), judge.errors(ConstantModel())) is None
