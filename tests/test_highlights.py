"""Which white pixels are highlights."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from test_losses import LAMBERT, spoilt, tube_batch

from lightdepth.losses import Seen, self_supervised_loss
from lightdepth.losses.highlights import highlights

SIZE, CONTRAST = 0.005, 0.1


def wall(height: int = 112, width: int = 140, value: float = 0.5) -> torch.Tensor:
    return torch.full((1, 1, height, width), value)


def found(v: torch.Tensor, mask: torch.Tensor | None = None, size: float = SIZE, contrast: float = CONTRAST):
    mask = torch.ones_like(v, dtype=torch.bool) if mask is None else mask
    return highlights(v, mask & (v >= 0.97), mask, size, contrast)


def test_a_small_white_patch_on_darker_wall_is_a_highlight_and_near_wall_that_clips_is_none():
    v = wall()
    v[..., 20:24, 30:35] = 1.0
    v[..., 60:100, 60:120] = 1.0
    expected = torch.zeros_like(v, dtype=torch.bool)
    expected[..., 20:24, 30:35] = True
    assert torch.equal(found(v), expected)
    assert torch.equal(found(v, size=1.0, contrast=0.0), v >= 0.97)


def test_a_patch_into_which_brightness_rises_slowly_is_the_top_of_a_wall_and_no_highlight():
    rows, columns = torch.meshgrid(torch.arange(112.0), torch.arange(140.0), indexing="ij")
    v = (1.0 - 0.01 * torch.hypot(rows - 50, columns - 70))[None, None].clamp(min=0.2)
    assert 0 < (v >= 0.97).float().mean() < SIZE
    assert not found(v).any() and torch.equal(found(v, contrast=0.0), v >= 0.97)


@pytest.mark.parametrize(("border", "ring", "kept"), [(0.0, 0.95, False), (0.96, 0.85, True)])
def test_a_patch_is_compared_with_the_ring_behind_its_border_and_neither_with_the_border_nor_with_itself(
    border, ring, kept
):
    v = wall(value=ring)
    v[..., 19:26, 29:36] = border  # one pixel wide
    v[..., 20:25, 30:35] = 1.0
    assert torch.equal(found(v), (v >= 0.97) & kept)


def test_size_is_a_share_of_the_mask_and_the_widths_grow_with_the_image():
    v = wall()
    v[..., 20:27, 30:37] = 1.0
    half = torch.ones_like(v, dtype=torch.bool)
    assert found(v).sum() == 49  # of 15680
    half[..., 70:] = False
    assert not found(v, half).any()
    large = torch.nn.functional.interpolate(v, scale_factor=3, mode="bilinear")  # a border of mixed pixels
    assert found(large).sum() == (large >= 0.97).sum() > 0


def test_patches_that_touch_at_a_corner_are_one_and_each_image_is_on_its_own():
    v = wall().repeat(2, 1, 1, 1)
    v[0, :, 20:27, 30:37] = v[0, :, 27:34, 37:44] = 1.0
    v[1, :, 20:27, 30:37] = 1.0
    assert found(v).sum((1, 2, 3)).tolist() == [0, 49]


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_an_image_of_one_brightness_or_without_a_mask_has_no_highlight(value):
    v = wall(value=value)
    assert not found(v).any()
    assert not found(v, torch.zeros_like(v, dtype=torch.bool), size=1.0).any()
    assert not found(v, size=1.0).any()  # a patch with nothing around it


def test_the_specular_term_turns_highlights_towards_the_light_and_leaves_the_rest_to_the_inequality():
    batch, colour = tube_batch(64, 80)
    image = batch.image * 0.8 / batch.image.amax()
    image[..., 30:33, 30:33] = 1.0
    image[..., 50:, :] = 1.0
    batch = batch._replace(image=image)
    config = replace(LAMBERT, specular=1.0, saturated=1.0)
    seen = Seen.of(batch, config)
    assert seen.highlights is not None and seen.highlights.sum((1, 2, 3)).tolist() == [9, 9]
    assert Seen.of(batch, LAMBERT).highlights is None
    distance = spoilt(batch.true_distance).requires_grad_()
    _, terms = self_supervised_loss(distance, colour, batch, config)
    (shine,) = torch.autograd.grad(terms["specular"], distance, retain_graph=True)
    (held,) = torch.autograd.grad(terms["saturated"], distance)
    assert shine[..., 29:34, 29:34].abs().sum() > 0 == shine[..., 45:, :].abs().sum() < held[..., 52:, :].abs().sum()
