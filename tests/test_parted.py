"""Several processes see together, in every step, what one would see whose batch is as large as all theirs."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from training import batch_of

from train.augmentation import augmented
from train.order import ALONE, Halves, Parted, Place, Shuffled

BATCH = 2


def shuffled(batch: int) -> Shuffled:
    return Shuffled(25, seed=3)


def halves(batch: int) -> Shuffled:
    return Halves(13, 7, batch, seed=3)


def steps(rows: list[int], size: int) -> list[list[int]]:
    """Whole batches."""
    return [sorted(rows[i : i + size]) for i in range(0, len(rows) - size + 1, size)]


@pytest.mark.parametrize("world", [2, 3])
@pytest.mark.parametrize("order", [shuffled, halves])
def test_a_step_of_several_processes_has_the_rows_of_one_with_all_their_batch(order, world):
    whole, parts = order(BATCH * world), [Parted(order(BATCH * world), BATCH, Place(r, world)) for r in range(world)]
    met = []
    for epoch in (0, 1):
        whole.set_epoch(epoch)
        for part in parts:
            part.set_epoch(epoch)
        own = [list(part) for part in parts]
        assert len({len(rows) for rows in own}) == 1 and all(
            len(rows) == len(p) for rows, p in zip(own, parts, strict=True)
        )
        together = [row for i in range(0, len(own[0]), BATCH) for rows in own for row in rows[i : i + BATCH]]
        assert steps(together, BATCH * world) == steps(whole.rows(), BATCH * world)
        assert [p.batch(1) for p in parts] == [rows[BATCH : 2 * BATCH] for rows in own]
        met.append(own)
    assert met[0] != met[1]


def test_no_row_is_seen_twice_in_an_epoch_by_whatever_process():
    own = [list(Parted(shuffled(4), BATCH, Place(r, 2))) for r in range(2)]
    assert len({*own[0], *own[1]}) == len(own[0]) + len(own[1]) == 24


def test_in_each_process_half_of_a_batch_is_of_each_kind():
    for rank in range(2):
        rows = np.array(list(Parted(halves(4), BATCH, Place(rank, 2)))).reshape(-1, BATCH)
        assert ((rows < 13).sum(1) == 1).all()


def test_of_fewer_rows_than_one_batch_of_all_each_process_has_as_many():
    parts = [Parted(Shuffled(3, 0), 4, Place(r, 2)) for r in range(2)]
    own = [list(part) for part in parts]
    assert [len(rows) for rows in own] == [len(part) for part in parts] == [2, 2]
    assert {*own[0], *own[1]} == {0, 1, 2}


def test_a_resumed_epoch_goes_on_at_its_batch_and_the_next_one_begins_at_its_first():
    part, again = Parted(shuffled(4), BATCH, Place(1, 2)), shuffled(4)
    again.go_on(1, rows=3 * BATCH * 2)
    resumed = Parted(again, BATCH, Place(1, 2))
    for epoch, past in ((1, 3 * BATCH), (2, 0)):
        part.set_epoch(epoch)
        resumed.set_epoch(epoch)
        assert list(resumed) == list(part)[past:]


def test_parts_of_a_batch_are_changed_as_the_whole_of_it_is():
    whole = batch_of(6)
    expected = augmented(whole, torch.Generator().manual_seed(4), ALONE)
    for rank in range(3):
        part = whole._replace(
            **{
                name: getattr(whole, name)[rank::3] for name in ("image", "mask", "rays", "true_distance", "true_valid")
            },
            light=type(whole.light)(*(value[rank::3] for value in whole.light)),
        )
        found = augmented(part, torch.Generator().manual_seed(4), Place(rank, 3))
        assert torch.equal(found.image, expected.image[rank::3])
        assert torch.equal(found.rays, expected.rays[rank::3])
