"""What the detective says of a map and frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from lightdepth.detective.cameras import OtherCamera
from lightdepth.detective.colours import Colours
from lightdepth.detective.evidence import Fit
from lightdepth.detective.geometry import Geometry

Judgement = Literal["agrees", "cannot tell", "doubtful", "wrong"]
WORSE: tuple[Judgement, ...] = ("agrees", "cannot tell", "doubtful", "wrong")
"""From the best to the worst."""


@dataclass(frozen=True)
class Verdict:
    """Whether frames and keyframes belong together as they are read, and the figures that say so."""

    judgement: Judgement
    sentence: str
    """with its figures"""
    cure: str
    """what the user does about it; empty where nothing is wrong"""
    at_hand: Fit | None = None
    """of the reading at hand"""
    others: tuple[Fit, ...] = ()
    """of those tried besides"""
    from_chance: float | None = None
    """share of pairs of a right and a wrong patch in which the right one is more alike; 1/2 where nothing fits"""
    geometry: Geometry | None = None
    """what the keypoints say without images"""
    untold: tuple[str, ...] = ()
    """readings that fit about as well, so that the images cannot tell"""
    submap: int | None = None
    """which submap it is about"""
    colours: Colours | None = None
    """what the points' colours say; None where they have none"""
    other_camera: OtherCamera | None = None
    """the frames' own camera, or a given one, beside the map's; None where there is none, or no observation"""

    def record(self) -> dict[str, object]:
        """As run.json holds it."""
        figures = {
            "submap": self.submap,
            "at_hand": None if self.at_hand is None else self.at_hand.record(),
            "others": [fit.record() for fit in self.others],
            "told_from_chance": self.from_chance,
            "geometry": None if self.geometry is None else self.geometry.record(),
            "could_not_tell": list(self.untold),
            "other_camera_px": None if self.other_camera is None else self.other_camera.pixels,
            "colours": None if self.colours is None else self.colours.record(),
        }
        return {"judgement": self.judgement, "sentence": self.sentence, "figures": figures}
