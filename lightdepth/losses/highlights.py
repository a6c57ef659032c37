"""Which white pixels are highlights, where a wet wall mirrors the lamp, and which are wall too near to measure.

A highlight is small and stands out: wall around it is far from white. Near wall that clips is large, or fades into
white over many pixels, and may stand at any angle.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

_ROWS = 112
"""Image height at which the widths below are in pixels; they grow with larger images."""
_BLEND = 1
"""Width of the border of a highlight, where it and the wall mix in one pixel."""
_RING = 2
"""Width, behind that border, of what a highlight is compared with."""
_EIGHT = np.ones((3, 3), bool)


def highlights(v: Tensor, saturated: Tensor, mask: Tensor, largest: float, contrast: float) -> Tensor:
    """The saturated pixels that are highlights, (B, 1, H, W) bool.

    A patch of them that hangs together, corners included, is one where it has at most `largest` of its image's pixels
    in the mask, and where brightness v (B, 1, H, W) in a ring around it is `contrast` below the patch's, in the mean.
    A patch without a ring (all in the mask is white) is none, unless no contrast is asked for.
    """
    found = torch.zeros_like(saturated)
    if largest >= 1 and contrast <= 0:
        return saturated
    for i in range(len(saturated)):
        white, inside, bright = (x[i, 0].detach().cpu().numpy() for x in (saturated, mask, v))
        chosen = _chosen(white, inside, bright, largest * inside.sum(), contrast)
        found[i, 0] = torch.from_numpy(chosen).to(found.device)
    return found


def _chosen(white: np.ndarray, inside: np.ndarray, bright: np.ndarray, largest: float, contrast: float) -> np.ndarray:
    """(H, W) bool of one image; `largest` in pixels."""
    grown = max(1.0, len(white) / _ROWS)
    blend, reach = round(_BLEND * grown), round((_BLEND + _RING) * grown)
    labels, count = ndimage.label(white, _EIGHT)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    kept = np.zeros(count + 1, bool)
    for label, (rows, columns) in enumerate(ndimage.find_objects(labels), 1):
        if sizes[label] > largest:
            continue
        if contrast <= 0:
            kept[label] = True
            continue
        around = np.s_[_widened(rows, reach, len(white)), _widened(columns, reach, white.shape[1])]
        patch = labels[around] == label
        apart = ndimage.distance_transform_cdt(~patch)
        ring = (apart > blend) & (apart <= reach) & inside[around]
        if ring.any():
            kept[label] = bright[around][patch].mean() - bright[around][ring].mean() >= contrast
    chosen: np.ndarray = kept[labels]
    return chosen


def _widened(part: slice, by: int, length: int) -> slice:
    return slice(max(part.start - by, 0), min(part.stop + by, length))
