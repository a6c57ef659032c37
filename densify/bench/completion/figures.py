"""What `bench completion` finds, as frozen records: completion.json has them as they are here. Shares are of 1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from densify.evaluation.records import SurfaceFigures


@dataclass(frozen=True)
class KeyframeErrors:
    """Depth of one keyframe against truth, in the scale of the map."""

    abs_rel: float
    """mean of |p - q| / q, p completed and q true depth"""
    rmse_mm: float
    """root of the mean of (p - q)²"""
    medae_mm: float
    """median of |p - q|"""
    share_of_truth: float
    """share of the true depth that was compared"""


@dataclass(frozen=True)
class Band:
    """Pixels whose true depth is within a band, of all keyframes of a row."""

    from_mm: float
    """true depth from which on a pixel counts"""
    to_mm: float
    """true depth up to which it counts"""
    pixels: int
    """number of pixels"""
    abs_rel: float
    """mean of |p - q| / q"""
    bias: float
    """median of p / q - 1: above 0 where the wall is put too far"""


@dataclass(frozen=True)
class RowFigures:
    """One way to complete the keyframes of a cell, or why there is nothing to judge."""

    error: str = ""
    """why there are no figures; empty where there are"""
    depth: KeyframeErrors | None = None
    """mean over the keyframes"""
    keyframes: Mapping[str, KeyframeErrors] | None = None
    """each keyframe, by name"""
    bands: Sequence[Band] = ()
    """by true depth"""
    surface: SurfaceFigures | None = None
    """the keyframes fused into one surface; None where none came about"""


@dataclass(frozen=True)
class FrontPoint:
    """A surface of which only what is trusted most is kept."""

    by: str
    """what is swept: expected error, or views"""
    threshold: float
    """largest expected error [mm], or least number of views, that is kept"""
    kept_share: float
    """share of the surface's vertices that are kept"""
    rms_mm: float
    """from the kept vertices to the truth"""
    median_mm: float
    """median of the same"""
    precision_2mm: float
    """share of the kept vertices within 2 mm of the truth"""
    recall_2mm: float
    """share of the true points within 2 mm of the kept vertices"""


@dataclass(frozen=True)
class SortedPoint:
    """Pixels of which only what is most certain is kept."""

    kept_share: float
    """share of the pixels that are kept"""
    by_uncertainty: float
    """mean of |p - q| / q over the pixels whose uncertainty is predicted least"""
    by_error: float
    """the same over those that err least: what no uncertainty can beat"""


@dataclass(frozen=True)
class CellFigures:
    """One colon with one kind of wrong points."""

    scene: str
    """name of the colon"""
    seed: int
    """seed that it is made from"""
    lens: str
    """its lens"""
    errors: str
    """how the points are wrong: independent or coherent"""
    points: int
    """number of the map's points"""
    keyframes: int
    """number of keyframes that are judged"""
    left_out: Mapping[str, str]
    """why a keyframe is judged for no row, by its name"""
    rows: Mapping[str, RowFigures]
    """by the name of the row"""
    front: Sequence[FrontPoint]
    """error against coverage, of the surface that densify delivers"""
    sorted: Sequence[SortedPoint]
    """error against coverage, of the depth that densify delivers; empty where the model states no uncertainty"""
