"""Burnt-in text: patients' names, dates, logos. What stands still and has sharp edges while the tissue moves.

Over some frames of a stretch of the video, text has strong local contrast in the mean picture (moving tissue averages
out) and hardly any deviation. Digits that count deviate, but their place always has contrast: the boxes around what
stands still are widened into it. Whole boxes are taken, not strokes: black strokes can be read as well as white ones.

A line of text that was found goes on over what stands still in its rows: letters on the rim of the tissue go with it.
Text that is shown for less than a stretch, while the camera stands still, or on the rim alone (2.5 % of the height) is
not found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

STRETCH, STRETCHES = 12, 4
"""Frames that are looked at together, and how many such groups at most."""
MOVING = 6.0
"""Median deviation of tissue [of 255] from which on text can be told from it."""
_CONTRAST = 40.0
_FILLED = 0.2  # of a line of text's box, once its letters are joined, much more is filled


@dataclass(frozen=True)
class Overlay:
    """mask (H, W) bool, True on the boxes of text; whether the tissue moved enough for text on it to be told."""

    mask: np.ndarray
    moved: bool
    boxes: list[tuple[int, int, int, int]]


def find_overlay(images: Sequence[np.ndarray], tissue: np.ndarray) -> Overlay:
    """Text on and beside `tissue` (H, W) bool, in images (H, W, 3) uint8 in the order of time."""
    count = max(1, min(STRETCHES, len(images) // STRETCH))
    height, width = tissue.shape
    found, still, moved = np.zeros(tissue.shape, np.uint8), np.zeros(tissue.shape, bool), False
    for part in np.array_split(np.arange(len(images)), count):
        enough, text, standing = _static_text([images[i] for i in part], tissue)
        moved |= enough
        found = np.maximum(found, text)
        still |= standing
    line = max(3, round(0.012 * height))
    joined = cv2.morphologyEx(found, cv2.MORPH_CLOSE, np.ones((line, 3 * line), np.uint8))
    mask, boxes = np.zeros(tissue.shape, bool), []
    number, labels, stats, _ = cv2.connectedComponentsWithStats(joined)
    for label in range(1, number):
        x, y, w, h, area = stats[label]
        if area < _FILLED * w * h:  # a long thin curve, a frame or a scale: no text is hidden in its box
            mask |= cv2.dilate((labels == label).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
            boxes.append((int(x), int(y), int(w), int(h)))
            continue
        x, w = _stretched(still[y : y + h], x, w, h)
        pad = 2 + round(0.15 * h)
        left, top, right, bottom = max(0, x - pad), max(0, y - pad), min(width, x + w + pad), min(height, y + h + pad)
        mask[top:bottom, left:right] = True
        boxes.append((int(left), int(top), int(right - left), int(bottom - top)))
    return Overlay(mask, moved, boxes)


def _stretched(still: np.ndarray, x: int, w: int, h: int) -> tuple[int, int]:
    """Place and width of a line of text, over what else stands still in its rows (h, W): letters on the rim."""
    left, right = x, x + w
    while (more := np.flatnonzero(still[:, max(0, left - h) : left].any(0))).size:
        left = max(0, left - h) + int(more[0])
    while (more := np.flatnonzero(still[:, right : right + h].any(0))).size:
        right += int(more[-1]) + 1
    return left, right - left


def _static_text(images: Sequence[np.ndarray], tissue: np.ndarray) -> tuple[bool, np.ndarray, np.ndarray]:
    """Whether the tissue moved in images (H, W, 3); (H, W) uint8, 1 on text and on what counts beside it; and (H, W)
    bool, all that stands still with sharp edges, the rim of the optic too.

    Channels count apart: green text can be as bright as the tissue behind it.
    """
    height = tissue.shape[0]
    mean, deviation = _moments(images)
    # Optics have a bright rim of their own, as still as text.
    rim = max(3, round(0.025 * height))
    inner = cv2.erode(np.pad(tissue.astype(np.uint8), 1), np.ones((2 * rim + 1,) * 2, np.uint8))[1:-1, 1:-1] > 0
    beside = cv2.dilate(tissue.astype(np.uint8), np.ones((7, 7), np.uint8)) == 0
    seeds = beside & (mean.max(-1) > _CONTRAST)  # what shines beyond the border is no tissue
    window = np.ones((max(3, round(0.01 * height)) | 1,) * 2, np.uint8)
    motion = float(np.median(deviation.max(-1)[inner])) if len(images) >= 5 and inner.any() else 0.0
    moved, standing = motion >= MOVING, seeds
    if moved:
        still = (deviation < np.minimum(0.3 * motion, 2 + 0.06 * mean.max(-1, keepdims=True))).all(-1)
        contrast = (cv2.dilate(mean, window) - cv2.erode(mean, window)).max(-1) > _CONTRAST
        standing = seeds | (still & contrast & (mean.max(-1) > 24))
        seeds = seeds | (standing & inner)
    found = _without_specks(seeds.astype(np.uint8), max(4, round(8e-6 * tissue.size)))
    grown = cv2.dilate(found, np.ones((3, 3), np.uint8))
    if moved and found.any():
        # Where digits change, contrast stays: low in few frames only.
        spread = [cv2.subtract(cv2.dilate(image, window), cv2.erode(image, window)).max(-1) for image in images]
        always = np.partition(np.stack(spread), len(spread) // 10, axis=0)[len(spread) // 10] > 1.5 * _CONTRAST
        reach = cv2.dilate(grown, np.ones((3, max(3, round(0.12 * height)) | 1), np.uint8))
        counting = (always & (reach > 0) & inner).astype(np.uint8)
        grown = np.maximum(grown, cv2.morphologyEx(counting, cv2.MORPH_OPEN, np.ones((5, 3), np.uint8)))
    return moved, grown, standing


def _moments(images: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation over images (H, W, 3) uint8, float32 of the same shape."""
    total, squares = np.zeros(images[0].shape, np.float32), np.zeros(images[0].shape, np.float32)
    for image in images:
        cv2.accumulate(image, total)
        cv2.accumulateSquare(image, squares)
    mean = total / len(images)
    return mean, np.sqrt(np.maximum(squares / len(images) - mean * mean, 0))


def _without_specks(found: np.ndarray, least: int) -> np.ndarray:
    """Without what is too small and alone to be a letter: letters of a word are joined first."""
    size = max(3, round(0.02 * found.shape[0])) | 1
    joined = cv2.dilate(found, np.ones((size, size), np.uint8))
    number, labels = cv2.connectedComponents(joined)
    pixels = np.bincount(labels[found > 0], minlength=number)
    result: np.ndarray = found * (pixels[labels] >= 3 * least)
    return result
