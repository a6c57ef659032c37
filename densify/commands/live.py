"""The verb live: a sequence against the clock."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from densify.agreement import AgreementConfig
from densify.alignment import AlignmentConfig
from densify.bending import BendingConfig
from densify.coverage import CoverageConfig
from densify.coverage import coverage as coverage_of
from densify.dense_map import DenseMap
from densify.fusion.rectify import RectifyConfig
from densify.fusion.volume import FusionConfig
from densify.inputs import fitted_light, map_and_frames
from densify.live.densifier import LIVE_FUSION
from densify.live.play import play, time_spent, timings_picture, write_timings
from densify.pipeline import DensifyConfig
from lightdepth.checkpoint import DEFAULT_CHECKPOINT, load_model
from lightdepth.errors import InputError
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import plain, run_folder
from lightdepth.sfm.reconstruction import SfmConfig


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
