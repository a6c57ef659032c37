"""Which frame a keyframe is."""

from __future__ import annotations

from dataclasses import dataclass

from lightdepth.sparse_map import Keyframe


@dataclass(frozen=True)
class Counting:
    """How keyframes are counted: keyframe n is frame round(rate n) + offset. Left as it is, they meet by number alone;
    names and times have become numbers where the map was read (lightdepth.maps.convention)."""

    rate: float = 1.0
    """Frames for each that the map counts: 1.2 where a video of 30 frames a second was counted as one of 25."""
    offset: int = 0
    """Number of frames that are added."""

    def number(self, keyframe: Keyframe) -> int:
        """The number of the frame that a keyframe is."""
        counted = keyframe.number if self.rate == 1 else round(self.rate * keyframe.number)  # nanoseconds fit no float
        return counted + self.offset


BY_NUMBER = Counting()
