"""C3VD, its three editions (FORMATS: depth is along the axis, mm = v / 65535 * 100; 16 bits, TIFF).

| tree | colour | depth | camera |
|---|---|---|---|
| first edition | `N_color.png` or `NNNN_color.png` | `NNNN_depth.tiff` | C3VD |
| first edition, sorted into folders | the same in `color/` | the same in `depth/` | C3VD |
| that, undistorted by EndoGSLAM's scripts | the same | 8 bits, no truth | C3VD_UNDISTORTED |
| second and third (C3VDv2, C3VDv3) | `rgb/NNNN.png` | `depth/NNNN_depth.tiff` | C3VD_V2 |

Colour and depth are paired by integer. Depth 0 (no data) and 65535 (clipped at 100 mm) are both unknown. Poses
(`pose.txt`) are camera-to-world [mm], 16 numbers a line, column by column in the present release and row by row in the
oldest: each line shows which. Screenings and deformations have no depth. The lenses are the authors' Scaramuzza models;
the light was never calibrated: EndoMapper's values are assumed (same endoscope). Undistorted images are told by their
corners, which the octagon leaves black and undistorting fills, or by color_raw/ beside color/.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightdepth.camera import CameraModel, Pinhole, Scaramuzza
from lightdepth.datasets.format import DepthCode, Format, checked_images, frames_of, poses_or_why
from lightdepth.datasets.sequence import FrameSequence, corners, numbered_files, spread_images
from lightdepth.errors import InputError
from lightdepth.files.images import image_size, to_bgr8, write_image
from lightdepth.frame import Frame
from lightdepth.option_names import option
from lightdepth.photometry import PhotometricCalibration
from lightdepth.regular import regular
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
C3VD_V2 = Scaramuzza(
    1350,
    1080,
    677.739464094188,
    543.057997844875,
    767.733695862103,
    0.0,
    -5.92506426558248e-4,
    -2.69440266600040e-7,
    -2.16380341010063e-10,
    1.0,
    0.0,
    0.0,
).with_pixel_center(0.0)
"""The camera of C3VD, second and third edition (as the third's tools have it), at full size."""
C3VD_UNDISTORTED = Pinhole(1350, 1080, 802.319, 801.885, 668.286, 547.733).with_pixel_center(0.0)
"""The camera of C3VD, first edition, after EndoGSLAM's scripts have undistorted it, at full size."""
FULL_SCALE_MM = 100.0
_TISSUE = 0.1  # brightness that no black corner reaches
_DEPTH = DepthCode("C3VD", 65535, FULL_SCALE_MM, clipped=65535)


@dataclass(frozen=True)
class _Tree:
    """Where an edition keeps its files, how it names its colour files and which camera took them."""

    colour: str
    depth: str
    suffix: str
    camera: Scaramuzza


_TREES = {
    "v1": _Tree(".", ".", "_color.png", C3VD),
    "v1 sorted": _Tree("color", "depth", "_color.png", C3VD),
    "v2": _Tree("rgb", "depth", ".png", C3VD_V2),
}


def is_c3vd(path: Path) -> bool:
    """Whether a folder has C3VD's colour files; images in rgb/ need C3VD's depth or poses beside them."""
    return _tree(path) is not None


def image_folder(path: Path) -> Path:
    """Where the colour images of a sequence lie."""
    tree = _tree(path)
    return path if tree is None else path / tree.colour


def read_c3vd(
    path: Path,
    camera: CameraModel | None = None,
    light: PhotometricCalibration | None = None,
    mask: np.ndarray | None = None,
    *,
    bit_depth: int | None = None,
) -> FrameSequence:
    """Frames of a C3VD sequence, with distance and pose where the folder has them."""
    tree = _tree(path)
    if tree is None:
        raise InputError(
            path,
            "no *_color.png in it or in color/, and no rgb/NNNN.png beside depth/ or pose.txt",
            "is it a C3VD sequence?",
        )
    colour = _colour(path, tree)
    depth = numbered_files(path / tree.depth, r"(\d+)_depth\.tiff")
    images = [colour[n] for n in sorted(colour)]
    numbers = checked_images(path, images, depth)
    if camera is None:
        width, height = image_size(images[0])
        undistorted = (path / "color_raw").is_dir() or _fills_the_corners(spread_images(images))
        whole = _undistorted_camera(path, tree) if undistorted else tree.camera
        if abs(width / height / (whole.width / whole.height) - 1) > 0.01:
            raise InputError(
                path,
                f"images are {width}x{height}",
                f"C3VD's camera is for {whole.width}x{whole.height} and its reductions. Give the camera of cropped "
                f"images with {option('camera')} FILE",
            )
        camera = whole.resized(width, height)
    ray_z = camera.rays()[0][..., 2]
    names = [f"{n:04d}{tree.suffix.removesuffix('.png')}" for n in numbers]
    return frames_of(
        path,
        images,
        camera,
        light or PhotometricCalibration(),
        mask,
        names=names,
        times=[number / 30.0 for number in numbers],
        poses=poses_or_why(lambda: _poses_of(path, numbers)),
        distance=lambda i: _DEPTH.distance(depth[numbers[i]], ray_z) if numbers[i] in depth else None,
        bit_depth=bit_depth,
        bordered=True,
    )


FORMAT = Format("c3vd", fits=is_c3vd, images=image_folder, has_camera=lambda _: True, read=read_c3vd, word="_color")


def write_c3vd(frames: Sequence[Frame], path: Path, tree: str = "v1") -> None:
    """A C3VD tree ("v1", "v1 sorted" or "v2") from frames with truth (depth beyond 100 mm is clipped, as in the data
    set). The camera is not in the tree: the frames must have been taken with the edition's own."""
    where = _TREES[tree]
    for folder in {where.colour, where.depth}:
        (path / folder).mkdir(parents=True)
    lines = []
    for frame in frames:
        stem = f"{frame.number:04d}"
        write_image(path / where.colour / f"{stem}{where.suffix}", to_bgr8(frame.image))
        if frame.true_distance is not None:
            depth = frame.true_distance * frame.camera.rays()[0][..., 2]
            code = np.floor(65535 * np.clip(depth / FULL_SCALE_MM, 0, 1))
            write_image(path / where.depth / f"{stem}_depth.tiff", code.astype(np.uint16))
        if frame.true_world_from_cam is not None:
            lines.append(",".join(f"{v:.9g}" for v in frame.true_world_from_cam.T.ravel()))
    if lines:
        (path / "pose.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _fills_the_corners(images: Sequence[np.ndarray]) -> bool:
    """Whether tissue shows in the corners of images (H, W, 3), where C3VD's octagon leaves them black."""
    if not images:
        return False  # refused by name when they are asked for
    patch = max(2, len(images[0]) // 40)
    brightest = np.max([image.max(-1) for image in images if image.shape == images[0].shape], axis=0)
    return sum(float(np.median(brightest[rows, columns])) > _TISSUE for rows, columns in corners(patch)) >= 3


def _undistorted_camera(path: Path, tree: _Tree) -> CameraModel:
    """The camera of EndoGSLAM's tree. Raises InputError for images that somebody else undistorted."""
    found = "no black corners, which C3VD's octagon has: the images look undistorted or cropped"
    fx, fy, cx, cy = C3VD_UNDISTORTED.with_pixel_center(1.0).params
    if tree.colour != "color":
        raise InputError(
            path,
            found,
            f"give their camera with {option('camera')} FILE; that of EndoGSLAM's scripts is PINHOLE at 1350x1080, "
            f"fx {fx:g} fy {fy:g} cx {cx:g} cy {cy:g}, pixel_center 0.0",
        )
    warnings.warn(
        f"{path}: {found}; sorted into color/ and depth/, they are taken for EndoGSLAM's, undistorted to a pinhole of "
        f"fx {fx:g} at 1350x1080. Give {option('camera')} FILE where another program undistorted them",
        stacklevel=6,
    )
    return C3VD_UNDISTORTED


def _tree(path: Path) -> _Tree | None:
    """The edition at a path, told by its colour files; None where there is none."""
    beside = (path / "pose.txt").is_file() or any(path.glob("depth/*_depth.tiff"))
    trees = [_TREES["v1"], _TREES["v1 sorted"], *([_TREES["v2"]] if beside else [])]
    return next((tree for tree in trees if _colour(path, tree)), None)


def _colour(path: Path, tree: _Tree) -> dict[int, Path]:
    return numbered_files(path / tree.colour, rf"(\d+){re.escape(tree.suffix)}")


def _poses_of(path: Path, numbers: list[int]) -> np.ndarray | None:
    """(n, 4, 4) world_from_cam [mm] of the frames with these numbers; None where there is no file."""
    if not (path / "pose.txt").is_file():
        return None
    poses = _read_poses(path / "pose.txt")
    if numbers[-1] >= len(poses):
        raise InputError(
            f"{path / 'pose.txt'}",
            f"{len(poses)} poses, but there is a frame {numbers[-1]}",
            "expected a line for each frame, from frame 0",
        )
    return poses[numbers]


def _read_poses(path: Path) -> np.ndarray:
    """(n, 4, 4) world_from_cam [mm], whichever way the lines were flattened."""
    regular(path)
    try:
        rows = np.loadtxt(path, delimiter=",", ndmin=2, encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise InputError(
            path, f"not a C3VD pose file ({error})", "expected 16 numbers a line separated by commas"
        ) from error
    if rows.shape[1] != 16:
        raise InputError(path, f"{rows.shape[1]} numbers a line", "expected 16, a camera-to-world matrix")
    matrices = rows.reshape(-1, 4, 4)
    last = np.array([0, 0, 0, 1.0])
    if np.allclose(matrices[:, 3], last, atol=1e-4):
        poses = matrices
    elif np.allclose(matrices[:, :, 3], last, atol=1e-4):
        poses = matrices.transpose(0, 2, 1)
    else:
        raise InputError(
            path,
            "neither the last row nor the last column of the poses is 0 0 0 1",
            "expected a rotation and a translation a line",
        )
    for i, pose in enumerate(poses):
        check_rigid(pose, f"{path}: line {i + 1}")
    return poses
