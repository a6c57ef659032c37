"""What the verb evaluate does: it takes what is to be judged, a single sequence or those of a suite, makes maps dense
first where it is asked to, and judges each against its truth."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from densify.additions import additions, said
from densify.config import DensifyConfig
from densify.dense_map import map_folders
from densify.densified import Densified, note_recipe
from densify.evaluation.depth_files import DepthReading
from densify.evaluation.judge import THRESHOLDS_MM, judge_maps
from densify.evaluation.judge_depth import judge_depth
from densify.evaluation.judged_map import (
    JudgedMap,
    dense_models,
    in_mm,
    is_made_by_us,
    read_models,
    read_run,
    sparse_models,
    with_trajectories,
)
from densify.evaluation.records import DepthJudged, Evaluation, MapsJudged
from densify.evaluation.suite import Suite, present, read_suite
from densify.evaluation.trajectory import read_trajectories, trajectory_files
from densify.evaluation.truth import check_truth, read_truth
from densify.inputs import MapSource, fitted_light, map_and_frames
from densify.judging.withheld import WithheldOfMap, withheld_errors
from lightdepth.checkpoint import Device, load_called
from lightdepth.command_line.presets import shipped
from lightdepth.datasets import FormatName, FrameSequence, SequenceSource
from lightdepth.datasets.reading import stamps_of
from lightdepth.errors import InputError
from lightdepth.maps.convention import MapReading, Reader
from lightdepth.models import DepthModel
from lightdepth.ranges import Range, above, checked
from lightdepth.reporting.run import Run
from lightdepth.sfm.config import SfmConfig
from lightdepth.sparse_map import SparseMap


@dataclass(frozen=True)
@checked
class TruthSource:
    """The truth to judge by, and how it is read."""

    truth: Path | None = None
    """Folder of the sequence with true depth (and, to judge maps, true poses); left out, a densify run is judged by its
    map points that were hidden from the alignment."""
    format: FormatName | None = None
    """Format of the truth: folder, video, c3vd, simcol, hamlyn, scared, endoslam or endomapper; found by looking if
    left out."""
    camera: Path | None = None
    """Calibration file, which wins over the one beside the truth."""
    mask: Path | None = None
    """Image, white where tissue shows and black elsewhere: only there is judged; left out, the truth folder's own mask,
    where it has one."""
    light: str | None = None
    """Light of the endoscope by which --checkpoint predicts: a light.json, a photometric XML, or values such as
    gamma=2.2,mu=0. Left out, that of the truth's folder, else one fitted on each map (see --fit-light)."""
    bit_depth: Annotated[int | None, Range(8, 32)] = None
    """Bits per sample of the truth's pictures that have more than 8; left out, it is read from the files, else told by
    their highest values. A larger one reads the same numbers as darker."""
    truth_mesh: Path | None = None
    """Mesh file (PLY, OBJ, STL or GLB) of the true surface, in mm and in the frame of the true poses, only for the
    figure "to true mesh" of surfaces: precision and recall still come from true depth, without which the mesh is not
    used. Left out, C3VD's own mesh where it lies beside the frames, else one made from true depth."""

    def sequence(self, folder: Path) -> SequenceSource:
        """A folder of the truth: itself, or one of its sequences."""
        return SequenceSource(folder, self.format, self.camera, self.light, self.mask, self.bit_depth)


@dataclass(frozen=True)
@checked
class JudgingConfig(MapReading):
    """How errors are measured."""

    mm_per_unit: Annotated[float | None, above(0)] = None
    """Millimetres per map unit, where known, for the trajectory's error after SE(3), that is without fitting its scale;
    left out, only runs in mm have that figure. A larger one takes the trajectory for larger; other errors stay."""
    thresholds_mm: Annotated[tuple[float, ...], above(0)] = THRESHOLDS_MM
    """Distances, mm, up to which a surface point counts as right in precision, recall and F-score, each with figures of
    its own. Larger ones count more points."""
    max_depth_mm: Annotated[float, above(0)] = 100.0
    """True depth along the camera's axis, mm, beyond which pixels are not judged in a folder of predictions; surfaces
    are judged whole. A larger one judges farther wall too."""
    common: bool = False
    """Judge only the frames that the truth has as well; switched off, it is an error where some frames have no
    truth."""
    trust_truth: bool = False
    """Judge even by truth that contradicts its own poses by more than 2 %, or whose unit is unlikely to be millimetres;
    switched off, that is an error."""
    trust_map: bool = False
    """Where the images say that the map was made from other frames than these, only warn and go on; switched off, that
    is an error."""

    def __post_init__(self) -> None:
        if not self.thresholds_mm:
            raise InputError("--thresholds-mm", f"{list(self.thresholds_mm)}", "expected distances in mm")


@dataclass(frozen=True)
class DenseModel:
    """By which model sparse maps are made dense before they are judged."""

    checkpoint: str | None = None
    """Depth model by which a sparse map is made dense first, as densify does with --recipe and its other settings: path
    of a checkpoint, bundled name, decline or constant; the surfaces are written. Left out, its points alone are
    judged."""
    device: Device = "auto"
    """What the network of --checkpoint runs on: auto, a CUDA GPU where there is one, else the processor; cpu, the
    processor; cuda; or mps, the GPU of an Apple computer. On a CUDA GPU, surfaces are fused there too if NVIDIA Warp is
    installed (extra gpu)."""


@dataclass(frozen=True)
class DenseFirst:
    """How sparse maps are made dense before they are judged: as `densify` makes them."""

    model: DepthModel
    """what predicts"""
    config: DensifyConfig = field(default_factory=DensifyConfig)
    """recipe and settings"""
    fit_light: bool = True
    """whether the light is fitted on each map, where nobody gave it"""

    def __str__(self) -> str:
        light = "fitted on each map where nobody gave it" if self.fit_light else "as given, else assumed"
        more = f". {said(additions(self.config))}" if self.config.recipe == "paper" else ""
        return f"Sparse maps were made dense by {self.model.name}, recipe {self.config.recipe}, light {light}{more}"


def dense_first(
    predicting: DenseModel, source: TruthSource, config: DensifyConfig, fit_light: bool
) -> DenseFirst | None:
    """How sparse maps are made dense first; None without a checkpoint.

    Raises InputError where settings of what makes maps dense are given, and nothing makes them dense.
    """
    if predicting.checkpoint is not None:
        model = load_called(predicting.checkpoint, details=False, device=predicting.device)
        return DenseFirst(model, config, fit_light)
    if config != DensifyConfig() or source.light is not None or not fit_light or predicting.device != "auto":
        raise InputError(
            "settings of densify, --light, --fit-light or --device",
            "given without --checkpoint: nothing is made dense",
            "add --checkpoint NAME, or leave them out",
        )
    return None


@dataclass(frozen=True)
class Asked:
    """What a user wants judged, of which it is known that it goes together."""

    run: Path
    """predictions, a densify run, a map or a trajectory; the folder of several where there is a suite"""
    source: TruthSource
    """what is judged against"""
    config: JudgingConfig
    """how errors are taken"""
    trajectory: Path | None
    """every localised frame of the maps, in place of their keyframes"""
    reading: DepthReading
    """what the files of a folder of predictions are"""
    suite: Suite | None = None
    """which sequences stand in one table; None for a single one"""
    pairs: Mapping[str, tuple[Path, Path]] = field(default_factory=dict)
    """what is judged and the folder of its truth, by the name of the sequence"""
    missing: Mapping[str, str] = field(default_factory=dict)
    """why a sequence of the suite is not judged, by its name"""


def read_asked(
    run: Path,
    source: TruthSource,
    config: JudgingConfig,
    join: Path | None = None,
    suite: Path | None = None,
    trajectory: Path | None = None,
    in_place: bool = False,
    reading: DepthReading = DepthReading(),
) -> Asked:
    """Raises InputError where the options do not go together. `in_place` is whether the metrics go into the run."""
    truth = source.truth
    if not run.exists():
        raise InputError(run, "no such folder or file", "expected a run, predictions, a map or a trajectory")
    other = reading.depth_kind is not None
    if in_place and (other or not is_made_by_us(run)):
        raise InputError(run, "not a folder of this program", "add -o FOLDER for the metrics")
    if other and truth is None:
        raise InputError("--depth-kind", "given without --truth", "give --truth DATA, a sequence with true depth")
    if truth is None and join is None and not withheld_errors(run):
        raise InputError(
            "--truth",
            "nothing to evaluate against",
            "give --truth DATA, or --join FILE for the gap between two submaps (only a densify run with withheld "
            "points has figures without either)",
        )
    if suite is not None and (truth is None or trajectory or source.truth_mesh or join):
        raise InputError(
            "--suite",
            "without --truth, or with --trajectory, --truth-mesh or --join",
            "it needs --truth, and goes with none of the others",
        )
    if truth is None:
        return Asked(run, source, config, trajectory, reading)
    if suite is None:
        name = os.path.basename(os.path.abspath(truth))  # `.` has no name of its own
        return Asked(run, source, config, trajectory, reading, pairs={name: (run, truth)})
    columns = read_suite(shipped(suite))
    pairs, missing = present(columns, run, truth)
    return Asked(run, source, config, trajectory, reading, columns, pairs, missing)


@dataclass(frozen=True)
class Answer:
    """What all that was asked for gave."""

    found: Mapping[str, Evaluation[DepthJudged | MapsJudged]]
    """by the name of the sequence"""
    withheld: Sequence[WithheldOfMap]
    """what the maps' withheld points say"""


def judge_asked(asked: Asked, first: DenseFirst | None, out: Run) -> Answer:
    """All that was asked for; sparse maps are made dense `first`, where that is given, and the surfaces written.

    A sequence of a suite that cannot be judged is among the run's failures; InputError is raised when none can, and for
    a single sequence.
    """
    found: dict[str, Evaluation[DepthJudged | MapsJudged]] = {}
    withheld = [] if asked.suite else withheld_errors(asked.run)
    if first is not None:
        note_recipe(out, first.config)
    for name, reason in asked.missing.items():
        out.fail(name, reason)
    for name, (judged, folder) in asked.pairs.items():
        try:
            if asked.reading.depth_kind is not None or (judged.is_dir() and any(judged.glob("*.npz"))):
                frames = asked.source.sequence(folder).open()
                check_truth(frames, asked.config.trust_truth)
                found[name] = judge_depth(judged, frames, asked.config.max_depth_mm, asked.config.common, asked.reading)
                continue
            frames, maps, points = _maps(asked, name, first, out)
            withheld += [replace(entry, sequence=name) for entry in points] if asked.suite else points
            found[name] = _judged_maps(asked, judged, maps, frames)
        except InputError as error:
            if asked.suite is None:
                raise
            out.fail(name, str(error))
    if asked.suite and not found:
        raise InputError(
            "the sequences", "none could be judged", f"the first reason: {out.record['failures'][0]['reason']}"
        )
    return Answer(found, withheld)


def _maps(
    asked: Asked, name: str, first: DenseFirst | None, out: Run
) -> tuple[FrameSequence, list[JudgedMap], list[WithheldOfMap]]:
    """The frames of a sequence, its maps, and what is said of their withheld points where it was not said before."""
    judged, folder = asked.pairs[name]
    if first is None or map_folders(judged) or judged.is_file():
        if first is not None:
            out.log(f"{name}: taken as it is, dense or without points; --checkpoint and its settings change nothing")
        frames = asked.source.sequence(folder).open()
        reader = Reader(asked.config, stamps_of(folder, asked.source.format), frames.first().camera)
        maps = read_models(judged, asked.trajectory, reader)
        check_truth(frames, asked.config.trust_truth)
        return frames, maps, withheld_errors(judged) if asked.suite else []
    mapped = MapSource.read_as(judged, asked.config, asked.config.trust_map)
    source = asked.source.sequence(folder)
    sparse_map, frames = map_and_frames(out, source, mapped, SfmConfig())
    known = source.open(sparse_map.submaps[0].keyframes[0].camera)  # those that are predicted from have no truth
    check_truth(known, asked.config.trust_truth)
    if asked.suite:
        out.record.setdefault("pairings", {})[name] = out.record.pop("pairing")
    lit = fitted_light(out, frames, sparse_map, first.model, first.config, first.fit_light)
    if asked.suite and "light_fit" in out.record:
        out.record.setdefault("light_fits", {})[name] = out.record.pop("light_fit")
    maps, points = _made_dense(lit, sparse_map, first, out.folder / name if asked.suite else out.folder)
    reader = Reader(asked.config, stamps_of(folder, asked.source.format))
    poses = asked.trajectory or (judged if trajectory_files(judged) else None)
    return known, with_trajectories(maps, read_trajectories(poses, reader)) if poses else maps, points


def _judged_maps(
    asked: Asked, judged: Path, maps: Sequence[JudgedMap], frames: FrameSequence
) -> Evaluation[MapsJudged]:
    truth = read_truth(frames, asked.source.truth_mesh, with_surface=any(m.clouds for m in maps))
    if asked.suite and asked.suite.fps:
        truth = replace(truth, period=1 / asked.suite.fps)
    unit = 1.0 if asked.config.mm_per_unit is None and in_mm(judged) else asked.config.mm_per_unit
    return judge_maps(maps, truth, unit, asked.config.thresholds_mm, asked.config.common)


def _made_dense(
    frames: FrameSequence, sparse_map: SparseMap, first: DenseFirst, folder: Path
) -> tuple[list[JudgedMap], list[WithheldOfMap]]:
    """The maps made dense as `densify` makes them, and written; maps of which no surface was made
    keep their sparse points. And what is said of the withheld points, with the constant distance's."""
    work = Densified.make(frames, sparse_map, first.model, first.config)
    withheld = []
    for result in work.results:
        map_id = result.dense.submap.id
        if len(result.dense.triangles):
            result.dense.write(folder / f"map_{map_id:03d}")
        judged = result.judgement
        if judged is not None and judged.hidden is not None:
            withheld.append(WithheldOfMap(map_id, judged.hidden, judged.hidden_constant))
    dense = {m.trajectory.id: m for m in (dense_models(read_run(folder)) if map_folders(folder) else [])}
    return [dense.get(m.trajectory.id, m) for m in sparse_models(sparse_map)], withheld
