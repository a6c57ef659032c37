"""Frames and the keyframes of a map: they meet by the number in their names."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

from lightdepth.datasets.sequence import FrameSequence
from lightdepth.errors import InputError
from lightdepth.maps.convention import SIDECAR
from lightdepth.sparse_map import SparseMap
from lightdepth.which_frame import WhichFrame


def check_shared_frames(sparse_map: SparseMap, frames: FrameSequence) -> None:
    """Raises InputError when no keyframe of the map has the number of a frame; warns when most have not."""
    mapped = sorted({k.number for submap in sparse_map.submaps for k in submap.keyframes})
    shared = set(mapped) & set(frames.numbers)
    if 2 * len(shared) > len(mapped):
        return
    first, last = min(frames.numbers), max(frames.numbers)
    keyframes = [k.name for submap in sparse_map.submaps for k in submap.keyframes[:8]]
    if _times(frames.names[:8]) and not _times(keyframes):
        cure = "the frames' names are times, the map's are not: name both alike, or give a map with times"
    elif mapped[-1] - mapped[0] > 100 * (last - first + 1):
        cure = "are the map's times in milliseconds? If of another clock, give --time-offset and --map-fps"
    else:
        cure = f'if one counts from elsewhere, give --frame-offset, or put "frame_offset" into {SIDECAR}'
    found = f"keyframes {mapped[0]} to {mapped[-1]}, {frames.source}: frames {first} to {last}"
    if not shared:
        raise InputError(
            sparse_map.source, f"{found}, and none in common", f"they meet by the number in their names: {cure}"
        )
    said = f"{len(shared)} of {len(mapped)} keyframes have a frame"
    warnings.warn(f"{sparse_map.source}: {found}; {said}; {cure}", stacklevel=2)


def _times(names: Sequence[str]) -> bool:
    return any(WhichFrame.named(name).time is not None for name in names)
