"""Points that lie together are withheld together."""

import numpy as np
import pytest

from lightdepth.blocks import hidden_in_turn, wall_blocks, wall_folds


@pytest.fixture
def wall():
    """Points on a plane of 20 by 20."""
    rng = np.random.default_rng(0)
    return np.column_stack([rng.random((4000, 2)) * 20, np.zeros(4000)])


def test_points_of_a_block_lie_within_its_diagonal(wall):
    blocks = wall_blocks(wall, 3.0)
    for block in range(blocks.max() + 1):
        assert np.ptp(wall[blocks == block], axis=0).max() <= 3 * np.sqrt(3)


def test_folds_are_made_of_whole_blocks_of_about_as_many_points_each(wall):
    blocks, folds = wall_blocks(wall, 3.0), wall_folds(wall, 3.0)
    assert all(len(np.unique(folds[blocks == block])) == 1 for block in range(blocks.max() + 1))
    counts = np.bincount(folds)
    assert len(counts) == 5 and counts.max() < 1.3 * counts.min()


def test_the_nearest_point_of_another_fold_is_mostly_far(wall):
    """Drawn one by one, it would be .16 away in the median."""
    folds = wall_folds(wall, 4.0)
    others = [
        np.linalg.norm(wall[folds != fold][None] - wall[i, None], axis=-1).min() for i, fold in enumerate(folds[:300])
    ]
    assert np.median(others) > 0.4


def test_another_seed_draws_other_blocks_and_the_same_seed_the_same(wall):
    assert (wall_folds(wall, 3.0, seed=1) == wall_folds(wall, 3.0, seed=1)).all()
    assert (wall_blocks(wall, 3.0, seed=1) != wall_blocks(wall, 3.0, seed=2)).any()


def test_a_small_wall_still_has_a_block_for_every_fold(wall):
    assert len(np.unique(wall_folds(wall / 10, 5.0))) == 5


def test_one_point_is_one_block():
    assert wall_folds(np.zeros((1, 3)), 1.0).tolist() == [0]


def test_each_fold_is_hidden_once_and_what_is_no_fold_never():
    folds = np.array([2, 0, -1, 2, 5])
    turns = [(hidden.tolist(), used.tolist()) for hidden, used in hidden_in_turn(folds)]
    assert [hidden for hidden, _ in turns] == [[f == fold for f in folds.tolist()] for fold in (0, 2, 5)]
    assert all(used == [not h for h in hidden] for hidden, used in turns)
    assert [hidden.sum() for hidden, _ in hidden_in_turn(folds, (1, 2))] == [0, 2]
