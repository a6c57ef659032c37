"""The colons of `bench completion`, and the two maps that a SLAM makes of each: 30 % of the points wrong.

    independent   each wrong point is wrong on its own, at least 1.3 times too far (lightdepth.tube.slam, independent)
    coherent      a SLAM that errs as a real one (tracked), whose wrong points are one side of the wall, 1.3 times as
                  far, besides the few that are wrong on their own

Six colons under four lenses. Their seeds are fixed here; what was tuned was tuned on TUNING_SEEDS.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

from densify.bench.scenes import Rendered, Scene, Size
from lightdepth.sparse_map import SparseMap
from lightdepth.tube.map_errors import MapErrors

Errors = Literal["independent", "coherent"]
ERRORS: tuple[Errors, ...] = get_args(Errors)
WRONG_SHARE = 0.3
"""Share of a map's points that are wrong."""
ALONE_SHARE = 0.03
"""Of the points of a coherent map, those that are wrong on their own: as many as of a real SLAM's."""
SIDE_FACTOR = 1.3
SEEDS = (8300, 8301, 8302, 8303, 8304, 8305)
"""Of the judged colons. Nothing is tuned on them."""
TUNING_SEEDS = (8200, 8201, 8202, 8203, 8204, 8205)
"""Of the colons that Poisson's weights and the loss of scale and shift were chosen on (POISSON, LOSS)."""
IMAGE_SIZE: dict[Size, tuple[int, int]] = {"small": (160, 128), "full": (320, 256)}
_COLONS = (
    Scene("c3vd", 0, 200, 12, travel_mm=20, lens="c3vd"),
    Scene("pinhole", 0, 200, 12, travel_mm=20, lens="pinhole", wall="realistic"),
    Scene("fisheye", 0, 200, 12, travel_mm=24, lens="fisheye", wall="realistic"),
    Scene("telescope", 0, 200, 12, travel_mm=20, lens="telescope", wall="other"),
    Scene("c3vd-bounce", 0, 240, 14, travel_mm=28, lens="c3vd", wall="realistic", reflectance=(0.5, 0.7)),
    Scene("fisheye-wide", 0, 160, 10, travel_mm=16, lens="fisheye", wall="other", mu=(0.0, 1.0)),
)


def completion_scenes(seeds: tuple[int, ...] = SEEDS) -> list[Scene]:
    """The colons, made from these seeds."""
    return [replace(scene, seed=seed) for scene, seed in zip(_COLONS, seeds, strict=True)]


def map_with(rendered: Rendered, errors: Errors) -> SparseMap:
    """What a SLAM makes of a colon, WRONG_SHARE of its points wrong."""
    if errors == "independent":
        return rendered.slam(WRONG_SHARE).map
    side = MapErrors(side_share=WRONG_SHARE - ALONE_SHARE, side_factor=SIDE_FACTOR)
    return rendered.tracked(ALONE_SHARE, side)
