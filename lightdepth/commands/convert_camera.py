"""The verb convert-camera: a calibration file in another format or lens model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal

from lightdepth import camera_conversion
from lightdepth.calibration import read_camera, write_camera
from lightdepth.command_line.outcome import end, is_quiet, outcome
from lightdepth.datasets.sequence import read_mask
from lightdepth.errors import InputError
from lightdepth.files.replacing import check_files
from lightdepth.ranges import PIXELS, above


def convert_camera(
    file: Path,
    output: Path,
    model: Literal["PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "SCARAMUZZA"] | None = None,
    size: Annotated[tuple[int, int] | None, PIXELS] = None,
    to: Literal["json", "vicalib", "opencv", "colmap", "ocamcalib", "intrinsics", "intrinsics4x4"] | None = None,
    mask: Path | None = None,
    most_px: Annotated[float | None, above(0)] = None,
    overwrite: bool = False,
) -> None:
    """A calibration file in another format, or as another lens model, and by how many pixels that differs.

    Args:
        file: Calibration of any kind that is read: camera.json, vicalib XML, OpenCV's YAML or XML, Kalibr, ORB-SLAM,
            nerfstudio, MATLAB, COLMAP, ocamcalib or intrinsics.txt.
        output: File to write the camera to, in a format that its name tells.
        model: Lens model to convert to, fitted by least squares: PINHOLE (no distortion), OPENCV (k1, k2, p1, p2),
            FULL_OPENCV (with k3 to k6), these three up to 75 degrees from the axis, OPENCV_FISHEYE or SCARAMUZZA; left
            out, the file's own is kept.
        size: Width and height, pixels, of the images that the camera is for, in the same proportion as in the file;
            left out, the file's (intrinsics.txt holds none and needs this option). A larger one makes a camera for
            larger images.
        to: Format of the output: json, vicalib (XML), opencv (YAML), colmap, ocamcalib, or intrinsics.txt as 3 x 3 or 4
            x 4 matrix; left out, the one that the output's name tells.
        mask: Image, white where tissue shows: with --model, only these pixels count in the fit; left out, all do.
        most_px: With --model, the most that the fit may be off anywhere in the image, pixels: a worse one is refused.
            Left out, half a percent of the image's longer side. A larger one lets a worse fit through.
        overwrite: Replace a file made before.
    """
    check_files([output], overwrite, [file, mask])
    if most_px is not None and model is None:
        raise InputError("--most-px", "given without --model", "leave it out: it limits the fit of another lens model")
    camera = read_camera(file, size)
    if size is not None and size != (camera.width, camera.height):
        if abs(size[0] * camera.height / (size[1] * camera.width) - 1) > 0.01:
            raise InputError(
                f"--size {size[0]} {size[1]}",
                f"{file} is for {camera.width}x{camera.height}",
                "expected the same aspect",
            )
        camera = camera.resized(*size)
    said = f"{camera.name}, as it was read"
    if model is not None and model != camera.name:
        counted = read_mask(mask) if mask is not None else None
        if counted is not None and counted.shape != (camera.height, camera.width):
            raise InputError(
                f"{mask}", f"{counted.shape[1]}x{counted.shape[0]} pixels", f"expected {camera.width}x{camera.height}"
            )
        found = camera_conversion.convert_camera(camera, model, counted).close_enough(f"{file}", most_px)
        said = (
            f"{model} in place of {camera.name}: residual {found.median_px:.2g} px (median), {found.max_px:.2g} px "
            f"(largest), over the {100 * found.seen_share:.1f} % of the field that it can represent"
        )
        camera = replace(found.camera, provenance=camera.provenance)
    write_camera(camera, output, to)
    doubt = "" if camera.provenance is None else camera.provenance.doubt
    if not is_quiet():
        print(said)
    if doubt:
        print(f"warning: {doubt}", file=outcome().doubts)
    doubts = [doubt] if doubt else []
    then = f"lightdepth import VIDEO -o DATA --camera {quote(str(output))}"
    end(output, then=then, result={"model": camera.name, "said": said}, doubts=doubts)
