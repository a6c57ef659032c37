"""Submaps of a densify run as finished parts: what each gave is kept, and read back when the run is resumed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass

import numpy as np

from densify.page import Gallery
from densify.pipeline import SubmapResult
from lightdepth.reporting.kept import kept
from lightdepth.reporting.report import Tile
from lightdepth.reporting.run import Run
from lightdepth.reporting.scene import Picture
from lightdepth.sparse_map import Submap


@dataclass(frozen=True)
class _Shown:
    """A submap's result, and its pictures."""

    result: SubmapResult
    tiles: tuple[tuple[np.ndarray, ...], ...]
    """of each keyframe that has a row of them"""
    labels: tuple[tuple[str, ...], ...]
    captions: tuple[str, ...]
    small: Mapping[str, tuple[np.ndarray, ...]]
    """the pictures of each thumbnail, in the order of their fields; an empty one is none"""
    rows: Mapping[int, np.ndarray]
    """of the run's folder of keyframes, by number"""


def kept_result(run: Run, submap: Submap, gallery: Gallery, make: Callable[[], SubmapResult]) -> SubmapResult:
    """The dense map of a submap; its pictures are in the gallery then."""

    thumbnails, in_rows = gallery.thumbnails.found, gallery.thumbnails.rows

    def shown() -> _Shown:
        before = {*thumbnails, *in_rows}
        result = make()
        rows = gallery.pictures[submap.id]
        return _Shown(
            result,
            tuple(tuple(_array(tile.picture) for tile in tiles) for tiles, _ in rows),
            tuple(tuple(tile.label for tile in tiles) for tiles, _ in rows),
            tuple(text for _, text in rows),
            {name: tuple(map(_array, astuple(p))) for name, p in thumbnails.items() if name not in before},
            {number: _array(row) for number, row in in_rows.items() if number not in before},
        )

    found = kept(run, f"map {submap.id}", _Shown, shown, {Submap: submap})
    gallery.pictures[submap.id] = [
        ([Tile(data.tobytes(), label) for data, label in zip(tiles, labels, strict=True)], text)
        for tiles, labels, text in zip(found.tiles, found.labels, found.captions, strict=True)
    ]
    for name, (image, *others) in found.small.items():
        thumbnails[name] = Picture(image.tobytes(), *(data.tobytes() or None for data in others))
    in_rows.update({number: row.tobytes() for number, row in found.rows.items()})
    return found.result


def _array(data: bytes | None) -> np.ndarray:
    return np.frombuffer(data or b"", np.uint8)
