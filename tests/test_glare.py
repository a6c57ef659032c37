"""A rim of glare between black border and image: found where it is one, and no wall is taken for it."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from colons import colon

from lightdepth.camera import Pinhole
from lightdepth.datasets.glare import rim_of_glare
from lightdepth.datasets.sequence import border_mask, border_region

CAMERA = Pinhole(320, 256, 160.0, 160.0, 160.0, 128.0)
ROWS, COLUMNS = np.mgrid[:256, :320] + 0.5
CIRCLE = np.hypot(COLUMNS - 160, ROWS - 128) < 122


@cache
def frames(seed: int = 3) -> list[np.ndarray]:
    """A colon through a round opening."""
    return [f.image * CIRCLE[..., None] for f in colon(seed, 6, 30.0, CAMERA).frames]


def with_rim(images: list[np.ndarray], width: float, level: float, part: float = 1.0) -> tuple[list, np.ndarray]:
    """The images with a rim, pixels wide, along a part of the border; and the rim."""
    angle = np.arctan2(ROWS - 128, COLUMNS - 160) / (2 * np.pi) % 1
    rim = CIRCLE & (cv2.distanceTransform(CIRCLE.astype(np.uint8), cv2.DIST_L2, 5) <= width) & (angle < part)
    colour = np.array([level, level, 0.96 * level], np.float32)
    shining = [np.where(rim[..., None], colour, image).astype(np.float32) for image in images]
    return [cv2.GaussianBlur(image, (0, 0), 0.7) for image in shining], rim


@pytest.mark.parametrize(("width", "level", "part"), [(2, 0.7, 1.0), (4, 0.95, 1.0), (7, 0.8, 0.6)])
def test_a_rim_goes_with_the_border_and_the_image_stays(width, level, part):
    images, rim = with_rim(frames(), width, level, part)
    mask, whole = border_mask(images), border_mask(frames())
    assert (mask & rim).sum() < 0.05 * rim.sum()
    assert (mask & whole & ~rim).sum() > 0.975 * (whole & ~rim).sum()


@pytest.mark.parametrize("seed", [3, 4, 5])
@pytest.mark.parametrize("exposed", [1.0, 2.5])
def test_no_wall_is_taken_for_a_rim_however_bright_nor_in_a_film_that_stands_still(seed, exposed):
    images = [np.clip(exposed * image, 0, 1) for image in frames(seed)]
    for film in (images, [images[0]] * 6, [np.ones_like(images[0]) * CIRCLE[..., None]] * 6):
        assert not rim_of_glare(film, border_region(film)).any()
    assert not rim_of_glare(images, np.ones_like(CIRCLE)).any()  # no border


def test_what_few_images_show_or_a_small_part_of_the_border_is_left():
    images, _ = with_rim(frames(), 4, 0.95)
    assert not rim_of_glare(images[:3], CIRCLE).any() and rim_of_glare(images[:4], CIRCLE).any()
    part, _ = with_rim(frames(), 4, 0.95, part=0.2)
    assert not rim_of_glare(part, CIRCLE).any()


def test_a_rim_that_shines_in_some_images_alone_is_left():
    images, _ = with_rim(frames(), 4, 0.95)
    assert not rim_of_glare([*images[:5], 0.3 * frames()[5]], CIRCLE).any()


def test_a_bright_band_that_is_not_as_wide_on_all_sides_is_wall():
    angle = np.arctan2(ROWS - 128, COLUMNS - 160)
    depth = cv2.distanceTransform(CIRCLE.astype(np.uint8), cv2.DIST_L2, 5)
    band = CIRCLE & (depth <= 5 + 4 * np.sin(5 * angle))
    images = [np.where(band[..., None], np.float32(0.95), image).astype(np.float32) for image in frames()]
    assert not rim_of_glare(images, CIRCLE).any()
