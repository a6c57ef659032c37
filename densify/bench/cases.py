"""Map errors that come together, and walls that move, as cells of the benchmark: each is judged with one scale a
keyframe and in full.

A case is what a SLAM like a real one makes of the scene (lightdepth.tube.slam, tracked), with one error of a stated
size on top, or of the same colon while it breathes, or while waves run along it (peristalsis). `clean` has none, so
that what is lost without need shows as well.

A surface that stands for a wall that moves is judged by the mean wall, which is the wall at rest: it is one surface for
all keyframes, and by a cloud of all their truths, which fills the whole space that the wall sweeps, hardly anything
would be wrong. The depth of a keyframe is judged by the truth of its own frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from densify.bench.scenes import Size
from lightdepth.tube.breathing import BreathingConfig
from lightdepth.tube.map_errors import MapErrors

_NO_ERRORS, _AT_REST = MapErrors(), BreathingConfig()


@dataclass(frozen=True)
class Erring:
    """What is wrong in a case."""

    errors: MapErrors = _NO_ERRORS
    breathing: BreathingConfig = _AT_REST


Case = Literal[
    "clean",
    "side",
    "wide side",
    "drift",
    "fold",
    "loop",
    "poses",
    "breath 2",
    "breath 5",
    "breath 10",
    "waves",
]
CASES: dict[Case, Erring] = {
    "clean": Erring(),
    "side": Erring(MapErrors(side_share=0.3, side_factor=1.15)),
    "wide side": Erring(MapErrors(side_share=0.45, side_factor=1.3)),
    "drift": Erring(MapErrors(drift=1.3)),
    "fold": Erring(MapErrors(fold_share=0.2)),
    "loop": Erring(MapErrors(loop_share=0.5, loop_shift=0.5)),
    "poses": Erring(MapErrors(pose_drift=0.1, pose_drift_deg=5.0)),
    "breath 2": Erring(breathing=BreathingConfig(0.02)),
    "breath 5": Erring(breathing=BreathingConfig(0.05)),
    "breath 10": Erring(breathing=BreathingConfig(0.1)),
    "waves": Erring(breathing=BreathingConfig(0.1, wavelength_mm=40.0)),
}
USUAL_CASES: dict[Size, tuple[Case, ...]] = {"small": ("clean", "wide side", "drift"), "full": tuple(CASES)}
WRONG_SHARE = 0.03
"""Of the points of each case, besides its error: those of a real SLAM."""
