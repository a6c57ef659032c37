"""How a dense map is judged where there is no truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from lightdepth.parallax import ParallaxConfig
from lightdepth.ranges import SEED, at_least, checked


@dataclass(frozen=True)
@checked
class JudgeConfig:
    """How a dense map is judged where there is no truth. The surface itself uses every point."""

    on: bool = True
    """Whether the result is judged, by map points hidden from the alignment and by the images, and a bend that makes a
    keyframe worse is undone; switched off, every bend is kept and there is no verdict."""
    folds: Annotated[int, at_least(2, up_to=1000)] = 5
    """Number of parts, at least 2, that the map's points are divided into, by blocks of wall; to judge, each keyframe
    is aligned anew with each part hidden in turn. More hide less at a time and take longer."""
    seed: Annotated[int, SEED] = 0
    """Number that draws which blocks of wall are hidden together. Another one changes the judgement slightly, and with
    it which bends are undone."""
    parallax: ParallaxConfig = field(default_factory=ParallaxConfig)
    """how distances are measured between the images of keyframes (--judge.parallax.on false leaves them out)"""
