"""C3VD, first edition: N_color.png, NNNN_depth.tiff, pose.txt (FORMATS: depth is along the axis, mm = v / 65535 * 100).

Colour files are numbered `0_color.png` or `0000_color.png`, depth always `0000_depth.tiff`: they are paired by integer.
Depth 0 (no data) and 65535 (clipped at 100 mm) are both unknown. Poses are camera-to-world [mm], 16 numbers a line,
column by column in the present release and row by row in the oldest: each line shows which. Screenings have no depth.
The lens is the authors' Scaramuzza model; the light was never calibrated, EndoMapper's values are used (same
endoscope).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from lightdepth.camera import CameraModel, Scaramuzza
from lightdepth.datasets.folder import to_bgr8
from lightdepth.datasets.sequence import FrameSequence, border_mask, read_image, read_raw
from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.photometry import PhotometricCalibration
from lightdepth.sparse_map import check_rigid

C3VD = Scaramuzza(
    1350,
    1080,
    678.544839263292,
    542.975887548343,
    769.243600037458,
    0.0,
    -8.12770624150226e-4,
    6.25674244578925e-7,
    -1.19662182144280e-9,
    0.999986882249990,
    0.00288273829525059,
    -0.00296316513429569,
).with_pixel_center(0.0)
"""The camera of C3VD, first edition (as its authors' loader has it), at full size."""
FULL_SCALE_MM = 100.0
LIGHT = PhotometricCalibration(gamma=2.2, mu=2.767, source="published")


def is_c3vd(path: Path) -> bool:
    """Whether a folder has C3VD's colour files."""
    return any(path.glob("*_color.png"))


def read_c3vd(
    path: Path,
    camera: CameraModel | None = None,
    light: PhotometricCalibration | None = None,
    mask: np.ndarray | None = None,
) -> FrameSequence:
    """Frames of a C3VD sequence, with distance and pose where the folder has them."""
    colour = _numbered(path, "color.png")
    depth = _numbered(path, "depth.tiff")
    numbers = sorted(colour)
    if not numbers:
        raise InputError(f"{path}: no *_color.png in it; is it a C3VD sequence?")
    poses = _read_poses(path / "pose.txt") if (path / "pose.txt").is_file() else None
    if poses is not None and numbers[-1] >= len(poses):
        raise InputError(f"{path / 'pose.txt'}: {len(poses)} poses, but there is a frame {numbers[-1]}")
    if camera is None:
        height, width = read_image(colour[numbers[0]]).shape[:2]
        if abs(width / height / (C3VD.width / C3VD.height) - 1) > 0.01:
            raise InputError(
                f"{path}: images are {width}x{height}; C3VD's camera is for {C3VD.width}x{C3VD.height} and its "
                "reductions. Give the camera of cropped images with --camera FILE"
            )
        camera = C3VD.resized(width, height)
    if mask is None:
        chosen = numbers[:: max(1, len(numbers) // 8)][:8]
        mask = border_mask([read_image(colour[n]) for n in chosen])
    ray_z = camera.rays()[0][..., 2]

    def load(i: int) -> Frame:
        number = numbers[i]
        distance = None
        if number in depth:
            distance = _distance(read_raw(depth[number]), ray_z, depth[number])
        return Frame(
            f"{number:04d}_color",
            read_image(colour[number]),
            camera,
            light or LIGHT,
            mask,
            time=number / 30.0,
            true_distance=distance,
            true_world_from_cam=None if poses is None else poses[number],
        )

    return FrameSequence([f"{n:04d}_color" for n in numbers], load, str(path))


def write_c3vd(frames: Sequence[Frame], path: Path) -> None:
    """A C3VD tree from frames with truth (depth beyond 100 mm is clipped, as in the data set)."""
    path.mkdir(parents=True)
    lines = []
    for frame in frames:
        stem = f"{frame.number:04d}"
        cv2.imwrite(str(path / f"{stem}_color.png"), to_bgr8(frame.image))
        if frame.true_distance is not None:
            depth = frame.true_distance * frame.camera.rays()[0][..., 2]
            code = np.floor(65535 * np.clip(depth / FULL_SCALE_MM, 0, 1))
            cv2.imwrite(str(path / f"{stem}_depth.tiff"), code.astype(np.uint16))
        if frame.true_world_from_cam is not None:
            lines.append(",".join(f"{v:.9g}" for v in frame.true_world_from_cam.T.ravel()))
    if lines:
        (path / "pose.txt").write_text("\n".join(lines) + "\n")


def _numbered(path: Path, suffix: str) -> dict[int, Path]:
    found: dict[int, Path] = {}
    for file in sorted(path.glob(f"*_{suffix}")):
        match = re.fullmatch(rf"(\d+)_{re.escape(suffix)}", file.name)
        if match:
            number = int(match[1])
            if number in found:
                raise InputError(f"{path}: {found[number].name} and {file.name} have the same number")
            found[number] = file
    return found


def _distance(code: np.ndarray, ray_z: np.ndarray, path: Path) -> np.ndarray:
    if code.dtype != np.uint16 or code.ndim != 2:
        raise InputError(f"{path}: {code.dtype} of shape {code.shape}; C3VD's depth is one channel of 16 bits")
    if code.shape != ray_z.shape:
        raise InputError(
            f"{path}: depth is {code.shape[1]}x{code.shape[0]}, the image {ray_z.shape[1]}x{ray_z.shape[0]}"
        )
    known = (code > 0) & (code < 65535) & (ray_z > 0.05)
    depth = code.astype(np.float32) / 65535 * FULL_SCALE_MM
    return np.where(known, depth / np.where(known, ray_z, 1), 0).astype(np.float32)


def _read_poses(path: Path) -> np.ndarray:
    """(n, 4, 4) world_from_cam [mm], whichever way the lines were flattened."""
    try:
        rows = np.loadtxt(path, delimiter=",", ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a C3VD pose file, 16 numbers a line separated by commas ({error})") from error
    if rows.shape[1] != 16:
        raise InputError(f"{path}: {rows.shape[1]} numbers a line; expected 16")
    matrices = rows.reshape(-1, 4, 4)
    last = np.array([0, 0, 0, 1.0])
    if np.allclose(matrices[:, 3], last, atol=1e-4):
        poses = matrices
    elif np.allclose(matrices[:, :, 3], last, atol=1e-4):
        poses = matrices.transpose(0, 2, 1)
    else:
        raise InputError(f"{path}: neither the last row nor the last column of the poses is 0 0 0 1")
    for i, pose in enumerate(poses):
        check_rigid(pose, f"{path}: line {i + 1}")
    return poses
