"""What a join is, and when two submaps are one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from densify.similarity import Similarity
from lightdepth.errors import InputError

Way = Literal["points", "frames", "looks", "surface"]
WAYS: tuple[Way, ...] = get_args(Way)
"""What two submaps may have in common, as densify.joining says it."""


@dataclass(frozen=True)
class MergeConfig:
    """When two submaps are one. Lengths on the surface are shares of the reach."""

    by: tuple[Way, ...] = ("points", "frames", "looks")
    """What submaps may be joined by, tried in this order: points, frames, looks and surface. "surface", the shape
    alone, has to be asked for: chance can join what is apart."""
    min_agreeing: int = 12
    """Least number of correspondences that must agree on a join. More refuse more joins."""
    min_share: float = 0.2
    """Least share of the correspondences of points and frames that must agree; 30 % wrong points in both maps leave
    40 %. A larger one refuses more joins."""
    min_alike_share: float = 0.1
    """Least share of the points that look alike that must agree; most of these only look alike. A larger one refuses
    more joins."""
    tolerance: float = 0.05
    """Distance up to which correspondences agree, as a share of that from the camera. A larger one joins less exact
    maps, and wrong ones sooner."""
    trials: int = 5000
    """Number of triples of correspondences tried. More find a join among more wrong correspondences and take
    longer."""
    same_pixel: float = 1.0
    """Distance up to which two observations are of one point, pixels. A larger one finds more common points, wrong
    ones among them."""
    max_turn_deg: float = 5.0
    """Largest angle between the two poses of a shared frame, the median over them, degrees. A larger one refuses
    fewer joins."""
    max_shift: float = 0.1
    """Largest distance between the two places of a shared frame, the median over them, as a share of the reach. A
    larger one refuses fewer joins."""
    max_size_ratio: float = 3.0
    """Largest factor between the scale of a join and the ratio of the two reaches, where no frame is shared. A larger
    one lets looks join maps that see wall at more different distances."""
    size_ratios: tuple[float, ...] = (1.0, 0.7, 1.4)
    """Ratios of the two reaches that are tried in turn by surface. More of them find submaps of more different size
    and take longer."""
    max_pairs: int = 60
    """Largest number of pairs of submaps that are compared by looks, and as many again by surface, the nearest in
    time first. More find more joins and take longer."""
    grain: float = 0.06
    """Spacing of the points by which shapes are compared, as a share of the reach. A larger one is coarser and
    faster."""
    feature_radius: float = 0.25
    """Radius of an FPFH feature of the shape, as a share of the reach. A larger one tells more places apart, of
    larger surfaces only."""
    max_gap: float = 0.2
    """Largest median gap between joined surfaces along common rays, as a share of the distance; their own errors are
    in it. A larger one refuses fewer joins."""
    max_shape_gap: float = 0.05
    """Largest median gap after joining by shape, which leaves less, as a share of the distance. A larger one refuses
    fewer joins."""
    max_through: float = 0.15
    """Largest share of the rays to one surface in whose way the other stands. A larger one refuses fewer joins."""
    min_overlap: float = 0.3
    """Least share of a camera's rays to its own surface that must meet the other one too, for that camera to judge
    the join. A larger one judges by fewer cameras, and refuses more joins."""
    min_shape_share: float = 0.15
    """Least share of the features that must agree after joining by shape; by chance 5 % do at most. A larger one
    refuses more joins."""
    min_likeness: float = 0.1
    """Least correlation of colour detail that is enough on its own, in [0, 1]. By chance it reaches 0.06; a pose 2
    degrees off reaches no more. A larger one refuses more joins."""

    def __post_init__(self) -> None:
        unknown = set(self.by) - set(WAYS)
        if unknown:
            raise InputError(
                "merging.by", f"{', '.join(sorted(unknown))} not known", f"expected some of {', '.join(WAYS)}"
            )


@dataclass(frozen=True)
class SurfaceAgreement:
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
    surfaces: SurfaceAgreement | None = None
    reason: str = ""

    @property
    def ok(self) -> bool:
        return not self.reason
