"""How frames are mapped."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

from lightdepth.ranges import COUNT, SEED, SHARE, at_least, checked

Progress = Callable[[str, int, int], None]
"""Called with the stage ("images", "features", "matches", "mapping"), how much of it is done, and of how much."""

_MOTION = (
    "what helps: more frames; at least 5 mm of travel with some of it sideways (pure forward motion over 3 mm fails); "
    "sharp frames of 250 rows or more (blurred and small ones lack features); a mask that leaves the tissue free"
)
ADVICE = (
    f"{_MOTION}; the calibration of this very image size. A lower --sfm.peak-threshold finds more features in smooth "
    "tissue"
)
"""What a user can do whose frames do not connect."""
ADVICE_WITHOUT_CAMERA = f"give --camera FILE, or --fov DEGREES to assume a pinhole; {_MOTION}"
"""The same where it is the camera that is looked for."""


@dataclass(frozen=True)
@checked
class SfmConfig:
    """How frames are mapped."""

    max_features: Annotated[int, COUNT] = 4096
    """Largest number of features (distinct places, by SIFT) taken of a frame, the strongest ones. More find more points
    and take longer."""
    peak_threshold: Annotated[float, at_least(0, up_to=1)] = 0.003
    """Least contrast of a feature, with brightness in [0, 1]; COLMAP's own 0.0067 finds too few on smooth tissue. A
    higher one finds fewer features."""
    mask_erosion_px: Annotated[int, at_least(0, up_to=10_000)] = 4
    """Distance that features keep from the border of the mask, pixels. A larger one leaves out more of the image."""
    highlight: Annotated[float, SHARE] = 0.98
    """Brightness, in [0, 1], which red, green and blue must all reach for a pixel to be a highlight, where no feature
    is taken. A higher one takes fewer pixels for highlights."""
    highlight_margin_px: Annotated[int, at_least(0, up_to=10_000)] = 3
    """Distance that features keep from a highlight, pixels. A larger one leaves out more of the image."""
    contrast: Annotated[float, at_least(0, up_to=1000)] = 2.0
    """How strongly the contrast of dark and bright tissue is evened out before features are looked for, a factor
    (CLAHE's clip limit); 0 leaves images as they are. A larger one brings out more, noise included."""
    matching: Literal["auto", "sequential", "exhaustive"] = "auto"
    """Which frames are matched with each other: sequential, those that follow each other or look alike; exhaustive, all
    with all, which takes longer; auto, exhaustive for up to `exhaustive_up_to` frames, else sequential."""
    exhaustive_up_to: Annotated[int, at_least(0)] = 40
    """Number of frames up to which --sfm.matching auto matches all with all; longer sequences are matched sequentially.
    More find more connections, in time that grows with their square."""
    overlap: Annotated[int, at_least(1, up_to=100_000)] = 10
    """Number of following frames that each frame is matched with, in sequential matching. More bridge longer gaps and
    take longer."""
    alike: Annotated[int, at_least(0, up_to=100_000)] = 5
    """Number of frames farther off that each frame is also matched with, in sequential matching: those that look most
    like it; 0 for none. More find more places that are seen again, and take longer."""
    mapper: Literal["incremental", "global", "both"] = "both"
    """What places the matched frames: incremental, one after the other; global, all at once (GLOMAP); both, first
    incremental, then global for the frames that it left out, as submaps of their own where many points support them."""
    min_model_size: Annotated[int, at_least(2)] = 3
    """Least number of frames of a submap (a part of the map that hangs together, with a scale of its own); smaller ones
    are left out. More leave out more."""
    min_points: Annotated[int, COUNT] = 8
    """Least number of points of a submap (a part of the map that hangs together, with a scale of its own); those with
    fewer are left out. More leave out more."""
    init_min_tri_angle: Annotated[float, at_least(0, up_to=180)] = 4.0
    """Least angle, degrees, between the lines of sight of the two frames that a map begins with; COLMAP asks for less
    where no pair has it. A larger one begins with a safer pair, where there is one."""
    init_min_num_inliers: Annotated[int, COUNT] = 50
    """Least number of matches between the two frames that a map begins with; COLMAP asks for fewer where no pair has so
    many. More begin with a safer pair, where there is one."""
    num_threads: Annotated[int, at_least(1, up_to=1024)] = 1
    """Number of threads for features, matches and mapping. More make the map differ in the last digits from run to run,
    and were not faster on two cores."""
    seed: Annotated[int, SEED] = 0
    """Number that seeds the random samples of robust fits (RANSAC). Another one makes a slightly different map."""
