"""A rim of glare between a black border and the image: light that the edge of the optic throws back.

Such a rim is no tissue, but shines, and so is taken for image by whoever looks for black. What tells it from
overexposed wall, which reaches the border in many a frame: it adjoins the border, is thin, pale and bright in every
image, and ends as sharply as an edge does, where wall fades. All of this is asked around the image, sector by sector.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

_IMAGES = 4  # of fewer, nothing tells a rim from wall that happens to be bright
_SECTORS = 72
_AROUND = 0.4  # of the sectors that have a border, that must have a rim
_PALE = 0.2  # saturation, above which it is tissue
_BRIGHT = 0.45  # of the darkest channel, in every image
_DROP, _TINGED = 0.65, 0.15  # that channel falls to such a share where the rim ends, or saturation rises by so much
_UNLIKE = 0.25  # of the rim's usual width, by which a sector's may differ
_NEAR, _FEW = 3, 3  # sectors to either side of one that take it along, where so many of them have a rim
_WIDEST, _EDGE, _BEGINS, _MARGIN = 0.04, 0.012, 0.012, 0.004  # of the image's height


def rim_of_glare(images: Sequence[np.ndarray], region: np.ndarray) -> np.ndarray:
    """(H, W) bool: the rim, of images (H, W, 3) of one camera in [0, 1] whose black border is what is not `region`
    (H, W). Nothing where there is none, no border, or too few images to tell."""
    nothing = np.zeros(region.shape, bool)
    same = [image for image in images if image.shape[:2] == region.shape]
    if len(same) < _IMAGES or region.all() or not region.any():
        return nothing
    height = region.shape[0]
    from_border = cv2.distanceTransform(region.astype(np.uint8), cv2.DIST_L2, 5)
    bins = int(np.ceil((_WIDEST + 2 * _EDGE) * height)) + 1
    rows, columns = np.nonzero(region & (from_border < bins))
    depth = from_border[rows, columns].astype(int).clip(max=bins - 1)
    sector = _sectors(region, rows, columns)
    pixels = np.stack([image[rows, columns] for image in same])  # (images, n, 3)
    low, top = pixels.min(-1), pixels.max(-1)
    pale = np.median((top - low) / np.maximum(top, 1e-3), axis=0)
    cell = sector * bins + depth
    darkest, typical, saturation = (
        _medians(values, cell, _SECTORS * bins).reshape(_SECTORS, bins)
        for values in (low.min(0), np.median(low, 0), pale)
    )
    ends = np.array([_end(*profiles, height) for profiles in zip(darkest, typical, saturation, strict=True)])
    if (ends > 0).any():  # a rim is as wide on one side as on the other, within a pixel or two
        usual = np.median(ends[ends > 0])
        ends[np.abs(ends - usual) > max(1.5, _UNLIKE * usual)] = 0
    bordered = np.isfinite(typical[:, 1])
    if not bordered.any() or (ends > 0).sum() < _AROUND * bordered.sum():
        return nothing
    ends = _with_neighbours(ends)
    inside = depth < ends[sector] + max(1, round(_MARGIN * height)) * (ends[sector] > 0)
    nothing[rows[inside], columns[inside]] = True
    return nothing


def _end(darkest: np.ndarray, typical: np.ndarray, saturation: np.ndarray, height: int) -> int:
    """At how many pixels from the border the rim of a sector ends; 0 where it has none. Profiles (n,) by pixel."""
    edge = max(2, round(_EDGE * height))
    shines = (darkest > _BRIGHT) & (saturation < _PALE)
    begins = np.flatnonzero(shines[: max(2, round(_BEGINS * height)) + 1])
    if not len(begins):
        return 0
    over = np.flatnonzero(~shines[begins[0] :])
    end = int(begins[0] + over[0]) if len(over) else len(shines)
    if end > max(2, round(_WIDEST * height)):
        return 0
    rim, after = slice(begins[0], end), slice(end, end + edge)
    if not np.isfinite(typical[after]).any():
        return 0
    darker = np.nanmin(typical[after]) < _DROP * typical[rim].max()
    tinged = np.nanmax(saturation[after]) > saturation[rim].min() + _TINGED
    return end if darker or tinged else 0


def _with_neighbours(ends: np.ndarray) -> np.ndarray:
    """Ends (n,) around the image, where a sector without one among several that have it gets theirs."""
    around = np.stack([np.roll(ends, shift) for shift in range(-_NEAR, _NEAR + 1)])
    taken = (ends == 0) & ((around > 0).sum(0) >= _FEW)
    found = ends.copy()
    found[taken] = [np.median(near[near > 0]) for near in around[:, taken].T]
    return found


def _sectors(region: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Which sector around the region's middle pixels (n,) are in."""
    middle = np.array(np.nonzero(region)).mean(1)
    angle = np.arctan2(rows - middle[0], columns - middle[1]) / (2 * np.pi) % 1
    found: np.ndarray = np.minimum((angle * _SECTORS).astype(int), _SECTORS - 1)
    return found


def _medians(values: np.ndarray, cell: np.ndarray, count: int) -> np.ndarray:
    """The median (count,) of the values (n,) in each cell; NaN where there are none."""
    order = np.lexsort((values, cell))
    sizes = np.bincount(cell, minlength=count)
    starts = np.cumsum(sizes) - sizes
    found = np.full(count, np.nan)
    there = sizes > 0
    found[there] = values[order][(starts + sizes // 2)[there]]
    return found
