"""The verb evaluate: what is judged, a single sequence or those of a suite, and against what; metrics out."""

from __future__ import annotations

from pathlib import Path
from shlex import quote

from densify.config import DensifyConfig
from densify.evaluation.depth_files import DepthReading
from densify.evaluation.files import check_no_truth_lost, write_evaluations
from densify.evaluation.in_short import in_short
from densify.evaluation.judge import judge_gap
from densify.evaluation.judged_map import read_run
from densify.evaluation.page import evaluation_page
from densify.evaluation.records import Sources
from densify.judged import DenseModel, JudgingConfig, TruthSource, dense_first, judge_asked, read_asked
from lightdepth.command_line.options import Group
from lightdepth.command_line.outcome import end
from lightdepth.reporting.run import recorded, run_folder


def evaluate(
    run: Path,
    source: Group[TruthSource] = TruthSource(),
    output: Path | None = None,
    join: Path | None = None,
    suite: Path | None = None,
    predicting: Group[DenseModel] = DenseModel(),
    trajectory: Path | None = None,
    judging: Group[JudgingConfig] = JudgingConfig(),
    reading: Group[DepthReading] = DepthReading(),
    config: Group[DensifyConfig] = DensifyConfig(),
    fit_light: bool = True,
    overwrite: bool = False,
) -> None:
    """Errors of predictions, a densify run, a map or a trajectory, against truth and between submaps.

    Args:
        run: Folder made by densify or predict, one of its map folders (joined_000), a sparse map, a trajectory (TUM),
            or with --depth-kind any program's folder of depth.
        output: Folder for the metrics; left out, evaluation/ in the run.
        join: JSON file with the Sim(3) that takes one submap to another (first, second, scale, rotation, translation),
            by which the gap between their surfaces is judged.
        suite: YAML file naming the sequences, folders of these names in run and truth, that are judged into one table
            (configs/bench/c3vd.yaml).
        trajectory: TUM file with the pose of every frame that the SLAM localised, judged in place of the keyframes'
            poses.
        fit_light: With --checkpoint, where neither --light nor the truth's folder gives the light, fit it on each map,
            and use it if its depth fits hidden blocks of wall better; switched off, a usual light is assumed.
        overwrite: Replace metrics made before. Without it, evaluation/ in a run is replaced too, unless that would
            replace metrics against truth by metrics without.
    """
    folder = output or run / "evaluation"
    arguments = recorded(
        source,
        predicting,
        judging,
        reading,
        config,
        run=run,
        output=folder,
        join=join,
        suite=suite,
        trajectory=trajectory,
        fit_light=fit_light,
    )
    asked = read_asked(run, source, judging, join, suite, trajectory, output is None, reading)
    first = dense_first(predicting, source, config, fit_light)
    gap = None if join is None else judge_gap(read_run(run), join)
    with run_folder(folder, "evaluate", arguments, overwrite or output is None) as out:
        if source.truth is None and not overwrite:
            check_no_truth_lost(folder)
        out.hash_inputs(truth=source.truth)
        answer = judge_asked(asked, first, out)
        sources = Sources(run, source.truth, gap, "" if first is None else str(first))
        write_evaluations(answer.found, out.folder, answer.withheld, sources, asked.suite)
        failed = [failure["what"] for failure in out.record["failures"]]
        page = evaluation_page(answer.found, out.folder, answer.withheld, sources, asked.suite, failed)
        page.write(out.folder / "report.html")
        out.log(in_short(answer.found, answer.withheld, sources))
    end(folder, then=f"cat {quote(str(folder / 'metrics.md'))}", page=folder / "report.html")
