"""What a join is, and when two submaps are one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from densify.similarity import Similarity
from lightdepth.errors import InputError
from lightdepth.ranges import COUNT, SHARE, above, at_least, checked

Way = Literal["points", "frames", "looks", "surface"]
WAYS: tuple[Way, ...] = get_args(Way)
"""What two submaps may have in common, as densify.joining says it."""


@dataclass(frozen=True)
@checked
class MergeConfig:
    """When two submaps are joined. Lengths on the surface are shares of the typical distance from camera to wall."""

    by: tuple[Way, ...] = ("points", "frames", "looks")
    """What submaps may be joined by, tried in the order given: points (map points of both), frames (surfaces seen in
    shared frames), looks (map points that look alike) or surface (the shape alone). surface is off unless it is named:
    chance can join what is apart."""
    min_agreeing: Annotated[int, COUNT] = 12
    """Least number of correspondences (pairs of places taken for the same) that must agree on a join by points, frames
    or looks. More refuse more joins."""
    min_share: Annotated[float, SHARE] = 0.2
    """Least share, in [0, 1], of the correspondences that must agree on a join by points or frames; with 30 % wrong
    points in both maps about 40 % do. A larger one refuses more joins."""
    min_alike_share: Annotated[float, SHARE] = 0.1
    """Least share, in [0, 1], of the pairs of points that look alike that must agree on a join by looks; most pairs
    look alike by chance. A larger one refuses more joins."""
    tolerance: Annotated[float, above(0)] = 0.05
    """Distance within which two places agree, as a share of their distance from the camera. A larger one joins less
    exact maps, and makes wrong joins likelier."""
    trials: Annotated[int, COUNT] = 5000
    """Number of triples of correspondences tried in search of a join, four times as many by surface. More find a join
    among more wrong correspondences and take longer."""
    same_pixel: Annotated[float, at_least(0)] = 1.0
    """Distance, pixels, within which observations of two submaps in a shared frame count as of one point. A larger one
    finds more common points, wrong ones among them."""
    max_turn_deg: Annotated[float, at_least(0, up_to=180)] = 5.0
    """Largest angle, degrees, between the two poses that joined submaps give a shared frame, in the median over such
    frames. A larger one refuses fewer joins."""
    max_shift: Annotated[float, at_least(0)] = 0.1
    """Largest distance between the two places that joined submaps give a shared frame, in the median over such frames,
    as a share of the typical distance from camera to wall. A larger one refuses fewer joins."""
    max_size_ratio: Annotated[float, at_least(1)] = 3.0
    """Largest factor between the scale of a join by looks and what the two submaps' typical distances from camera to
    wall suggest. A larger one joins maps that see wall at more different distances, and lets more wrong scales pass."""
    size_ratios: Annotated[tuple[float, ...], above(0)] = (1.0, 0.7, 1.4)
    """Ratios of the two submaps' typical distances from camera to wall that are tried in turn by surface, 1 being
    equally far. More of them find submaps of more different size and take longer."""
    max_pairs: Annotated[int, at_least(0)] = 60
    """Largest number of pairs of submaps that are compared by looks, and as many again by surface, the nearest in time
    first. More find more joins and take longer."""
    grain: Annotated[float, at_least(0.001, up_to=10)] = 0.06
    """Spacing of the points by which shapes are compared by surface, as a share of the typical distance from camera to
    wall. A larger one compares more coarsely and faster."""
    feature_radius: Annotated[float, at_least(0.001, up_to=100)] = 0.25
    """Radius of the wall around a point that describes its shape (FPFH) by surface, as a share of the typical distance
    from camera to wall. A larger one tells more places apart, and needs larger surfaces."""
    max_gap: Annotated[float, at_least(0)] = 0.2
    """Largest median gap between surfaces joined by points, frames or looks, along rays that meet both, as a share of
    the distance; the surfaces' own errors are in it. A larger one refuses fewer joins."""
    max_shape_gap: Annotated[float, at_least(0)] = 0.05
    """Largest median gap between surfaces joined by surface, along rays that meet both, as a share of the distance;
    max_gap is for the other ways. A larger one refuses fewer joins."""
    max_through: Annotated[float, SHARE] = 0.15
    """Largest share of rays on which the other joined surface stands in front of a camera's own, by more than a quarter
    of the distance. A larger one refuses fewer joins."""
    min_overlap: Annotated[float, SHARE] = 0.3
    """Least share of a camera's rays to its own surface that must meet the other one too, for that camera to judge a
    join; judged by none, only joins by points stand. A larger one judges by fewer cameras, and refuses more joins."""
    min_shape_share: Annotated[float, SHARE] = 0.15
    """Least share of the shape's features that must agree on a join by surface, unless min_likeness is reached; by
    chance 5 % do at most. A larger one refuses more joins."""
    min_likeness: Annotated[float, SHARE] = 0.1
    """Least correlation, in [0, 1], of the fine pattern of brightness on both surfaces with which a join by surface
    stands, unless min_shape_share is reached; chance gives 0.06. A larger one refuses more joins."""

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
