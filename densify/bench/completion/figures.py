"""What `bench completion` finds, as frozen records: completion.json has them as they are here. Shares are of 1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from densify.bench.curves import Band, FrontPoint, SortedPoint
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
