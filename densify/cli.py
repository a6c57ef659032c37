"""The verbs of densify: demo, doctor, sparse, densify, live, evaluate, measure. Thin: arguments in, files out."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from densify.agreement import AgreementConfig
from densify.alignment import AlignmentConfig
from densify.bending import BendingConfig
from densify.contradiction import ContradictionConfig
from densify.coverage import CoverageConfig
from densify.coverage import coverage as coverage_of
from densify.dense_map import DenseMap, map_folders
from densify.doctor import examine
from densify.fusion import FusionConfig
from densify.judge import (
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
from densify.measure import chosen_map, measured, places_in_frame, run_unit, summary
from densify.merge import MergeConfig, Merged, joined_name
from densify.merge import merge as merge_maps
from densify.page import Gallery, densify_page, joined_section
from densify.pipeline import DensifyConfig, KeyframeView, SubmapResult, fitted_to_frames
from densify.pipeline import densify as densify_maps
from densify.play import play, time_spent, timings_picture, write_timings
from densify.rectify import RectifyConfig
from densify.sfm import SfmConfig, sparse_map_from_frames
from densify.suite import Suite, present, read_suite
from densify.tables import write_evaluations
from densify.trajectory import read_trajectories, trajectory_files
from densify.unmapped import summary as unmapped_summary
from lightdepth.checkpoint import DEFAULT_CHECKPOINT, load_model
from lightdepth.commands import write_synthetic
from lightdepth.datasets import FrameSequence, open_sequence
from lightdepth.datasets.folder import read_tum
from lightdepth.errors import InputError
from lightdepth.light_fit import fit_on_map, with_light
from lightdepth.maps import read_map
from lightdepth.maps.checks import check_shared_frames
from lightdepth.photometry import PhotometricCalibration
from lightdepth.predict import DepthModel
from lightdepth.progress import Progress
from lightdepth.report import number
from lightdepth.run import Run, plain, run_folder
from lightdepth.sparse_map import SparseMap
from lightdepth.tube import lens as tube_lens
from lightdepth.tube import render_sequence
from lightdepth.tube.slam import SlamConfig, simulate_slam


def densify(
    data: Path,
    output: Path,
    map: Path | None = None,
    checkpoint: str = DEFAULT_CHECKPOINT,
    format: str | None = None,
    camera: Path | None = None,
    light: str | None = None,
    mask: Path | None = None,
    withhold: float = 0.2,
    seed: int = 0,
    recipe: Literal["full", "paper"] = "full",
    alignment: AlignmentConfig = AlignmentConfig(),
    agreement: AgreementConfig = AgreementConfig(),
    bending: BendingConfig = BendingConfig(),
    contradiction: ContradictionConfig = ContradictionConfig(),
    rectify: RectifyConfig = RectifyConfig(),
    fusion: FusionConfig = FusionConfig(),
    coverage: CoverageConfig = CoverageConfig(),
    sfm: SfmConfig = SfmConfig(),
    formats: tuple[str, ...] = ("ply",),
    mm_per_unit: float | None = None,
    fit_light: bool = True,
    merge: bool = True,
    merging: MergeConfig = MergeConfig(),
    overwrite: bool = False,
) -> None:
    """Dense surfaces from frames and a sparse map, one per submap, and one more for submaps that meet.

    Args:
        data: folder of frames
        output: run folder to make
        map: COLMAP model(s) or a multi-map tree; left out, pycolmap makes one from the frames
        checkpoint: a path, the name of a bundled one, or decline (the closed form) or constant
        format: folder, video, c3vd, simcol, hamlyn, scared, endoslam, endomapper; found by looking if left out
        camera: calibration file; left out, the map's own camera, else the folder's
        light: light.json, photometric XML, or gamma=2.2,mu=0
        mask: image, white where tissue shows
        withhold: share of each keyframe's observed points kept out of the alignment, to judge the surface by
        seed: draws the withheld points
        recipe: full, or paper: one LMedS scale per keyframe, one undistorted pinhole image, plain TSDF
        alignment: when a keyframe's scale is found and trusted
        agreement: how the keyframes of a submap are aligned together (full; --agreement.overlap 0 switches overlap off)
        bending: how depth may bend (full; --bending.on false switches it off)
        contradiction: pixels that nearer keyframes contradict (full; --contradiction.on false keeps them)
        rectify: which predicted pixels are fused, and how finely
        fusion: resolution and reach of the surface
        coverage: when wall counts as seen well
        sfm: how frames are mapped when there is no map
        formats: of the mesh: ply, glb, obj
        mm_per_unit: millimetres per map unit, where known; lengths are then written in mm
        fit_light: where nobody gave the light, fit it on the map and use it if withheld keyframes agree
        merge: join submaps that see the same tissue, and give each group one surface besides the single ones
        merging: when two submaps are one
        overwrite: replace a run made before
    """
    arguments = {k: v for k, v in locals().items() if k != "overwrite"}
    unknown = set(formats) - {"ply", "glb", "obj"}
    if unknown or "ply" not in formats:
        raise InputError(f"--formats {list(formats)}; expected ply, and besides it glb and obj if wanted")
    if mm_per_unit is not None and not mm_per_unit > 0:
        raise InputError(f"--mm-per-unit {mm_per_unit}; expected a positive number of millimetres")
    config = DensifyConfig(
        alignment, rectify, fusion, withhold, seed, recipe, agreement, bending, contradiction, coverage
    )
    model = load_model(checkpoint, details=False)  # before minutes are spent on a sparse map
    with run_folder(output, "densify", arguments, overwrite) as run:
        sparse_map, frames = _map_and_frames(run, data, map, format, camera, light, mask, sfm)
        for name, path in (("data", data), ("map", map), ("camera", camera), ("mask", mask)):
            run.hash_input(name, path)
        if fit_light and light is None and checkpoint != "constant":
            frames = _fitted_light(run, frames, sparse_map, model)
        work = Densified.make(frames, sparse_map, model, config, merging if merge else None)
        work.write(run, formats, mm_per_unit)
        notes = [f"{data}, {sparse_map.source}; depth by {work.model}; light of the frames: {_light(frames)}."]
        notes += [f"Light {run.record['light_fit']['summary']}."] if "light_fit" in run.record else []
        weak = [str(s.id) for s in sparse_map.submaps if s.weak_visibility]
        if weak:
            notes.append(
                f"Map {', '.join(weak)} came without observations: which points a keyframe saw was guessed by "
                "projection, so scales and inliers rest on weaker ground."
            )
        page = densify_page("Densified maps", work.results, work.baselines, work.gallery, notes, None, mm_per_unit)
        if work.merged is not None:
            joined_section(page, work.merged)
        page.write(run.folder / "report.html")
        run.log(f"{output}/report.html")


def live(
    data: Path,
    output: Path,
    map: Path | None = None,
    checkpoint: str = DEFAULT_CHECKPOINT,
    rate: float | None = None,
    budget_ms: float = 200.0,
    format: str | None = None,
    camera: Path | None = None,
    light: str | None = None,
    mask: Path | None = None,
    alignment: AlignmentConfig = AlignmentConfig(),
    agreement: AgreementConfig = AgreementConfig(),
    bending: BendingConfig = BendingConfig(),
    rectify: RectifyConfig = RectifyConfig(),
    fusion: FusionConfig = FusionConfig(),
    coverage: CoverageConfig = CoverageConfig(),
    sfm: SfmConfig = SfmConfig(),
    mm_per_unit: float | None = None,
    fit_light: bool = True,
    overwrite: bool = False,
) -> None:
    """Plays a sequence against the clock: surfaces that grow keyframe by keyframe, and where their time goes.

    Args:
        data: folder of frames
        output: run folder to make
        map: COLMAP model(s) or a multi-map tree; left out, pycolmap makes one from the frames, before the clock starts
        checkpoint: a path, the name of a bundled one, or decline (the closed form) or constant
        rate: keyframes per second that come whether or not the last is done; left out, each comes when the last is done
        budget_ms: milliseconds that a keyframe may take, from its image to the renewed surface
        format: folder, video, c3vd, simcol, hamlyn, scared, endoslam, endomapper; found by looking if left out
        camera: calibration file; left out, the map's own camera, else the folder's
        light: light.json, photometric XML, or gamma=2.2,mu=0
        mask: image, white where tissue shows
        alignment: when a keyframe's scale is found and trusted
        agreement: how a keyframe is aligned with its own points beyond its scale (live, keyframes do not overlap)
        bending: how depth may bend
        rectify: which predicted pixels are fused, and how finely
        fusion: resolution and reach of the surface
        coverage: when wall counts as seen well
        sfm: how frames are mapped when there is no map
        mm_per_unit: millimetres per map unit, where known; lengths are then written in mm
        fit_light: where nobody gave the light, fit it on the map before the clock starts
        overwrite: replace a run made before
    """
    arguments = {k: v for k, v in locals().items() if k != "overwrite"}
    if mm_per_unit is not None and not mm_per_unit > 0:
        raise InputError(f"--mm-per-unit {mm_per_unit}; expected a positive number of millimetres")
    if not budget_ms > 0:
        raise InputError(f"--budget-ms {budget_ms}; expected milliseconds above 0")
    if rate is not None and not rate > 0:
        raise InputError(f"--rate {rate}; expected keyframes per second, above 0")
    config = DensifyConfig(alignment, rectify, fusion, withhold=0.0, agreement=agreement, bending=bending)
    model = load_model(checkpoint, details=False)
    with run_folder(output, "live", arguments, overwrite) as run:
        sparse_map, frames = _map_and_frames(run, data, map, format, camera, light, mask, sfm)
        for name, path in (("data", data), ("map", map), ("camera", camera), ("mask", mask)):
            run.hash_input(name, path)
        if fit_light and light is None and checkpoint != "constant":
            frames = _fitted_light(run, frames, sparse_map, model)
        records: list[dict[str, Any]] = []

        def finished(dense: DenseMap) -> None:
            made = {"map": dense.submap.id, "keyframes": len(dense.alignments), "aligned": len(dense.aligned)}
            records.append({**made, "vertices": len(dense.vertices), "voxel": dense.voxel})
            name = f"map_{dense.submap.id:03d}"
            if not len(dense.triangles):
                run.fail(name, next((a.reason for a in dense.alignments if a.reason), "nothing was fused"))
                return
            records[-1]["coverage"] = coverage_of(dense, coverage).scaled(mm_per_unit or 1.0).record()
            replace(dense, unit="mm" if mm_per_unit else dense.unit).write(run.folder / name, ("ply",), mm_per_unit)

        with Progress("Playing", sum(len(s.keyframes) for s in sparse_map.submaps)) as bar:
            played = play(frames, sparse_map, model, config, finished, rate, lambda _: bar.advance())
        for p in played:
            if p.unread:
                run.fail(f"map_{p.map:03d}, keyframe {p.keyframe}", p.reason)
        if not any(record["vertices"] for record in records):
            reasons = [f"{p.keyframe}: {p.reason}" for p in played if p.reason]
            raise InputError(f"no keyframe of any map could be aligned; {'; '.join(reasons[:3])}")
        write_timings(played, run.folder / "timings.csv")
        (run.folder / "timings.png").write_bytes(timings_picture(played, budget_ms / 1000))
        timings = time_spent(played, budget_ms / 1000)
        unit = "mm" if mm_per_unit else "map units"
        run.record.update(plain({"unit": unit, "checkpoint": model.name, "maps": records, "timings": timings}))
        run.log(
            f"{timings['share_in_budget']:.0%} of {timings['read']} keyframes within {budget_ms:g} ms; median ms: "
            + ", ".join(f"{step} {figures['median_ms']:.1f}" for step, figures in timings["steps"].items())
            + f"; without the network {timings['without_network']['median_ms']:.1f}"
        )
        if rate is not None:
            run.log(
                f"at {rate:g} keyframes per second, {timings['share_in_time']:.0%} were on the surface in that time"
            )


def sparse(
    data: Path,
    output: Path,
    format: str | None = None,
    camera: Path | None = None,
    mask: Path | None = None,
    poses: str | None = None,
    sfm: SfmConfig = SfmConfig(),
    overwrite: bool = False,
) -> None:
    """A sparse map by pycolmap, where there is no SLAM output.

    Args:
        data: folder of frames
        output: folder to make, with one COLMAP model per submap
        format: folder, video, c3vd, simcol, hamlyn, scared, endoslam, endomapper; found by looking if left out
        camera: calibration file that wins over the folder's
        mask: image, white where tissue shows
        poses: where poses are known and points are only triangulated: truth, those of the sequence, or a TUM file
            (world from camera) whose times are frame numbers
        sfm: how frames are mapped
        overwrite: replace a folder made before
    """
    arguments = {k: v for k, v in locals().items() if k != "overwrite"}
    with run_folder(output, "sparse", arguments, overwrite) as run:
        run.hash_input("data", data)
        frames = open_sequence(data, format, camera, None, mask)
        _sparse(run, frames, sfm, None if poses is None else _poses(poses, frames))


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
                    sparse_map, sequence = _map_and_frames(out, folder, source, format, camera, None, mask, SfmConfig())
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


def measure(
    run: Path,
    points: list[tuple[float, float, float]] | None = None,
    frame: int | None = None,
    pixels: list[tuple[float, float]] | None = None,
    radius: float | None = None,
    map: int | None = None,
    mm_per_unit: float | None = None,
    output: Path | None = None,
) -> None:
    """Lengths and areas on a surface of a densify run: between two places, around one, inside an outline of more.

    Args:
        run: folder made by densify
        points: places on the surface, [[x, y, z], ...], in its unit
        frame: number of the keyframe that pixels are given in
        pixels: places as pixels of that keyframe, [[u, v], ...], first centre at (0.5, 0.5), instead of points
        radius: with one place, of the disc of wall around it
        map: number of the map; needed where the run has several
        mm_per_unit: millimetres per unit of the surface, where the run did not know it
        output: JSON file to write besides
    """
    dense = chosen_map(read_run(run), map, run)
    unit = run_unit(run, mm_per_unit)
    if (points is None) == (pixels is None) or (pixels is None) != (frame is None):
        raise InputError("give the places either by --points, or by --frame and --pixels")
    if points is not None:
        places = np.asarray(points, float).reshape(-1, 3)
    else:
        assert frame is not None and pixels is not None
        places = places_in_frame(dense, frame, np.asarray(pixels, float).reshape(-1, 2))
    found = measured(dense, places, radius, mm_per_unit or 1.0)
    result = {"run": str(run), "map": dense.id, "unit": unit, **found}
    print(summary(found, unit))
    if output is not None:
        partial = output.with_name(f"{output.name}.partial")
        partial.write_text(json.dumps(plain(result), indent=1) + "\n")
        os.replace(partial, output)


def demo(
    output: Path = Path("runs/demo"),
    checkpoint: str = DEFAULT_CHECKPOINT,
    frames: int = 40,
    seed: int = 7,
    size: tuple[int, int] = (320, 256),
    lens: str = "c3vd",
    spurious: float = 0.3,
    withhold: float = 0.2,
    overwrite: bool = False,
) -> None:
    """The whole way on a synthetic colon: render, sparse map, densify, evaluate; ends at report.html.

    Args:
        output: run folder to make
        checkpoint: a path, the name of a bundled one, or decline (the closed form) or constant
        frames: number of frames to render
        seed: draws the colon; no bundled checkpoint was trained on seeds below 1000
        size: width and height of the images, pixels
        lens: pinhole, fisheye or c3vd
        spurious: share of wrong map points
        withhold: share of each keyframe's observed points kept out of the alignment
        overwrite: replace a run made before
    """
    arguments = {k: v for k, v in locals().items() if k != "overwrite"}
    model = load_model(checkpoint, details=False)
    with run_folder(output, "demo", arguments, overwrite) as run:
        with Progress("Rendering", frames) as bar:
            sequence = render_sequence(
                seed, frames, tube_lens(lens, *size), 0.7 * frames, progress=lambda *_: bar.advance()
            )
        slam = simulate_slam(sequence.frames, SlamConfig(spurious=spurious), seed)
        write_synthetic(sequence.frames, slam, run.folder / "data")
        data = open_sequence(run.folder / "data")
        sparse_map = read_map(run.folder / "data" / "slam")
        work = Densified.make(data, sparse_map, model, DensifyConfig(withhold=withhold, seed=seed))
        work.write(run, ("ply",), None)
        evaluation = judge_maps(dense_models(read_run(run.folder)), read_truth(data))
        run.log(write_evaluations({"demo": evaluation}, run.folder))
        run.record["evaluation"] = evaluation.result["maps"]
        notes = [
            f"A synthetic colon (seed {seed}), {frames} frames, a simulated SLAM export of {len(sparse_map.submaps)} "
            f"submaps with {spurious:.0%} wrong points; depth by {work.model}. Truth is exact, so errors are errors.",
        ]
        page = densify_page(
            "Demo: from frames to a dense surface", work.results, work.baselines, work.gallery, notes, evaluation.result
        )
        page.write(run.folder / "report.html")
        run.log(f"{output}/report.html")


def doctor() -> int:
    """Versions, device and a fused-plane self-test; what is missing and how to get it."""
    findings = examine()
    for finding in findings:
        print(f"{'ok  ' if finding.ok else 'FAIL'}  {finding.what:<24} {finding.detail}")
    return 0 if all(f.ok for f in findings) else 4


@dataclass
class Densified:
    """The densify step as verbs use it: results, the same with a constant distance, pictures taken on the way."""

    model: str
    results: Sequence[SubmapResult]
    baselines: Sequence[SubmapResult]
    gallery: Gallery
    merged: Merged | None = None
    extra: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def make(
        cls,
        frames: FrameSequence,
        sparse_map: SparseMap,
        model: DepthModel,
        config: DensifyConfig,
        merging: MergeConfig | None = None,
    ) -> Densified:
        gallery = Gallery(sparse_map)
        count = sum(len(s.keyframes) for s in sparse_map.submaps)
        with Progress("Densifying", count) as bar:

            def show(view: KeyframeView) -> None:
                gallery(view)
                bar.advance()

            results = densify_maps(frames, sparse_map, model, config, show)
        baselines: Sequence[SubmapResult] = []
        if config.withhold:
            with Progress("Constant distance, for comparison", count) as bar:
                # At one scale per keyframe: bent to the points of the map, a constant would be the map's merit.
                rigid = replace(config, agreement=replace(config.agreement, on=False))
                baselines = densify_maps(frames, sparse_map, load_model("constant"), rigid, lambda _: bar.advance())
        merged = None
        if merging is not None and len(results) > 1:
            with Progress("Joining submaps", count) as bar:
                merged = merge_maps(results, frames, model, config, merging, lambda _: bar.advance())
        return cls(model.name, results, baselines, gallery, merged)

    def write(self, run: Run, formats: tuple[str, ...], mm_per_unit: float | None) -> None:
        """Every surface's folder, its figures in run.json and a line for the user. Raises InputError when none was
        made."""
        made = [r for r in self.results if len(r.dense.triangles)]
        if not made:
            reasons = [f"{a.keyframe}: {a.reason}" for r in self.results for a in r.dense.alignments if not a.ok]
            raise InputError(f"no keyframe of any map could be aligned; {'; '.join(reasons[:3])}")
        constant = {b.dense.submap.id: b for b in self.baselines}
        records = []
        for result in self.results:
            dense, withheld = result.dense, result.withheld
            name = f"map_{dense.submap.id:03d}"
            baseline = constant.get(dense.submap.id)
            records.append(
                {
                    "map": dense.submap.id,
                    "keyframes": len(dense.alignments),
                    "aligned": len(dense.aligned),
                    "vertices": len(dense.vertices),
                    "voxel": dense.voxel,
                    "seen_share": result.seen_share,
                    "coverage": result.coverage and result.coverage.scaled(mm_per_unit or 1.0).record(),
                    "withheld": withheld and asdict(withheld),
                    "withheld_constant": baseline and baseline.withheld and asdict(baseline.withheld),
                    "seconds": result.seconds,
                }
            )
            for keyframe, reason in result.unread.items():
                run.fail(f"{name}, keyframe {keyframe}", reason)
            if not len(dense.triangles):
                run.fail(name, next((a.reason for a in dense.alignments if a.reason), "nothing was fused"))
                continue
            replace(dense, unit="mm" if mm_per_unit else dense.unit).write(run.folder / name, formats, mm_per_unit)
            text = f"{name}: {len(dense.aligned)} of {len(dense.alignments)} keyframes aligned, "
            text += f"{len(dense.vertices)} vertices"
            if withheld is not None:
                text += f"; withheld points {_share(withheld.median)} from the surface"
                if baseline is not None and baseline.withheld is not None:
                    text += f" (constant distance {_share(baseline.withheld.median)})"
            if result.coverage is not None:
                text += f"; {result.coverage.well_share:.0%} of the wall seen well, {len(result.coverage.holes)} holes"
            run.log(f"{text}; {result.seen_share:.0%} of the pixels see it")
        if self.merged is not None:
            self._write_joined(run, self.merged, formats, mm_per_unit)
        run.record.update(
            {"unit": "mm" if mm_per_unit else "map units", "checkpoint": self.model, "maps": plain(records)}
        )

    def _write_joined(self, run: Run, merged: Merged, formats: tuple[str, ...], mm_per_unit: float | None) -> None:
        run.record["merge"] = plain(merged.record(mm_per_unit or 1.0))
        for result, group in zip(merged.results, merged.groups, strict=True):
            dense, name = result.dense, joined_name(result)
            if not len(dense.triangles):
                run.fail(name, next((a.reason for a in dense.alignments if a.reason), "nothing was fused"))
                continue
            replace(dense, unit="mm" if mm_per_unit else dense.unit).write(run.folder / name, formats, mm_per_unit)
            maps = ", ".join(map(str, sorted(group)))
            text = f"{name}: maps {maps} in one, in the unit of map {next(iter(group))}, "
            run.log(f"{text}{len(dense.aligned)} of {len(dense.alignments)} keyframes aligned")
        for map_id, reason in merged.meeting.alone().items():
            run.log(f"map {map_id} joins no other: {reason}")


def _map_and_frames(
    run: Run,
    data: Path,
    map: Path | None,
    format: str | None,
    camera: Path | None,
    light: str | None,
    mask: Path | None,
    sfm: SfmConfig,
) -> tuple[SparseMap, FrameSequence]:
    if map is None:
        frames = open_sequence(data, format, camera, light, mask)
        return _sparse(run, frames, sfm), frames
    sparse_map = read_map(map)
    map_camera = sparse_map.submaps[0].keyframes[0].camera
    frames = open_sequence(data, format, camera, light, mask, map_camera)
    check_shared_frames(sparse_map, frames)
    width, height = frames.image_size()
    given = frames[0].camera if camera is not None else None
    if (map_camera.width, map_camera.height) != (width, height):
        run.log(f"map made at {map_camera.width}x{map_camera.height}, rescaled to the frames' {width}x{height}")
    return fitted_to_frames(sparse_map, width, height, given), frames


def _sparse(
    run: Run, frames: FrameSequence, config: SfmConfig, poses: Mapping[int, np.ndarray] | None = None
) -> SparseMap:
    stages: list[str] = []

    def show(stage: str, done: int, count: int) -> None:
        if stage not in stages:
            stages.append(stage)
            run.log(f"sparse map: {stage}")

    found = sparse_map_from_frames(frames, run.folder / "sparse", config, show, poses)
    for submap in found.submaps:
        errors = number(float(np.median(submap.reprojection_errors())))
        run.log(f"sparse map {submap.id}: {len(submap.keyframes)} keyframes, {len(submap.points)} points, {errors} px")
    if found.failed:
        reasons = unmapped_summary(list(found.failed.values()))
        run.log(f"{len(found.failed)} of {len(frames)} frames found no place: {reasons}")
        for name, reason in found.failed.items():
            run.log(f"  {name}: {reason}")
    run.record["unregistered"] = found.failed
    return found


def _poses(given: str, frames: FrameSequence) -> dict[int, np.ndarray]:
    """Known poses (4, 4) by frame number."""
    if given == "truth":
        found = ((f.number, f.true_world_from_cam) for f in frames)
        known = {number: pose for number, pose in found if pose is not None}
        if not known:
            raise InputError(f"{frames.source}: no frame has a pose; give --poses FILE, a TUM trajectory")
        return known
    times, poses = read_tum(Path(given))
    return dict(zip(times.round().astype(int).tolist(), poses, strict=True))


def _fitted_light(run: Run, frames: FrameSequence, sparse_map: SparseMap, model: DepthModel) -> FrameSequence:
    """The frames under the light that the map tells, where theirs is only assumed and the model does better with it."""
    if frames[0].light != PhotometricCalibration():
        return frames
    start = time.perf_counter()
    try:
        fit = fit_on_map(frames, sparse_map, model)
    except InputError as error:
        run.log(f"light assumed, not fitted: {error}")
        return frames
    run.record["light_fit"] = plain(
        {
            "summary": f"fitted on the map: {fit.summary()}",
            "fitted": fit.fitted,
            "uncertainty": fit.uncertainty,
            "errors": fit.errors,
            "used": fit.better,
            "seconds": round(time.perf_counter() - start, 3),
        }
    )
    run.log(f"light {run.record['light_fit']['summary']}")
    return with_light(frames, fit.light) if fit.better else frames


def _share(value: float) -> str:
    return f"{value:.1%}" if value < float("inf") else "infinitely far"


def _light(frames: FrameSequence) -> str:
    light = frames[0].light
    return f"gamma {light.gamma:.3g}, mu {light.mu:.3g} ({light.source})"
