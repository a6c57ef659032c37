"""The steps of a densify run that are finished parts: what each gave is kept, and read back when the run is resumed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from densify.page import Gallery
from densify.pipeline import SubmapResult
from lightdepth.files.packed import read_packed, write_packed
from lightdepth.reporting.run import Run
from lightdepth.sparse_map import Submap

T = TypeVar("T")


@dataclass(frozen=True)
class _Shown:
    """A submap's result, and its pictures."""

    result: SubmapResult
    pictures: tuple[np.ndarray, ...]
    captions: tuple[str, ...]


def kept(run: Run, part: str, kind: type[T], make: Callable[[], T], given: Mapping[type, object] | None = None) -> T:
    """What `make` gives, or gave before the run was stopped. `given` as for read_packed."""
    file = run.state / f"{part}.npz"
    if run.done(part):
        return read_packed(file, kind, given)
    made = make()
    if run.resumable:
        file.parent.mkdir(exist_ok=True)
        write_packed(file, made, given)
        run.finish_part(part, [file])
    return made


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
