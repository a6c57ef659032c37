"""Where a camera is from that nobody calibrated, and whether its focal length is known well enough.

A camera carries it along when it is cropped, resized or written, so that whoever works with the camera can say it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

TOLERATED = 0.03
"""Error of the focal length, as a share of it: where two deviations exceed it, the motion is said not to tell it."""

CameraSource = Literal["measured", "published", "given", "assumed", "self-calibrated"]


def told(deviation: float | None) -> bool:
    """Whether a focal length of this standard deviation, as a share of it, is known within what is tolerated."""
    return deviation is not None and 2 * deviation <= TOLERATED


@dataclass(frozen=True)
class Provenance:
    """Where a camera is from, as camera.json says it."""

    source: CameraSource
    """how it was come by"""
    focal_deviation: float | None = None
    """standard deviation of the focal length, as a share of it, where it is known"""
    note: str | None = None
    """a sentence, for whoever reads it"""

    @property
    def doubt(self) -> str:
        """A sentence on why the focal length may be wrong; empty where nothing speaks against it."""
        if self.source not in ("assumed", "self-calibrated") or told(self.focal_deviation):
            return ""
        return self.note or f"{self.in_short}: lengths and shapes may be wrong"

    @property
    def in_short(self) -> str:
        """The doubt in few words, for a verdict; empty where there is none."""
        if self.source == "assumed":
            return "the camera is assumed, not calibrated"
        if self.source != "self-calibrated" or told(self.focal_deviation):
            return ""
        if self.focal_deviation is None:
            return "the camera is self-calibrated, nobody knows how well"
        return f"the camera is self-calibrated, its focal length known to {100 * self.focal_deviation:.1f} % only"
