"""Map errors that come together, as cells of the benchmark: each is judged with one scale a keyframe and in full.

A case is what a SLAM like a real one makes of the scene (lightdepth.tube.slam, tracked), with one error of a stated
size on top. `clean` has none, so that what is lost without need shows as well.
"""

from __future__ import annotations

from typing import Literal

from densify.bench.scenes import Size
from lightdepth.tube.map_errors import MapErrors

Case = Literal["clean", "side", "wide side", "drift", "fold", "poses"]
CASES: dict[Case, MapErrors] = {
    "clean": MapErrors(),
    "side": MapErrors(side_share=0.3, side_factor=1.15),
    "wide side": MapErrors(side_share=0.45, side_factor=1.3),
    "drift": MapErrors(drift=1.3),
    "fold": MapErrors(fold_share=0.2),
    "poses": MapErrors(pose_drift=0.1, pose_drift_deg=5.0),
}
USUAL_CASES: dict[Size, tuple[Case, ...]] = {"small": ("clean", "wide side", "drift"), "full": tuple(CASES)}
WRONG_SHARE = 0.03
"""Of the points of each case, besides its error: those of a real SLAM."""
