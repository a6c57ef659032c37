"""Submaps of a densify run as finished parts: what each gave is kept, and read back when the run is resumed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from densify.page import Gallery
from densify.pipeline import SubmapResult
from lightdepth.reporting.kept import kept
from lightdepth.reporting.run import Run
from lightdepth.sparse_map import Submap


@dataclass(frozen=True)
class _Shown:
    """A submap's result, and its pictures."""

    result: SubmapResult
    pictures: tuple[np.ndarray, ...]
    captions: tuple[str, ...]


def kept_result(run: Run, submap: Submap, gallery: Gallery, make: Callable[[], SubmapResult]) -> SubmapResult:
    """The dense map of a submap; its pictures are in the gallery then."""

    def shown() -> _Shown:
        result = make()
        pictures = gallery.pictures[submap.id]
        return _Shown(
            result, tuple(np.frombuffer(png, np.uint8) for png, _ in pictures), tuple(text for _, text in pictures)
        )

    found = kept(run, f"map {submap.id}", _Shown, shown, {Submap: submap})
    gallery.pictures[submap.id] = [
        (png.tobytes(), text) for png, text in zip(found.pictures, found.captions, strict=True)
    ]
    return found.result
