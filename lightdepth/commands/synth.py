"""The verb synth: a synthetic colon and its SLAM export."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

from lightdepth.calibration import read_light
from lightdepth.errors import InputError
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import run_folder
from lightdepth.tube import lens as tube_lens
from lightdepth.tube import render_sequence
from lightdepth.tube.export import write_synthetic
from lightdepth.tube.scene import TubeConfig, realistic
from lightdepth.tube.slam import SlamConfig, simulate_slam


def synth(
    output: Path,
    layout: Literal["frames", "c3vd", "endomapper"] = "frames",
    lens: str = "c3vd",
    frames: int = 40,
    size: tuple[int, int] = (320, 256),
    seed: int = 0,
    travel_mm: float = 30.0,
    spurious: float | None = None,
    light: str | None = None,
    family: Literal["plain", "realistic"] = "plain",
    scene: TubeConfig = TubeConfig(),
    slam: SlamConfig = SlamConfig(),
    device: Literal["auto", "cpu", "cuda"] = "auto",
    overwrite: bool = False,
) -> None:
    """A synthetic colon sequence with exact truth, and a multi-map SLAM export with known wrong points.

    Args:
        output: folder to make
        layout: frames (our own folder), c3vd or endomapper (out1.png, ... and XML; its truth is in truth/sequence)
        lens: pinhole, fisheye or c3vd
        frames: number of frames
        size: width and height of the images, pixels
        seed: draws the colon, its light and the path
        travel_mm: length of the path
        spurious: share of wrong map points; left out, slam.spurious
        light: light.json or gamma=2.2,mu=0 to have instead of a drawn one
        family: plain (the tube, its folds and its light) or realistic (with all that real images have)
        scene: ranges of shape, texture and sensor of plain colons
        slam: quality of the simulated SLAM
        device: to render on: auto (the GPU where there is one and the extra gpu is installed), cpu or cuda
        overwrite: replace a folder made before
    """
    arguments = {k: v for k, v in locals().items() if k != "overwrite"}
    if frames < 1:
        raise InputError(f"--frames {frames}; expected at least 1")
    slam = slam if spurious is None else replace(slam, spurious=spurious)
    if not 0 <= slam.spurious < 1:
        raise InputError(f"--spurious {slam.spurious}; expected a share of at least 0 and below 1")
    if layout == "endomapper" and lens == "c3vd":
        raise InputError("--layout endomapper holds no Scaramuzza lens, as C3VD's is; add --lens fisheye")
    if family == "realistic" and scene != TubeConfig():
        raise InputError("--family realistic has ranges of its own; leave out --scene, or take --family plain")
    scene = realistic() if family == "realistic" else scene
    chosen = read_light(light) if light is not None else None
    with run_folder(output, "synth", arguments, overwrite) as run, Progress("Rendering", frames) as bar:
        sequence = render_sequence(
            seed, frames, tube_lens(lens, *size), travel_mm, scene, chosen, lambda *_: bar.advance(), device=device
        )
        made = sequence.frames
        if layout == "endomapper":  # which counts frames from 1
            made = [replace(frame, name=f"out{frame.number + 1}") for frame in made]
        export = simulate_slam(made, slam, seed)
        write_synthetic(made, export, run.folder, layout)
        run.log(f"{frames} frames, {len(export.map.submaps)} submaps in {output}")
