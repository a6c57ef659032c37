"""How frames are mapped."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

Progress = Callable[[str, int, int], None]
"""Called with the stage ("images", "features", "matches", "mapping"), how much of it is done, and of how much."""

ADVICE = (
    "what helps: more frames; at least 5 mm of travel with some of it sideways (pure forward motion over 3 mm fails); "
    "sharp frames (blurred ones have no features); the calibration of this very image size; "
    "a mask that leaves the tissue free. A lower `peak_threshold` finds more features in smooth tissue"
)
"""What a user can do whose frames do not connect."""


@dataclass(frozen=True)
class SfmConfig:
    """How frames are mapped."""

    max_features: int = 4096
    """Largest number of SIFT features in a frame; the strongest ones are taken. More find more points and take
    longer."""
    peak_threshold: float = 0.003
    """Least contrast of a feature, in [0, 1]; COLMAP's 0.0067 misses smooth tissue. A higher one finds fewer
    features."""
    mask_erosion_px: int = 4
    """Distance that features keep from the border of the mask, pixels. A larger one leaves out more of the image."""
    highlight: float = 0.98
    """Brightness, in [0, 1], which all three channels of a pixel reach in a highlight. A higher one takes fewer
    pixels for highlights."""
    highlight_margin_px: int = 3
    """Distance that features keep from a highlight, pixels. A larger one leaves out more of the image."""
    contrast: float = 2.0
    """Clip limit of CLAHE, a factor, which evens the contrast of dark and bright tissue; 0 leaves it as it is. A
    larger one brings out more, noise included."""
    matching: Literal["auto", "sequential", "exhaustive"] = "auto"
    """Which frames are matched: sequential, those that follow each other or look alike; exhaustive, all with all;
    auto, exhaustive for few frames."""
    exhaustive_up_to: int = 40
    """Number of frames up to which `auto` matches all with all; longer sequences are matched sequentially. More find
    more connections, in time that grows with their square."""
    overlap: int = 10
    """Number of frames matched ahead of each, when sequential. More bridge longer gaps and take longer."""
    alike: int = 5
    """Number of frames matched with each besides, when sequential: those farther off that look most alike. More close
    more loops and take longer."""
    mapper: Literal["incremental", "global", "both"] = "both"
    """What places the matched frames: incremental, one after the other; global, all at once (GLOMAP); both, global
    for those that incremental left, as submaps of their own where many points hold them."""
    min_model_size: int = 3
    """Least number of frames in a submap. More leave out small submaps."""
    min_points: int = 8
    """Least number of points in a submap. More leave out poor submaps."""
    init_min_tri_angle: float = 4.0
    """Least angle between the rays of the first pair of frames, degrees. A larger one starts from a safer pair, where
    there is one."""
    init_min_num_inliers: int = 50
    """Least number of matches that the first pair of frames needs. More start from a safer pair, where there is
    one."""
    num_threads: int = 1
    """Number of threads for features, matches and mapping. More change the last bits from run to run, and were not
    faster on two cores."""
    seed: int = 0
    """Number that draws the samples of every RANSAC in it. Another one makes a slightly different map."""
