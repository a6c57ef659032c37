"""What a join is, and when two submaps are one."""

from __future__ import annotations

from dataclasses import dataclass

from densify.similarity import Similarity
from lightdepth.errors import InputError

WAYS = ("points", "frames", "looks", "surface")
"""What two submaps may have in common, as densify.joining says it."""


@dataclass(frozen=True)
class MergeConfig:
    """When two submaps are one. Lengths on the surface are shares of the reach."""

    # What to join by, in this order. "surface", by shape alone, has to be asked for: chance can join what is apart.
    by: tuple[str, ...] = ("points", "frames", "looks")
    min_agreeing: int = 12  # correspondences
    min_share: float = 0.2  # of the correspondences of points and frames; 30 % wrong points in both maps leave 40 %
    min_alike_share: float = 0.1  # of the points that look alike, most of which only do so
    tolerance: float = 0.05  # correspondences agree within this share of the distance from the camera
    trials: int = 5000  # triples of correspondences tried
    same_pixel: float = 1.0  # px between two observations of one point
    max_turn_deg: float = 5.0  # between the two poses of a shared frame, median
    max_shift: float = 0.1  # the same for their places
    max_size_ratio: float = 3.0  # of the reaches, where no frame is shared
    size_ratios: tuple[float, ...] = (1.0, 0.7, 1.4)  # of the reaches, tried in turn by surface
    max_pairs: int = 60  # submaps compared by looks, and by surface; the nearest in time first
    grain: float = 0.06  # spacing of the points by which shapes are compared
    feature_radius: float = 0.25  # of an FPFH feature
    max_gap: float = 0.2  # between joined surfaces along common rays, median; their own errors are in it
    max_shape_gap: float = 0.05  # the same after joining by shape, which leaves less
    max_through: float = 0.15  # share of rays to one surface in whose way the other stands
    min_overlap: float = 0.3  # share of the rays of a camera that must meet both surfaces
    min_shape_share: float = 0.15  # of the features that must agree after joining by shape; chance gives 5 % at most
    # Or else the correlation of the finer colours; chance gives 0.06 at most, 2 degrees off no more.
    min_likeness: float = 0.1

    def __post_init__(self) -> None:
        unknown = set(self.by) - set(WAYS)
        if unknown:
            raise InputError(f"merging.by {', '.join(sorted(unknown))}; expected some of {', '.join(WAYS)}")


@dataclass(frozen=True)
class Agreement:
    """Two joined surfaces along the rays of the cameras that see both: the median gap over the distance, the share of
    a camera's rays that meet both, and the share on which the other surface stands in front."""

    gap: float
    overlap: float
    through: float


@dataclass(frozen=True)
class Join:
    """How one submap comes to another, or `reason`: why it does not. `agreeing` of `matches` correspondences are within
    the tolerance; `error` is their median distance over that from the camera."""

    target: int
    source: int
    by: str
    target_from_source: Similarity | None = None
    matches: int = 0
    agreeing: int = 0
    error: float = 0.0
    surfaces: Agreement | None = None
    reason: str = ""

    @property
    def ok(self) -> bool:
        return not self.reason
