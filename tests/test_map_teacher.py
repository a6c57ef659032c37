from dataclasses import replace

import numpy as np
import pytest
import torch
from colons import EXACT, colon, slam
from raising import refused

from lightdepth.datasets import FrameSequence
from lightdepth.sparse_map import SparseMap
from train.adapting.map_teacher import MapTeacher, map_terms

SIZE = (48, 40)


@pytest.fixture(scope="module")
def frames() -> FrameSequence:
    found = colon(count=10).frames
    return FrameSequence([f.name for f in found], found.__getitem__, "memory")


@pytest.fixture(scope="module")
def found_map(frames) -> SparseMap:
    return slam(list(frames)).map


def teacher(frames, found_map, withheld=(), seed=0) -> MapTeacher:
    return MapTeacher(frames, found_map, SIZE, withheld, seed)


def lesson_of_two(taught: MapTeacher):
    return next(lesson for lesson in map(taught.lesson, range(50)) if len(lesson.keyframes) == 2)


def truth(lesson, scales=(1.0, 1.0)) -> torch.Tensor:
    known = lesson.batch.true_distance.clamp(min=1e-3)
    return known * torch.tensor(scales).reshape(-1, 1, 1, 1)


def test_true_distance_has_nothing_to_learn_whatever_its_scale_in_each_image(frames, found_map):
    lesson = lesson_of_two(teacher(frames, found_map))
    right = map_terms(truth(lesson), lesson)
    assert right["points"] < 0.05 and right["overlap"] < 0.05
    scaled = map_terms(truth(lesson, (3.0, 0.2)), lesson)
    for name, value in right.items():
        assert scaled[name] == pytest.approx(float(value), rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("term", ["points", "overlap"])
def test_each_term_pulls_a_bent_distance_back(frames, found_map, term):
    lesson = lesson_of_two(teacher(frames, found_map))
    true = truth(lesson)
    u = torch.linspace(-1, 1, SIZE[0]).expand_as(true)
    v = torch.linspace(-1, 1, SIZE[1])[:, None].expand_as(true)
    weights = torch.tensor([0.3, -0.2]).requires_grad_()

    def bent():
        return true * (weights[0] * u + weights[1] * v).exp()

    first = float(map_terms(bent(), lesson)[term].detach())
    optimizer = torch.optim.Adam([weights], lr=0.02)
    for _ in range(60):
        optimizer.zero_grad()
        map_terms(bent(), lesson)[term].backward()
        optimizer.step()
    assert float(map_terms(bent(), lesson)[term].detach()) < 0.5 * first
    assert weights.detach().abs().max() < 0.12


def test_wrong_points_teach_nothing(frames):
    lesson = teacher(frames, slam(list(frames), config=EXACT).map).lesson(0)
    keyframe = lesson.keyframes[0]
    wrong = keyframe.distances.copy()
    wrong[::3] *= 4.0
    spoiled = replace(lesson, keyframes=(replace(keyframe, distances=wrong), *lesson.keyframes[1:]))
    distance = truth(lesson)
    clean, found = (map_terms(distance, which)["points"] for which in (lesson, spoiled))
    assert found == pytest.approx(float(clean), abs=0.02)


def test_points_that_a_withheld_keyframe_saw_are_never_shown(frames, found_map):
    submap = found_map.submaps[0]
    withheld = [k.number for k in submap.keyframes[-2:]]
    hidden = np.concatenate([submap.observed_points(k)[0] for k in submap.keyframes[-2:]])
    spoiled = replace(submap, points=np.where(np.isin(submap.point_ids, hidden)[:, None], 1e3, submap.points))

    def shown(of):
        return {k.frame: k.distances for k in teacher(frames, SparseMap((of,), "map"), withheld).keyframes}

    before, after = shown(submap), shown(spoiled)
    assert {frames.numbers[row] for row in before}.isdisjoint(withheld)
    assert np.isin(submap.observed_points(submap.keyframes[-3])[0], hidden).any()
    assert before.keys() == after.keys() and all(np.array_equal(before[row], after[row]) for row in before)


def test_a_lesson_follows_from_seed_and_step(frames, found_map):
    def chosen(seed):
        return [tuple(k.frame for k in teacher(frames, found_map, seed=seed).lesson(s).keyframes) for s in range(12)]

    assert chosen(0) == chosen(0) != chosen(1)


def test_keyframes_of_two_submaps_never_meet(frames, found_map):
    first = found_map.submaps[0]
    halves = [replace(first, id=i, keyframes=part) for i, part in enumerate((first.keyframes[:3], first.keyframes[3:]))]
    taught = teacher(frames, SparseMap(tuple(halves), "two"))
    names = [{frames.numbers.index(k.number) for k in half.keyframes} for half in halves]
    for keyframe in taught.keyframes:
        own = next(group for group in names if keyframe.frame in group)
        assert {taught.keyframes[p].frame for p in keyframe.partners} <= own - {keyframe.frame}


def test_a_map_that_has_nothing_left_to_teach_is_named(frames, found_map):
    with refused(found="no keyframe to learn from has 8 points"):
        teacher(frames, found_map, frames.numbers)
