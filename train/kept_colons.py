"""Colons that a training rendered, kept in its folder until it is whole, so that a run that is resumed reads them.

RUN/.state/colons/<of>/<seed>.safetensors, one for each colon, and <hash>.safetensors, the rays that they share. `of` is
a hash of all that they are rendered from: the settings, the seed of the data, the size, and the code. They are the same
to the bit as what was rendered, and go with `.state` when the run is whole: they take
as much room as the colons in memory do, and at most MOST bytes.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from lightdepth.counting import counted
from lightdepth.files.replacing import discard
from lightdepth.frame import FrameBatch
from lightdepth.photometry import LightTerms
from lightdepth.reporting.same import plain
from train import colons
from train.colons import TubeData
from train.frame_cache import ROOM, KeptFrames, code_hash
from train.loader import collate

MOST = 4_000_000_000
"""Bytes that a run's colons may take; those beyond are rendered anew. 300 of 8 frames of 160x128 take a quarter."""


class KeptColons(KeptFrames):
    """Colons of a training in a folder, by their seeds."""

    def __init__(self, root: Path, tube: TubeData, seed: int, size: tuple[int, int]) -> None:
        """`seed` is that of the data: which colon is the how-manieth follows from it, and from that its lens."""
        rendered = plain(replace(tube, scenes=0, val_scenes=0))  # more colons leave the others as they are
        own = Path(colons.__file__).read_bytes()
        of = json.dumps([rendered, seed, size]).encode() + own + code_hash().encode()
        super().__init__(root / hashlib.sha256(of).hexdigest()[:32], "rendered colons are kept for --resume")
        self._frames = tube.frames

    def frames(self, seed: int) -> list[FrameBatch] | None:
        """The frames of a colon, as batches of one; None where they are not there, or not whole."""
        found = self.read(seed)
        if found is None or len(found.image) != self._frames:
            return None
        image, mask, true_distance, true_valid = (each.clone() for each in (*found[:2], *found[4:]))
        light = LightTerms(*(term.clone() for term in found.light))  # out of the files, which go before the process
        whole = FrameBatch(image, mask, found.rays, light, true_distance, true_valid)
        return [_row(whole, row) for row in range(self._frames)]

    def write(self, rendered: Sequence[tuple[int, list[FrameBatch]]]) -> str:
        """Keeps colons, by seed, as far as there is room, and clears those of other settings. Returns a sentence on
        those that are not kept; empty where all are."""
        there = 0
        with suppress(OSError):
            for other in list(self.folder.parent.iterdir()):
                if other != self.folder:
                    discard(other)
            there = sum(file.stat().st_size for file in self.folder.iterdir())
        left = MOST - there
        with suppress(OSError):
            left = min(left, shutil.disk_usage(self.folder.parents[2]).free - ROOM)
        for number, (seed, frames) in enumerate(rendered):
            batch = collate(frames)
            left -= sum(each.nbytes for each in (batch.image, batch.mask, batch.true_distance, batch.true_valid))
            if left < 0:
                rest = counted(len(rendered) - number, "rendered colon")
                return f"{rest} will be rendered anew by --resume: there is no room to keep more"
            self.keep(seed, batch)
        return ""


def _row(batch: FrameBatch, row: int) -> FrameBatch:
    image, mask, rays, true_distance, true_valid = (each[row : row + 1] for each in (*batch[:3], *batch[4:]))
    light = LightTerms(*(term[row : row + 1] for term in batch.light))
    return FrameBatch(image, mask, rays, light, true_distance, true_valid)
