"""A sparse map and the frames that it is of, opened together: each may lack what the other knows."""

from __future__ import annotations

from pathlib import Path

from lightdepth.datasets.reading import stamps_of
from lightdepth.datasets.sequence import FrameSequence
from lightdepth.datasets.source import SequenceSource
from lightdepth.maps import read_map
from lightdepth.maps.convention import CameraMissing, MapReading, Reader
from lightdepth.sparse_map import SparseMap


def open_with_map(
    source: SequenceSource, map: Path, reading: MapReading = MapReading()
) -> tuple[SparseMap, FrameSequence]:
    """The map, its keyframes told by the frames' stamps where their names do not tell them, and the frames. Where one
    has no camera, the other's serves. Raises InputError where either cannot be read."""
    reader = Reader(reading, stamps_of(source.data, source.format))
    try:
        sparse_map = read_map(map, reader)
    except CameraMissing:
        frames = source.open()
        return read_map(map, Reader(reading, reader.frames, frames.first().camera)), frames
    return sparse_map, source.open(sparse_map.submaps[0].keyframes[0].camera)
