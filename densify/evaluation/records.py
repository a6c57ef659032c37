"""What an evaluation found, as frozen records. `record()` is how metrics.json has one: keys, order and values.

A figure is named with its unit: `rms_mm`. A share is of 1. The attribute is the key of the file, except where it says
otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from densify.judging.withheld import WithheldOfMap
from lightdepth.reporting.record import git_revision, versions
from lightdepth.reporting.run import plain


def with_versions(record: Mapping[str, Any]) -> dict[str, Any]:
    """The figures with what they were computed by. No time: the same work gives the same file."""
    result: dict[str, Any] = plain({**record, "versions": versions(), "revision": git_revision()})
    return result


# Surfaces


@dataclass(frozen=True)
class DistanceFigures:
    """Distances in three numbers [mm]."""

    rms_mm: float
    """root of the mean square"""
    median_mm: float
    """half of the distances are below it"""
    p90_mm: float
    """nine tenths of the distances are below it"""

    @classmethod
    def of(cls, distance: np.ndarray) -> DistanceFigures:
        """Of distances (n,) [mm], at least one."""
        rms = float(np.sqrt(np.mean(np.square(distance))))
        return cls(rms, float(np.median(distance)), float(np.quantile(distance, 0.9)))


@dataclass(frozen=True)
class SurfaceFigures:
    """Errors of a model's points, without any cap."""

    points: int
    """number of the model's points"""
    rms_mm: float
    """root mean square distance from the model's points to the closest true point (accuracy)"""
    median_mm: float
    """median of these distances"""
    p90_mm: float
    """90th percentile of these distances"""
    to_mesh: DistanceFigures | None
    """from the model's points to the true mesh, where there is one"""
    completeness: DistanceFigures
    """from the true points to the closest of the model's"""
    precision: Mapping[str, float]
    """share of the model's points within a distance of the truth, by the distance ("2mm")"""
    recall: Mapping[str, float]
    """share of the true points within a distance of the model, by the distance"""
    f_score: Mapping[str, float]
    """harmonic mean of precision and recall, by the distance"""
    chamfer_mm: float
    """mean of the mean distances both ways: from the model's points to the truth, and back"""
    sharp_edges: float | None = None
    """share of the mesh's edges at which it turns by more than 30 degrees; None where it has no triangles"""


@dataclass(frozen=True)
class Gap:
    """|d1 - d2| / d1 along common rays, d the distances from the camera to two surfaces."""

    rays: int
    """number of rays that meet both surfaces"""
    median: float
    """median over these rays"""
    p90: float
    """90th percentile over these rays"""
    both_share: float
    """share of the rays that meet either surface which meet both"""


@dataclass(frozen=True)
class MapGap:
    """The gap between two maps of a run, by their ids."""

    first: int
    """id of the map whose cameras cast the rays"""
    second: int
    """id of the map that is brought to it"""
    gap: Gap
    """flat in the file"""

    def record(self) -> dict[str, Any]:
        unit = "share of the distance to the camera"
        return {"first": self.first, "second": self.second, "unit": unit, **asdict(self.gap)}


# Maps


@dataclass(frozen=True)
class AlignedFigures:
    """One submap's trajectory after its alignment."""

    poses: int
    """number of its poses that have a true one"""
    rms_ate_mm: float
    """after Sim(3)"""
    rms_ate_se3_mm: float | None
    """after SE(3); None where the scale of the map is not known"""
    mm_per_unit: float
    """millimetres per map unit, by the Sim(3)"""
    sideways_agreement: float
    """correlation of the aligned centres with the true ones across the line of travel, at most 1"""


@dataclass(frozen=True)
class TrajectoryFigures:
    """All submaps' trajectories together, out of the sequence's frames."""

    frames: int
    """number of the sequence's frames"""
    frames_localised: int | None
    """number of frames with a pose in any submap; None where the trajectories hold keyframes alone"""
    localised_share: float | None
    """share of the sequence's frames that they are"""
    localised_of: str
    """what the share is of, or why it is not known"""
    keyframes: int
    """number of frames that are a keyframe of any submap"""
    submaps: int
    """number of submaps"""
    submaps_aligned: int
    """number of submaps that could be aligned"""
    poses: int
    """number of poses that have a true one, of all aligned submaps"""
    rms_ate_mm: float
    """over all poses, each after its own submap's Sim(3)"""
    rms_ate_se3_mm: float | None
    """over all poses, each after its own submap's SE(3); None where the scale of no map is known"""
    rms_rpe_mm: float
    """over all steps from one pose to the next, after Sim(3): length of the difference between the step and the true
    one"""
    climb_ate_mm: float | None
    """CLiMB's mean of the submaps', weighted by their poses; None where no submap has enough"""
    climb_submaps: int
    """number of submaps that CLiMB counts"""
    climb_rule: str
    """which submaps CLiMB counts, and how"""
    ms_per_keyframe: float | None = None
    """time that the recording leaves for each keyframe"""


@dataclass(frozen=True)
class MapFigures:
    """One submap: its figures, or why it has none. Flat in the file."""

    map_id: int
    """id of the submap; `map` in the file"""
    keyframes: int
    """number of its keyframes"""
    error: str = ""
    """why its trajectory could not be aligned; not in the file where it could"""
    aligned: AlignedFigures | None = None
    """None where it could not; flat in the file"""
    surface_error: str = ""
    """why its surface cannot be compared; not in the file where it can"""
    clouds: Mapping[str, SurfaceFigures | None] = field(default_factory=dict)
    """by the name of the point cloud; None for a cloud without points; flat in the file"""

    def alone(self) -> dict[str, Any]:
        """The figures that are of no cloud."""
        aligned = {} if self.aligned is None else asdict(self.aligned)
        return {"keyframes": self.keyframes, **aligned}

    def record(self) -> dict[str, Any]:
        reasons = {"error": self.error, "surface_error": self.surface_error}
        clouds = {name: cloud and asdict(cloud) for name, cloud in self.clouds.items()}
        return {"map": self.map_id, **self.alone(), **{k: v for k, v in reasons.items() if v}, **clouds}


@dataclass(frozen=True)
class TruthFigures:
    """What maps were judged against."""

    frames: int
    """number of the sequence's frames"""
    poses: int
    """number of frames that have a true pose"""
    cloud: str
    """how the true cloud was sampled, or why there is none"""
    cloud_points: int | None
    """number of its points"""
    cloud_spacing_mm: float | None
    """median distance between neighbouring points"""
    mesh: str | None
    """where the true mesh is from"""
    sharp_edges: float | None = None
    """share of the true mesh's edges at which it turns by more than 30 degrees"""


@dataclass(frozen=True)
class MapsJudged:
    """Submaps against a sequence with true poses: each, and all together."""

    truth: TruthFigures
    """what they were judged against"""
    thresholds_mm: Sequence[float]
    """distances of precision, recall and F-score"""
    trajectory: TrajectoryFigures
    """of all submaps together"""
    pooled: Mapping[str, SurfaceFigures]
    """the clouds of the submaps together, by name; `all` in the file"""
    maps: Sequence[MapFigures]
    """each submap, in the order given"""

    alignment = "Sim(3) of each submap's trajectory to the true one (least ATE); SE(3) where the map is in mm"
    mask = (
        "true points inside the frames' mask (the image without its border) and the lens's field, true depth known (in "
        "C3VD neither 0 nor 65535); no cap; every model point counts"
    )

    def record(self) -> dict[str, Any]:
        return {
            "kind": "surface" if self.pooled else "trajectory",
            "unit": "mm; shares of 1",
            "alignment": self.alignment,
            "mask": self.mask,
            "truth": asdict(self.truth),
            "thresholds_mm": list(self.thresholds_mm),
            "trajectory": asdict(self.trajectory),
            "all": {name: asdict(figures) for name, figures in self.pooled.items()},
            "maps": [figures.record() for figures in self.maps],
        }


# Predictions


@dataclass(frozen=True)
class DepthFigures:
    """Errors of a frame's depth, or their mean over frames. Flat in the file."""

    errors: Mapping[str, float]
    """by NAME_ALIGNMENT"""
    pixels: float
    """number of pixels that were compared"""
    share_of_image: float
    """share of the image that was compared"""
    share_of_truth: float
    """share of the valid truth that was compared"""

    @classmethod
    def mean(cls, figures: Sequence[DepthFigures]) -> DepthFigures:
        """Each figure's mean over frames that have the same errors."""

        def over(values: Sequence[float]) -> float:
            return float(np.mean(values))

        return cls(
            {key: over([f.errors[key] for f in figures]) for key in figures[0].errors},
            over([f.pixels for f in figures]),
            over([f.share_of_image for f in figures]),
            over([f.share_of_truth for f in figures]),
        )

    def record(self) -> dict[str, Any]:
        shares = {"share_of_image": self.share_of_image, "share_of_truth": self.share_of_truth}
        return {**self.errors, "pixels": self.pixels, **shares}


@dataclass(frozen=True)
class DepthJudged:
    """Predictions against a sequence with true depth: each frame, and their mean."""

    predicted_unit: str
    """unit of the predictions; several are parted by commas"""
    alignment: Mapping[str, str]
    """what each alignment does, by its name"""
    max_depth_mm: float
    """true depth from which on a pixel takes no part"""
    frames_of_truth: int
    """number of the sequence's frames"""
    frames_predicted: int
    """number of predictions"""
    mean: DepthFigures
    """over the frames that were judged"""
    frames: Mapping[str, DepthFigures]
    """by the name of the prediction"""
    skipped: Mapping[str, str]
    """why a frame has no figures, by its name"""

    @property
    def frames_judged(self) -> int:
        return len(self.frames)

    @property
    def mask(self) -> str:
        return (
            "inside the frame's mask (the image without its border) and the lens's field, true depth known (in C3VD "
            f"neither 0 nor 65535), 0 < true depth < {self.max_depth_mm:g} mm, prediction valid and positive; "
            "predictions are not clipped"
        )

    def record(self) -> dict[str, Any]:
        return {
            "kind": "depth",
            "unit": "mm, but abs_rel, rmse_log (natural logarithm) and the shares delta1, delta2, delta3",
            "predicted_unit": self.predicted_unit,
            "alignment": dict(self.alignment),
            "mask": self.mask,
            "max_depth_mm": self.max_depth_mm,
            "averaged": "over the pixels of a frame, then over frames",
            "frames_of_truth": self.frames_of_truth,
            "frames_predicted": self.frames_predicted,
            "frames_judged": self.frames_judged,
            "mean": self.mean.record(),
            "frames": {name: figures.record() for name, figures in self.frames.items()},
            "skipped": dict(self.skipped),
        }


# Evaluations


EDGES_MM = np.geomspace(0.05, 200, 145)
"""Where the cumulative error curves are taken."""
Judged = TypeVar("Judged", bound="DepthJudged | MapsJudged", covariant=True)


@dataclass(frozen=True)
class ErrorMesh:
    """A surface in the true world with the distance of each vertex from the true cloud."""

    name: str
    """how its files begin"""
    vertices: np.ndarray
    """(n, 3) [mm]"""
    triangles: np.ndarray
    """(m, 3) indices of vertices"""
    distance: np.ndarray
    """(n,) [mm]"""


@dataclass(frozen=True)
class Evaluation(Generic[Judged]):
    """Figures, and what their pictures are drawn from."""

    judged: Judged
    """the figures"""
    curves: Mapping[str, np.ndarray] = field(default_factory=dict)
    """shares of the errors within EDGES_MM, by name"""
    meshes: Sequence[ErrorMesh] = ()
    """surfaces to be coloured by their errors"""

    def as_dict(self) -> dict[str, Any]:
        """The figures as metrics.json has them."""
        return with_versions(self.judged.record())


@dataclass(frozen=True)
class Sources:
    """What a user gave to be judged, how it was made dense, and the gap between two submaps where it was asked for."""

    run: Path
    """what was judged"""
    truth: Path | None
    """what it was judged against; `truth_folder` in the file"""
    gap: MapGap | None = None
    """not in the file where it was not asked for"""
    made: str = ""
    """how sparse maps were made dense first; empty, and not in the file, where none was"""

    def record(self) -> dict[str, Any]:
        gap = {} if self.gap is None else {"gap": plain(self.gap.record())}
        made = {"made_dense": self.made} if self.made else {}
        return {"run": str(self.run), "truth_folder": self.truth and str(self.truth), **gap, **made}


def metrics_record(
    found: Mapping[str, Evaluation[DepthJudged | MapsJudged]],
    withheld: Sequence[WithheldOfMap],
    sources: Sources | None,
) -> dict[str, Any]:
    """metrics.json. One sequence's figures are the file itself, those of several are in it by name."""
    several = {name: evaluation.as_dict() for name, evaluation in found.items()}
    record = next(iter(several.values())) if len(several) == 1 else with_versions({"sequences": several})
    record |= {"withheld": [plain(entry.record()) for entry in withheld]} if withheld else {}
    return record | ({} if sources is None else sources.record())
