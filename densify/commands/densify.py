"""The verb densify: dense surfaces from frames and a sparse map."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from densify.agreement import AgreementConfig
from densify.alignment import AlignmentConfig
from densify.bending import BendingConfig
from densify.contradiction import ContradictionConfig
from densify.coverage import CoverageConfig
from densify.densified import Densified
from densify.evaluation.page import densify_page, joined_section
from densify.fusion.rectify import RectifyConfig
from densify.fusion.volume import FusionConfig
from densify.inputs import fitted_light, map_and_frames
from densify.joining import MergeConfig
from densify.pipeline import DensifyConfig
from lightdepth.checkpoint import DEFAULT_CHECKPOINT, load_model
from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.reporting.run import run_folder
from lightdepth.sfm.reconstruction import SfmConfig


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


def _light(frames: FrameSequence) -> str:
    light = frames[0].light
    return f"gamma {light.gamma:.3g}, mu {light.mu:.3g} ({light.source})"
