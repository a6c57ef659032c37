"""The thin verbs of densify, arguments in, files out: demo, doctor, sparse, densify, live, measure."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from densify.agreement import AgreementConfig
from densify.alignment import AlignmentConfig
from densify.bending import BendingConfig
from densify.contradiction import ContradictionConfig
from densify.coverage import CoverageConfig
from densify.coverage import coverage as coverage_of
from densify.dense_map import DenseMap
from densify.densified import Densified
from densify.doctor import examine
from densify.evaluation.judge import dense_models, judge_maps, read_run, read_truth
from densify.evaluation.page import densify_page, joined_section
from densify.evaluation.tables import write_evaluations
from densify.fusion.rectify import RectifyConfig
from densify.fusion.volume import FusionConfig
from densify.inputs import fitted_light, made_sparse, map_and_frames
from densify.joining import MergeConfig
from densify.live.densifier import LIVE_FUSION
from densify.live.play import play, time_spent, timings_picture, write_timings
from densify.measure import chosen_map, measured, places_in_frame, run_unit, summary
from densify.pipeline import DensifyConfig
from lightdepth.checkpoint import DEFAULT_CHECKPOINT, load_model
from lightdepth.commands import write_synthetic
from lightdepth.datasets import FrameSequence, open_sequence
from lightdepth.errors import InputError
from lightdepth.files.tum import read_tum
from lightdepth.maps import read_map
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import plain, run_folder
from lightdepth.sfm.reconstruction import SfmConfig
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
        sparse_map, frames = map_and_frames(run, data, map, format, camera, light, mask, sfm)
        for name, path in (("data", data), ("map", map), ("camera", camera), ("mask", mask)):
            run.hash_input(name, path)
        if fit_light and light is None and checkpoint != "constant":
            frames = fitted_light(run, frames, sparse_map, model)
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
    fusion: FusionConfig = LIVE_FUSION,
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
        sparse_map, frames = map_and_frames(run, data, map, format, camera, light, mask, sfm)
        for name, path in (("data", data), ("map", map), ("camera", camera), ("mask", mask)):
            run.hash_input(name, path)
        if fit_light and light is None and checkpoint != "constant":
            frames = fitted_light(run, frames, sparse_map, model)
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
        made_sparse(run, frames, sfm, None if poses is None else _poses(poses, frames))


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


def _light(frames: FrameSequence) -> str:
    light = frames[0].light
    return f"gamma {light.gamma:.3g}, mu {light.mu:.3g} ({light.source})"
