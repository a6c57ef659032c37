"""About how long frames take to be mapped, for a dry run: by a table, as features and matches are slow to try."""

from __future__ import annotations

from collections.abc import Sequence

from lightdepth.command_line.dry import Step
from lightdepth.counting import counted
from lightdepth.frame import Frame
from lightdepth.reporting.plan import slowness
from lightdepth.sfm.config import SfmConfig

_FEATURES_PER_MEGAPIXEL = 1.9
_PAIR = 0.011
_FRAME = 0.06
"""Seconds on the machine of the tables: features of a frame, by its pixels; a pair that is matched; a frame placed."""


def mapping_steps(frames: Sequence[Frame], config: SfmConfig) -> list[Step]:
    """Features, matches and mapping of so many frames, and that what follows cannot be told before."""
    first, count = frames[0].camera, len(frames)
    exhaustive = config.matching == "exhaustive"
    exhaustive |= config.matching == "auto" and count <= config.exhaustive_up_to
    pairs = count * (count - 1) // 2 if exhaustive else min(count * (config.overlap + config.alike), count**2 // 2)
    features = count * _FEATURES_PER_MEGAPIXEL * first.width * first.height / 1e6
    return [
        Step(f"features of {counted(count, 'frame')}", slowness() * features),
        Step(f"matches of some {counted(pairs, 'pair')}", slowness() * pairs * _PAIR),
        Step(f"placing {counted(count, 'frame')}", slowness() * count * _FRAME),
        Step("what follows, on the map that is found"),
    ]
