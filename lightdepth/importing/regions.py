"""What of the image shows tissue, what shows text, and what is border."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from lightdepth.datasets.sequence import border_mask, border_region
from lightdepth.errors import InputError
from lightdepth.files.images import unit_range
from lightdepth.files.masks import read_two_parts
from lightdepth.frame import resized_mask
from lightdepth.image_quality import eight_bits, one_field
from lightdepth.importing.overlay import STRETCH, STRETCHES, Overlay, find_overlay
from lightdepth.importing.source import Source

_SHOWN = 4
"""Of 255: no pixel of a picture that shows nothing at all is as bright."""


@dataclass(frozen=True)
class Regions:
    """Parts of the image, (H, W) bool: tissue is valid, shown is not blacked out."""

    tissue: np.ndarray
    shown: np.ndarray
    overlay: Overlay
    border_found: bool


def find_regions(source: Source, find_text: bool, given_text: np.ndarray | None, deinterlace: bool) -> Regions:
    images = []
    for i in source.sample(STRETCH * STRETCHES):
        try:
            pixels = eight_bits(source.read(i)[0])
        except InputError:
            continue  # the scan counts and reports it
        if pixels.shape[:2] == (source.height, source.width):
            images.append(one_field(pixels) if deinterlace else pixels)
    if not images:
        raise InputError("the frames", "none of those looked at could be read", "copy the data again")
    if max(int(image.max()) for image in images) < _SHOWN:
        raise InputError(
            "the frames", "all of those looked at are black", "choose a part with --start that shows something"
        )
    floats = [unit_range(image) for image in images]
    mask, region = border_mask(floats), border_region(floats)
    nothing = np.zeros(mask.shape, bool)
    overlay = find_overlay(images, region) if find_text else Overlay(nothing, True, [])
    tissue = mask if source.mask is None else source.mask
    if tissue.shape != mask.shape:
        raise InputError(
            "the mask",
            f"it is {tissue.shape[1]}x{tissue.shape[0]}, the images {source.width}x{source.height}",
            "expected the same size",
        )
    text = overlay.mask if given_text is None else overlay.mask | given_text
    shown = cv2.dilate((region | tissue).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return Regions(tissue & ~text, shown & ~text, replace(overlay, mask=text), source.mask is None and not mask.all())


def read_overlay_mask(path: Path, source: Source) -> np.ndarray:
    """(H, W) bool of a file that is white where text is. Unlike a mask's, its polarity is not guessed."""
    text = read_two_parts(path, "expected an image that is white where text is")
    if text.shape != (source.height, source.width):
        size = f"{source.width}x{source.height}"
        raise InputError(path, f"{text.shape[1]}x{text.shape[0]}", f"expected {size}, as the images are")
    return text


def tissue_picture(regions: Regions) -> np.ndarray:
    height, width = regions.tissue.shape
    size = (min(480, width), max(1, round(height * min(480, width) / width)))
    return resized_mask(regions.tissue, size)
