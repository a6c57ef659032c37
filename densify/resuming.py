"""Submaps of a densify run as finished parts: what each gave is kept, and read back when the run is resumed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from densify.page import Gallery
from densify.pipeline import SubmapResult
from lightdepth.reporting.kept import kept
from lightdepth.reporting.run import Run
from lightdepth.reporting.scene import Picture
from lightdepth.sparse_map import Submap


@dataclass(frozen=True)
class _Shown:
    """A submap's result, and its pictures."""

    result: SubmapResult
    pictures: tuple[np.ndarray, ...]
    captions: tuple[str, ...]
    small: tuple[np.ndarray, ...]
    """image and depth of each thumbnail"""
    names: tuple[str, ...]


def kept_result(run: Run, submap: Submap, gallery: Gallery, make: Callable[[], SubmapResult]) -> SubmapResult:
    """The dense map of a submap; its pictures are in the gallery then."""

    thumbnails = gallery.thumbnails.found

    def shown() -> _Shown:
        before = set(thumbnails)
        result = make()
        pictures = gallery.pictures[submap.id]
        new = {name: picture for name, picture in thumbnails.items() if name not in before}
        return _Shown(
            result,
            tuple(np.frombuffer(data, np.uint8) for data, _ in pictures),
            tuple(text for _, text in pictures),
            tuple(np.frombuffer(data or b"", np.uint8) for p in new.values() for data in (p.image, p.depth)),
            tuple(new),
        )

    found = kept(run, f"map {submap.id}", _Shown, shown, {Submap: submap})
    gallery.pictures[submap.id] = [
        (data.tobytes(), text) for data, text in zip(found.pictures, found.captions, strict=True)
    ]
    pairs = zip(found.names, found.small[::2], found.small[1::2], strict=True)
    thumbnails.update({name: Picture(image.tobytes(), depth.tobytes()) for name, image, depth in pairs})
    return found.result
