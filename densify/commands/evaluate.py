"""The verb evaluate: what is judged, a single sequence or those of a suite, and against what; metrics out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

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
from densify.inputs import map_and_frames
from densify.pipeline import DensifyConfig
from lightdepth.checkpoint import load_model
from lightdepth.datasets import FrameSequence, open_sequence
from lightdepth.errors import InputError
from lightdepth.models import DepthModel
from lightdepth.reporting.run import plain, run_folder
from lightdepth.sfm.reconstruction import SfmConfig
from lightdepth.sparse_map import SparseMap


def evaluate(
    run: Path,
    truth: Path | None = None,
    output: Path | None = None,
    join: Path | None = None,
    suite: Path | None = None,
    checkpoint: str | None = None,
    trajectory: Path | None = None,
    truth_mesh: Path | None = None,
    mm_per_unit: float | None = None,
    thresholds_mm: tuple[float, ...] = THRESHOLDS_MM,
    max_depth_mm: float = 100.0,
    common: bool = False,
    format: str | None = None,
    camera: Path | None = None,
    mask: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Errors of predictions, a densify run, a map or a trajectory, against truth and between submaps.

    Args:
        run: folder made by densify or predict, one of its map folders (joined_000), a sparse map, or a trajectory (TUM)
        truth: sequence with true depth, and for maps with true poses; left out, a densify run's withheld points judge
        output: folder for the metrics; evaluation/ in the run when left out
        join: JSON with the Sim(3) between two submaps (first, second, scale, rotation, translation): their gap
        suite: YAML naming the sequences below run and truth that stand in one table (configs/bench/c3vd.yaml)
        checkpoint: sparse maps are made dense with it first, and the surfaces written: a path, a bundled name, decline
        trajectory: every localised frame of the maps, in place of their keyframes
        truth_mesh: true surface, mm, in the frame of the true poses; left out, C3VD's own or triangulated true depth
        mm_per_unit: millimetres per map unit, where known: the error after SE(3) needs it
        thresholds_mm: of precision, recall and F-score
        max_depth_mm: true depth beyond this takes no part in the errors of depth
        common: judge the frames that both sides have, where there are others
        format: the truth's: folder, video, c3vd, simcol, hamlyn, scared, endoslam, endomapper; found if left out
        camera: calibration file that wins over the truth's
        mask: image, white where tissue shows
        overwrite: replace metrics made before (evaluation/ in a run is replaced without asking)
    """
    arguments = {k: v for k, v in locals().items() if k != "overwrite"}
    if not run.exists():
        raise InputError(f"{run}: no such folder or file")
    if output is None and not is_made_by_us(run):
        raise InputError(f"{run}: not a folder of this program; add -o FOLDER for the metrics")
    if mm_per_unit is not None and not mm_per_unit > 0:
        raise InputError(f"--mm-per-unit {mm_per_unit}; expected a positive number of millimetres")
    if not thresholds_mm or not all(t > 0 for t in thresholds_mm):
        raise InputError(f"--thresholds-mm {list(thresholds_mm)}; expected positive distances in mm")
    if truth is None and join is None and not withheld_errors(run):
        raise InputError(
            "nothing to evaluate against: give --truth DATA, or --join FILE for the gap between two submaps (only a "
            "densify run with withheld points has figures without either)"
        )
    if suite is not None and (truth is None or trajectory or truth_mesh or join):
        raise InputError("--suite needs --truth, and goes with neither --trajectory, --truth-mesh nor --join")
    columns: Suite | None = None
    missing: dict[str, str] = {}
    pairs = {truth.name: (run, truth)} if truth is not None else {}
    if suite is not None and truth is not None:
        columns = read_suite(suite)
        pairs, missing = present(columns, run, truth)
    model = None if checkpoint is None else load_model(checkpoint, details=False)
    found: dict[str, Evaluation] = {}
    withheld = [] if columns else withheld_errors(run)
    extra: dict[str, Any] = {"run": str(run), "truth_folder": truth and str(truth)}
    if join is not None:
        extra["gap"] = judge_gap(read_run(run), join)
    with run_folder(output or run / "evaluation", "evaluate", arguments, overwrite or output is None) as out:
        out.hash_input("truth", truth)
        for column, reason in missing.items():
            out.fail(column, reason)
        for name, (source, folder) in pairs.items():
            try:
                if source.is_dir() and any(source.glob("*.npz")):
                    sequence = open_sequence(folder, format, camera, None, mask)
                    found[name] = judge_depth(source, sequence, max_depth_mm, common)
                    continue
                if model is None or map_folders(source) or source.is_file():
                    sequence, models = (
                        open_sequence(folder, format, camera, None, mask),
                        read_models(source, trajectory),
                    )
                    points = withheld_errors(source) if columns else []
                else:
                    sparse_map, sequence = map_and_frames(out, folder, source, format, camera, None, mask, SfmConfig())
                    where = out.folder / name if columns else out.folder
                    models, points = _made_dense(sequence, sparse_map, model, where)
                    poses = trajectory or (source if trajectory_files(source) else None)
                    models = with_trajectories(models, read_trajectories(poses)) if poses else models
                withheld += [{**entry, "sequence": name} for entry in points] if columns else points
                world = read_truth(sequence, truth_mesh, with_surface=any(m.clouds for m in models))
                if columns and columns.fps:
                    world = replace(world, period=1 / columns.fps)
                unit = 1.0 if mm_per_unit is None and in_mm(source) else mm_per_unit
                found[name] = judge_maps(models, world, unit, thresholds_mm, common)
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
