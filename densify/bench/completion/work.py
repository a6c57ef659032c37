"""One cell of `bench completion`: a colon with one kind of wrong points, completed in every way and judged.

Depth is judged keyframe by keyframe on every pixel that is valid in prediction and truth, below 100 mm, in the scale
that the similarity of the trajectory gives; nothing is aligned once more. Each row's depth is fused in the same way, by
densify's own volume as far as fusion.far reaches and where it is expected to be right, without the step that leaves
contradicted pixels out. The row `densify` is what the verb delivers: its bends as the images lessened them, and its
surface.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass
from functools import partial
from pathlib import Path

import numpy as np

from densify.bench.completion.external import read_external
from densify.bench.completion.figures import CellFigures, KeyframeErrors, RowFigures
from densify.bench.completion.methods import METHODS, Completed, Task
from densify.bench.completion.scenes import Errors, map_with
from densify.bench.curves import bands_of, front, sorted_errors
from densify.bench.scenes import Rendered
from densify.config import DensifyConfig
from densify.dense_map import DenseMap
from densify.evaluation.errors import ComparedDepth, compare_depth
from densify.evaluation.judge import judge_maps
from densify.evaluation.judged_map import JudgedMap
from densify.evaluation.records import SurfaceFigures
from densify.evaluation.trajectory import align_trajectory, keyframe_trajectory
from densify.fusers import sure
from densify.fusion.rectify import surface_view
from densify.fusion.volume import TsdfVolume
from densify.pipeline import densify
from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.prediction import DepthPrediction
from lightdepth.sparse_map import SparseMap

DELIVERED = "densify"
"""The row of what `lightdepth densify` delivers."""


@dataclass(frozen=True, eq=False)
class Cell:
    """A colon with one kind of wrong points, and what a model says of its keyframes, by the name of the frame."""

    rendered: Rendered
    errors: Errors
    known: Mapping[str, DepthPrediction]
    config: DensifyConfig

    def task(self) -> Task:
        """What the methods are given."""
        (submap,) = map_with(self.rendered, self.errors).submaps
        return Task.of(submap, self.rendered.frames, self.known, self.config)

    def truth_of(self, task: Task, name: str) -> Frame:
        """The frame of a keyframe, with its truth."""
        frame = task.seen[name].frame
        assert frame is not None
        return frame


@dataclass(frozen=True, eq=False)
class Judged:
    """A cell's figures, what was judged, and its completions by row and keyframe, for pictures."""

    figures: CellFigures
    task: Task
    completed: Mapping[str, Completed]
    mm_per_unit: float


def judged_cell(
    cell: Cell, external: Mapping[str, Path], task: Task | None = None, on_row: Callable[[], None] = lambda: None
) -> Judged:
    """Every row of a cell; `external` has folders of completions by the names of their rows."""
    task = task or cell.task()
    scene, submap = cell.rendered.scene, task.submap
    aligned = align_trajectory(keyframe_trajectory(submap), cell.rendered.truth.poses)
    mm = aligned.true_from_map.scale
    completed: dict[str, Completed] = {}
    rows: dict[str, RowFigures] = {}
    for name, method in METHODS.items():
        completed[name] = method(task)
        rows[name] = _row(cell, task, completed[name], fused(task, completed[name]), mm)
        on_row()
    (result,) = densify(
        cell.rendered.frames, SparseMap((submap,), "simulated SLAM"), partial(_known, cell.known), cell.config
    )
    completed[DELIVERED] = _delivered(task, result.dense)
    rows[DELIVERED] = _row(cell, task, completed[DELIVERED], result.dense.vertices, mm)
    on_row()
    for name, folder in external.items():
        place = folder / scene.name / cell.errors
        completed[name], lacking = read_external(place, task)
        rows[name] = (
            _row(cell, task, completed[name], fused(task, completed[name]), mm)
            if completed[name]
            else RowFigures(f"none of the {lacking} keyframes is in {scene.name}/{cell.errors}")
        )
        on_row()
    assert cell.rendered.truth.surface is not None
    compared, sigmas = [], []
    for keyframe, prediction in completed[DELIVERED].items():
        if prediction.uncertainty is not None:
            compared.append(compare_depth(prediction.scaled(mm), cell.truth_of(task, keyframe)))
            sigmas.append(prediction.uncertainty)
    figures = CellFigures(
        scene=scene.name,
        seed=scene.seed,
        lens=scene.lens,
        errors=cell.errors,
        points=len(submap.points),
        keyframes=len(task.keyframes),
        left_out=task.left_out,
        rows=rows,
        front=front([(result.dense, aligned.true_from_map)], cell.rendered.truth.surface),
        sorted=sorted_errors(compared, sigmas),
    )
    return Judged(figures, task, completed, mm)


def _known(predictions: Mapping[str, DepthPrediction], frame: Frame) -> DepthPrediction:
    return predictions[frame.name]


def _delivered(task: Task, dense: DenseMap) -> dict[str, DepthPrediction]:
    own = {k.keyframe.name for k in task.keyframes}
    found = {}
    for keyframe, alignment in zip(dense.submap.keyframes, dense.alignments, strict=True):
        prediction = task.seen[keyframe.name].prediction
        if alignment.ok and keyframe.name in own and prediction is not None:
            found[keyframe.name] = alignment.applied(prediction)
    return found


def fused(task: Task, completed: Completed) -> np.ndarray:
    """Vertices (n, 3) in map units of the surface that a row's keyframes make together."""
    fusion = task.config.fusion
    volume = TsdfVolume(fusion.voxel_for(task.submap), fusion)
    for k in task.keyframes:
        frame, prediction = task.seen[k.keyframe.name].frame, completed.get(k.keyframe.name)
        if prediction is not None and frame is not None:
            reach = k.alignment.range_90
            taken = sure(prediction, reach, frame.image, fusion)
            view = surface_view(taken, frame.image, task.config.rectify, fusion.far * reach)
            volume.integrate(view, k.keyframe.cam_from_map)
    return volume.extract_mesh().vertices


def _row(cell: Cell, task: Task, completed: Completed, vertices: np.ndarray, mm: float) -> RowFigures:
    compared = {name: compare_depth(p.scaled(mm), cell.truth_of(task, name)) for name, p in completed.items()}
    if not compared:
        return RowFigures("no keyframe was aligned")
    each = {name: _errors(c) for name, c in compared.items()}
    mean = KeyframeErrors(*np.mean([astuple(e) for e in each.values()], 0).tolist())
    return RowFigures("", mean, each, bands_of(list(compared.values())), _surface(cell, task, vertices))


def _errors(compared: ComparedDepth) -> KeyframeErrors:
    found = compared.errors(["none"])
    errors = found["abs_rel_none"], found["rmse_mm_none"], found["medae_mm_none"]
    return KeyframeErrors(*errors, compared.share_of_truth)


def _surface(cell: Cell, task: Task, vertices: np.ndarray) -> SurfaceFigures | None:
    model = JudgedMap(keyframe_trajectory(task.submap), {"dense": vertices})
    try:
        return judge_maps([model], cell.rendered.truth).judged.pooled.get("dense")
    except InputError:  # turned about its line of travel by chance, or empty
        return None
