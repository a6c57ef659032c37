"""The verbs of lightdepth: synth, calibrate-light, convert-camera and predict. Thin: arguments in, files out."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from lightdepth import camera_conversion
from lightdepth.calibration import read_camera, read_light, write_camera, write_light
from lightdepth.checkpoint import DEFAULT_CHECKPOINT, load_model
from lightdepth.datasets import open_sequence, write_c3vd, write_endomapper, write_folder
from lightdepth.datasets.sequence import read_mask
from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.light.fit_on_map import fit_on_map
from lightdepth.light.fit_on_truth import fit_on_truth
from lightdepth.light.report import light_page
from lightdepth.maps import read_map, write_multimap
from lightdepth.refine import RefineConfig, RefinedModel
from lightdepth.reporting.figures import colored_distance, png, side_by_side, thumbnail
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import plain, run_folder
from lightdepth.tube import lens as tube_lens
from lightdepth.tube import render_sequence
from lightdepth.tube.scene import TubeConfig, realistic
from lightdepth.tube.slam import SimulatedSlam, SlamConfig, simulate_slam


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


def write_synthetic(frames: Sequence[Frame], export: SimulatedSlam, folder: Path, layout: str = "frames") -> None:
    """The sequence (with truth) at `folder`, the SLAM export in slam/, what only the simulation knows in
    truth/slam.json."""
    if layout == "c3vd":
        write_c3vd(frames, folder / "sequence")
    elif layout == "endomapper":
        write_endomapper(frames, folder / "sequence")
        write_folder(frames, folder / "truth" / "sequence")
    else:
        write_folder(frames, folder)
    write_multimap(export.map, folder / "slam")
    known = {
        str(i): {
            "map_from_world": {"scale": s, "rotation": r.tolist(), "translation": t.tolist()},
            "spurious_point_ids": export.spurious_ids[i].tolist(),
        }
        for i, (s, r, t) in export.map_from_world.items()
    }
    (folder / "truth").mkdir(exist_ok=True)
    (folder / "truth" / "slam.json").write_text(json.dumps(plain(known)) + "\n")


def calibrate_light(
    data: Path,
    output: Path,
    map: Path | None = None,
    format: str | None = None,
    camera: Path | None = None,
    mask: Path | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> None:
    """The light of an endoscope: response and spread, from a sparse map or from frames with known depth.

    Args:
        data: folder of frames
        output: light.json to write, with a report beside it (light.html)
        map: COLMAP model(s) or a multi-map tree; left out, the frames' own true depth is needed
        format: folder, video, c3vd, simcol, hamlyn, scared, endoslam, endomapper; found by looking if left out
        camera: camera.json; left out, the map's own camera, else the folder's
        mask: image, white where tissue shows
        seed: draws the bootstrap
        overwrite: replace files made before
    """
    page_path = output.with_suffix(".html")
    if output.is_dir() or output.suffix == ".html":
        raise InputError(f"-o {output}: expected the name of a file to write, such as light.json")
    made = [path for path in (output, page_path) if path.exists()]
    if made and not overwrite:
        raise InputError(f"{made[0]}: already there; choose another -o, or give --overwrite")
    rng = np.random.default_rng(seed)
    if map is None:
        fit = fit_on_truth(open_sequence(data, format, camera, None, mask), rng)
        what = f"{data}, frames with known depth"
    else:
        sparse_map = read_map(map)
        frames = open_sequence(data, format, camera, None, mask, sparse_map.submaps[0].keyframes[0].camera)
        fit = fit_on_map(frames, sparse_map, camera=frames[0].camera if camera is not None else None, rng=rng)
        what = f"{data}, {sparse_map.source}"
    output.parent.mkdir(parents=True, exist_ok=True)
    partial = output.with_name(f".{output.name}.partial")
    for path, write in ((page_path, light_page(fit, what).write), (output, lambda p: write_light(fit.light, p))):
        write(partial)
        os.replace(partial, path)
    print(f"light: {fit.summary()}\n{output}, {page_path}")


def convert_camera(
    file: Path,
    output: Path,
    model: Literal["PINHOLE", "OPENCV", "OPENCV_FISHEYE", "SCARAMUZZA"] | None = None,
    size: tuple[int, int] | None = None,
    to: Literal["json", "vicalib", "opencv", "colmap", "ocamcalib", "intrinsics", "intrinsics4x4"] | None = None,
    mask: Path | None = None,
    overwrite: bool = False,
) -> None:
    """A calibration file in another format, or as another lens model, and by how many pixels that differs.

    Args:
        file: any calibration that is read: camera.json, vicalib XML, OpenCV YAML, COLMAP, ocamcalib, intrinsics.txt
        output: file to write
        model: lens model to have instead, fitted by least squares; left out, the file's own
        size: width and height of the images; the camera is resized to them (intrinsics.txt holds none and needs them)
        to: format of the output; left out, by its name
        mask: image, white where tissue shows: only these pixels count in the fit
        overwrite: replace a file made before
    """
    if output.exists() and not overwrite:
        raise InputError(f"{output}: already there; choose another -o, or give --overwrite")
    camera = read_camera(file, size)
    if size is not None and size != (camera.width, camera.height):
        if abs(size[0] * camera.height / (size[1] * camera.width) - 1) > 0.01:
            raise InputError(
                f"--size {size[0]} {size[1]}: {file} is for {camera.width}x{camera.height}; expected the same aspect"
            )
        camera = camera.resized(*size)
    said = f"{camera.name}, as it was read"
    if model is not None and model != camera.name:
        counted = read_mask(mask) if mask is not None else None
        if counted is not None and counted.shape != (camera.height, camera.width):
            raise InputError(
                f"{mask}: {counted.shape[1]}x{counted.shape[0]} pixels; expected {camera.width}x{camera.height}"
            )
        found = camera_conversion.convert_camera(camera, model, counted)
        said = (
            f"{model} in place of {camera.name}: residual {found.median_px:.2g} px (median), {found.max_px:.2g} px "
            f"(largest), over the {100 * found.seen_share:.1f} % of the field that it can represent"
        )
        camera = found.camera
    output.parent.mkdir(parents=True, exist_ok=True)
    write_camera(camera, output, to)
    print(f"{said}\n{output}")


def predict(
    data: Path,
    output: Path,
    checkpoint: str = DEFAULT_CHECKPOINT,
    format: str | None = None,
    camera: Path | None = None,
    light: str | None = None,
    mask: Path | None = None,
    refine: int = 0,
    previews: bool = True,
    overwrite: bool = False,
) -> None:
    """Distance, albedo and normals of every frame of a sequence, as one .npz a frame.

    Args:
        data: folder of frames
        output: folder to make
        checkpoint: a path, the name of a bundled one, or decline (the closed form) or constant
        format: folder, video, c3vd, simcol, hamlyn, scared, endoslam, endomapper; found by looking if left out
        camera: calibration file that wins over the folder's
        light: light.json, photometric XML, or gamma=2.2,mu=0, that wins over the folder's
        mask: image, white where tissue shows
        refine: steps in which each image's distance is improved by its own light; 0 for none
        previews: also write a PNG with image and distance for every frame
        overwrite: replace a folder made before
    """
    arguments = {k: v for k, v in locals().items() if k != "overwrite"}
    model = load_model(checkpoint)
    if refine:
        model = RefinedModel(model, RefineConfig(steps=refine))
    frames = open_sequence(data, format, camera, light, mask)
    with run_folder(output, "predict", arguments, overwrite) as run, Progress("Predicting", len(frames)) as bar:
        run.hash_input("data", data)
        if previews:
            (run.folder / "previews").mkdir()
        for i in range(len(frames)):
            try:
                frame = frames[i]
            except InputError as error:
                run.fail(frames.names[i], str(error))
                continue
            prediction = model(frame)
            prediction.save(run.folder / f"{frame.name}.npz")
            if previews:
                colors = colored_distance(prediction.distance, prediction.valid)
                picture = side_by_side([thumbnail(frame.image, 480), thumbnail(colors, 480)])
                (run.folder / "previews" / f"{frame.name}.png").write_bytes(png(picture))
            bar.advance()
        if len(run.record["failures"]) == len(frames):
            raise InputError(f"{data}: no frame could be read; the first: {run.record['failures'][0]['reason']}")
        run.record["checkpoint"] = model.name
