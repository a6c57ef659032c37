"""The verb evaluate: what is judged, a single sequence or those of a suite, and against what; metrics out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from densify.config import DensifyConfig
from densify.dense_map import map_folders
from densify.densified import Densified
from densify.evaluation.judge import (
    THRESHOLDS_MM,
    Evaluation,
    Model,
    dense_models,
    in_mm,
    is_made_by_us,
    judge_depth,
    judge_gap,
    judge_maps,
    read_models,
    read_run,
    read_truth,
    sparse_models,
    with_trajectories,
    withheld_errors,
)
from densify.evaluation.suite import Suite, present, read_suite
from densify.evaluation.tables import write_evaluations
from densify.evaluation.trajectory import read_trajectories, trajectory_files
from densify.inputs import check_unit, map_and_frames
from lightdepth.checkpoint import load_model
from lightdepth.datasets import FormatName, FrameSequence, SequenceSource
from lightdepth.errors import InputError
from lightdepth.models import DepthModel
from lightdepth.options import Group
from lightdepth.presets import shipped
from lightdepth.reporting.run import plain, recorded, run_folder
from lightdepth.sfm.reconstruction import SfmConfig
from lightdepth.sparse_map import SparseMap


@dataclass(frozen=True)
class TruthSource:
    """What is judged against, and how it is read."""

    truth: Path | None = None
    """Sequence with true depth, and for maps with true poses; left out, a densify run's withheld points judge."""
    format: FormatName | None = None
    """Format of the truth: folder, video, c3vd, simcol, hamlyn, scared, endoslam or endomapper; found by looking if
    left out."""
    camera: Path | None = None
    """Calibration file that wins over the truth's own."""
    mask: Path | None = None
    """Image, white where tissue shows and black elsewhere; left out, the folder's own mask, where it has one."""
    truth_mesh: Path | None = None
    """File of the true surface, mm, in the frame of the true poses; left out, C3VD's own or triangulated true
    depth."""

    def sequence(self, folder: Path) -> SequenceSource:
        """A folder of the truth: itself, or one of its sequences."""
        return SequenceSource(folder, self.format, self.camera, mask=self.mask)


@dataclass(frozen=True)
class JudgingConfig:
    """How errors are taken."""

    mm_per_unit: float | None = None
    """Millimetres per map unit, where known: the error after SE(3) needs it. A larger one makes a larger surface."""
    thresholds_mm: tuple[float, ...] = THRESHOLDS_MM
    """Distances, mm, up to which a point counts as right in precision, recall and F-score. Larger ones count more
    points."""
    max_depth_mm: float = 100.0
    """True depth, mm, beyond which pixels take no part in the errors of depth. A larger one judges farther wall
    too."""
    common: bool = False
    """Judge only the frames that both sides have, where there are others."""

    def __post_init__(self) -> None:
        check_unit(self.mm_per_unit)
        if not self.thresholds_mm or not all(t > 0 for t in self.thresholds_mm):
            raise InputError(f"--thresholds-mm {list(self.thresholds_mm)}; expected positive distances in mm")


def evaluate(
    run: Path,
    source: Group[TruthSource] = TruthSource(),
    output: Path | None = None,
    join: Path | None = None,
    suite: Path | None = None,
    checkpoint: str | None = None,
    trajectory: Path | None = None,
    judging: Group[JudgingConfig] = JudgingConfig(),
    overwrite: bool = False,
) -> None:
    """Errors of predictions, a densify run, a map or a trajectory, against truth and between submaps.

    Args:
        run: Folder made by densify or predict, one of its map folders (joined_000), a sparse map, or a trajectory
            (TUM).
        output: Folder for the metrics; left out, evaluation/ in the run.
        join: JSON file with the Sim(3) between two submaps (first, second, scale, rotation, translation), to judge
            their gap.
        suite: YAML file naming the sequences below run and truth that stand in one table (configs/bench/c3vd.yaml).
        checkpoint: Depth model that sparse maps are made dense with first: a path, a bundled name, or decline; the
            surfaces are written.
        trajectory: File with every localised frame of the maps, in place of their keyframes.
        overwrite: Replace metrics made before (evaluation/ in a run is replaced without asking).
    """
    truth = source.truth
    arguments = recorded(
        source,
        judging,
        run=run,
        output=output,
        join=join,
        suite=suite,
        checkpoint=checkpoint,
        trajectory=trajectory,
    )
    if not run.exists():
        raise InputError(f"{run}: no such folder or file")
    if output is None and not is_made_by_us(run):
        raise InputError(f"{run}: not a folder of this program; add -o FOLDER for the metrics")
    if truth is None and join is None and not withheld_errors(run):
        raise InputError(
            "nothing to evaluate against: give --truth DATA, or --join FILE for the gap between two submaps (only a "
            "densify run with withheld points has figures without either)"
        )
    if suite is not None and (truth is None or trajectory or source.truth_mesh or join):
        raise InputError("--suite needs --truth, and goes with neither --trajectory, --truth-mesh nor --join")
    columns: Suite | None = None
    missing: dict[str, str] = {}
    pairs = {truth.name: (run, truth)} if truth is not None else {}
    if suite is not None and truth is not None:
        columns = read_suite(shipped(suite))
        pairs, missing = present(columns, run, truth)
    model = None if checkpoint is None else load_model(checkpoint, details=False)
    found: dict[str, Evaluation] = {}
    withheld = [] if columns else withheld_errors(run)
    extra: dict[str, Any] = {"run": str(run), "truth_folder": truth and str(truth)}
    if join is not None:
        extra["gap"] = judge_gap(read_run(run), join)
    with run_folder(output or run / "evaluation", "evaluate", arguments, overwrite or output is None) as out:
        out.hash_inputs(truth=truth)
        for column, reason in missing.items():
            out.fail(column, reason)
        for name, (judged, folder) in pairs.items():
            try:
                if judged.is_dir() and any(judged.glob("*.npz")):
                    sequence = source.sequence(folder).open()
                    found[name] = judge_depth(judged, sequence, judging.max_depth_mm, judging.common)
                    continue
                if model is None or map_folders(judged) or judged.is_file():
                    sequence, models = (
                        source.sequence(folder).open(),
                        read_models(judged, trajectory),
                    )
                    points = withheld_errors(judged) if columns else []
                else:
                    sparse_map, sequence = map_and_frames(out, source.sequence(folder), judged, SfmConfig())
                    where = out.folder / name if columns else out.folder
                    models, points = _made_dense(sequence, sparse_map, model, where)
                    poses = trajectory or (judged if trajectory_files(judged) else None)
                    models = with_trajectories(models, read_trajectories(poses)) if poses else models
                withheld += [{**entry, "sequence": name} for entry in points] if columns else points
                world = read_truth(sequence, source.truth_mesh, with_surface=any(m.clouds for m in models))
                if columns and columns.fps:
                    world = replace(world, period=1 / columns.fps)
                unit = 1.0 if judging.mm_per_unit is None and in_mm(judged) else judging.mm_per_unit
                found[name] = judge_maps(models, world, unit, judging.thresholds_mm, judging.common)
            except InputError as error:
                if columns is None:
                    raise
                out.fail(name, str(error))
        if columns and not found:
            raise InputError(f"no sequence could be judged; the first: {out.record['failures'][0]['reason']}")
        out.log(write_evaluations(found, out.folder, withheld, extra, columns))


def _made_dense(
    frames: FrameSequence, sparse_map: SparseMap, model: DepthModel, folder: Path
) -> tuple[list[Model], list[dict[str, Any]]]:
    """The maps made dense as `densify` makes them, with its defaults, and written; maps of which no surface was made
    keep their sparse points. And what is said of the withheld points, with the constant distance's."""
    work = Densified.make(frames, sparse_map, model, DensifyConfig())
    constant = {b.dense.submap.id: b.withheld for b in work.baselines}
    withheld = []
    for result in work.results:
        if len(result.dense.triangles):
            result.dense.write(folder / f"map_{result.dense.submap.id:03d}")
        if result.withheld is not None:
            baseline = constant.get(result.dense.submap.id)
            both = {"withheld": result.withheld, "withheld_constant": baseline}
            withheld.append(plain({"map": result.dense.submap.id, **both}))
    dense = {m.trajectory.id: m for m in (dense_models(read_run(folder)) if map_folders(folder) else [])}
    return [dense.get(m.trajectory.id, m) for m in sparse_models(sparse_map)], withheld
