"""The page of `lightdepth predict`: what was predicted of how many frames, and some of them in pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lightdepth.frame import Frame
from lightdepth.prediction import DepthPrediction
from lightdepth.reporting.figures import (
    UNSURE,
    colored_distance,
    jpeg,
    normal_colors,
    thumbnail,
    uncertainty_colors,
)
from lightdepth.reporting.report import Report, Tile

SHOWN = 6
"""The most frames that are shown."""
_WIDTH = 320  # of a picture


def spread(count: int) -> list[int]:
    """The rows of the frames that are shown, of so many."""
    return np.unique(np.linspace(0, count - 1, min(count, SHOWN)).round().astype(int)).tolist() if count else []


def predicted_page(
    said: Sequence[str], facts: Sequence[Sequence[Any]], shown: Sequence[tuple[Frame, DepthPrediction]]
) -> Report:
    """`said` are sentences, `facts` rows of a name and a value; `shown` are frames with what was predicted of them,
    none where no image is to be in it."""
    page = Report("Predicted depth")
    for sentence in said:
        page.text(sentence)
    page.table(["", ""], facts)
    if shown:
        page.heading("Some frames")
        page.text(
            "Distance: yellow near, violet far, each frame with a range of its own, as distance is known up to one "
            f"factor a frame. Uncertainty: violet sure, yellow {UNSURE:.0%} of the distance and more. Normals: red to "
            "the right, green up, blue towards the camera. Black: no value."
        )
        for frame, prediction in shown:
            page.tiles(_tiles(frame, prediction), frame.name, 190)
        page.heading("The same frames in figures")
        headers = [
            "frame",
            "pixels with a distance [%]",
            "lowest tenth",
            "median",
            "highest tenth",
            "uncertainty, median [%]",
        ]
        page.table(headers, [_figures(frame, prediction) for frame, prediction in shown])
    return page


def _tiles(frame: Frame, prediction: DepthPrediction) -> list[Tile]:
    shown = {"image": frame.image, "distance": colored_distance(prediction.distance, prediction.valid)}
    if prediction.uncertainty is not None:
        shown["uncertainty"] = uncertainty_colors(prediction.uncertainty, prediction.valid)
    if prediction.albedo is not None:
        shown["albedo"] = np.where(prediction.valid[..., None], prediction.albedo, 0)
    if prediction.normals is not None:
        shown["normals"] = normal_colors(prediction.normals, prediction.valid)
    return [Tile(jpeg(thumbnail(picture, _WIDTH)), name) for name, picture in shown.items()]


def _figures(frame: Frame, prediction: DepthPrediction) -> list[Any]:
    known = prediction.distance[prediction.valid]
    low, middle, high = np.quantile(known, (0.1, 0.5, 0.9)).tolist() if len(known) else (None, None, None)
    sigma = prediction.uncertainty
    unsure = None if sigma is None or not len(known) else 100 * float(np.median(sigma[prediction.valid]))
    return [frame.name, 100 * float(prediction.valid.mean()), low, middle, high, unsure]
