"""Masks on disk: which of two parts of the image a pixel is in, whatever values the file has for them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightdepth.errors import InputError
from lightdepth.files.images import decode_raw, read_bytes

_LABELS = 16
"""Up to so many different colours are labels; more are a drawing with soft edges, or compressed."""
_BETWEEN = 0.05
"""Largest share of pixels of a soft mask that are neither dark nor bright."""


def read_two_parts(path: Path, expected: str) -> np.ndarray:
    """(H, W) bool of a mask, True where it is brighter: 0 and 255, 0 and 1, or one label's colour on another's. A file
    of one value is True unless that is 0. Raises InputError, ending with what was `expected`, where it is no mask."""
    try:
        values = decode_raw(read_bytes(path, "mask"), str(path))
    except InputError as error:
        if "readable image" not in error.found:
            raise
        raise InputError(path, "not a readable mask", expected) from error
    channels = np.nan_to_num((values[..., None] if values.ndim == 2 else values).astype(np.float64))
    if values.ndim not in (2, 3) or not channels.size:
        raise InputError(path, f"not a mask: its shape is {values.shape}", expected)
    if channels.shape[2] == 4:
        colours, alpha = channels[..., :3], channels[..., 3]
        channels = alpha[..., None] if np.ptp(colours) == 0 else colours  # some are drawn in the alpha alone
    labels = _labels(channels)
    if labels is not None and len(labels) == 1:
        return np.full(values.shape[:2], bool(labels.any()))
    if labels is not None and len(labels) == 2:
        order = sorted(range(2), key=lambda i: (labels[i].max(), labels[i].sum()))
        result: np.ndarray = (channels == labels[order[1]]).all(-1)
        return result
    if labels is not None:  # two, and a few pixels between them along a soft edge
        shares = np.array([(channels == label).all(-1).mean() for label in labels])
        usual = labels[np.argsort(-shares)[:2]]
        if np.sort(shares)[::-1][:2].sum() < 1 - _BETWEEN:
            raise InputError(path, f"{len(labels)} labels, where a mask has two values", expected)
        dark, bright = sorted(usual, key=lambda label: (label.max(), label.sum()))
        nearer: np.ndarray = np.abs(channels - bright).sum(-1) < np.abs(channels - dark).sum(-1)
        return nearer
    top = channels.max(-1)
    share = top / max(float(top.max()), 1e-12)
    if float(((share > 0.25) & (share < 0.75)).mean()) > _BETWEEN:
        raise InputError(path, "shades of grey, where a mask has two values", expected)
    soft: np.ndarray = share > 0.5
    return soft


def _labels(channels: np.ndarray) -> np.ndarray | None:
    """The different colours (n, C) of an image (H, W, C); None where there are more than labels would be."""
    flat = channels.reshape(-1, channels.shape[2])
    few = np.unique(flat[:: max(1, len(flat) // 4096)], axis=0)
    if len(few) > _LABELS:
        return None
    code = flat @ np.array([1.0, 257.3, 66049.7])[: flat.shape[1]]  # one number for a colour: far faster to sort
    _, first = np.unique(code, return_index=True)
    return None if len(first) > _LABELS else flat[first]
