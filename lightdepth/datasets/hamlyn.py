"""Hamlyn, rectified (Endo-Depth-and-Motion): abdominal endoscopy, a pinhole, uint16 depth [mm] along the axis.

| tree | colour | depth | what the depth is |
|---|---|---|---|
| rectified | `image01/N.jpg` | `depth01/N.png` | stereo matching: taken as the truth, 0 where it found nothing |
| tracking | `color/N.jpg` | `depth/N.png` | what a network predicted: no truth, left alone |

Colour and depth are paired by integer. `intrinsics.txt` (3x3 or 4x4) lies beside the folders. Rectification leaves a
black border: it is masked. There are no poses, and the light is not known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightdepth.calibration import read_camera
from lightdepth.camera import CameraModel, Pinhole
from lightdepth.counting import with_article
from lightdepth.datasets.format import DepthCode, Format, checked_images, frames_of
from lightdepth.datasets.sequence import FrameSequence, numbered_files
from lightdepth.errors import InputError
from lightdepth.files.images import image_size, to_bgr8, write_image
from lightdepth.frame import Frame
from lightdepth.option_names import option
from lightdepth.photometry import PhotometricCalibration


@dataclass(frozen=True)
class _Tree:
    colour: str
    depth: str
    measured: bool


_TREES = {"rectified": _Tree("image01", "depth01", True), "tracking": _Tree("color", "depth", False)}
_CODE = DepthCode("Hamlyn")
_COLOUR, _DEPTH = r"(\d+)\.(?:jpg|png)", r"(\d+)\.png"


def is_hamlyn(path: Path) -> bool:
    """Whether a folder has both of a tree's folders, with images in the first."""
    return _tree(path) is not None


def image_folder(path: Path) -> Path:
    """Where the colour images of a sequence lie."""
    tree = _tree(path)
    return path if tree is None else path / tree.colour


def camera_file(path: Path) -> Path:
    """Where the camera of a sequence stands."""
    return path / "intrinsics.txt"


def read_hamlyn(
    path: Path,
    camera: CameraModel | None = None,
    light: PhotometricCalibration | None = None,
    mask: np.ndarray | None = None,
    *,
    bit_depth: int | None = None,
) -> FrameSequence:
    """Frames of a rectified sequence, with distance where stereo matching measured it."""
    tree = _tree(path)
    if tree is None:
        raise InputError(
            path,
            "neither image01/ and depth01/ nor color/ and depth/, with images named by a number",
            "is it a sequence of Endo-Depth's Hamlyn set?",
        )
    colour, depth = numbered_files(path / tree.colour, _COLOUR), numbered_files(path / tree.depth, _DEPTH)
    images = [colour[n] for n in sorted(colour)]
    numbers = checked_images(path, images, depth if tree.measured else None)
    if camera is None:
        file = camera_file(path)
        if not file.is_file():
            raise InputError(path, "no intrinsics.txt", f"put the sequence's there, or give {option('camera')} FILE")
        width, height = image_size(images[0])
        camera = read_camera(file, (width, height))
    ray_z = camera.rays()[0][..., 2]

    def distance(i: int) -> np.ndarray | None:
        return _CODE.distance(depth[numbers[i]], ray_z) if tree.measured and numbers[i] in depth else None

    light = light or PhotometricCalibration()
    return frames_of(path, images, camera, light, mask, distance=distance, bit_depth=bit_depth, bordered=True)


FORMAT = Format(
    "hamlyn", fits=is_hamlyn, images=image_folder, has_camera=lambda path: camera_file(path).is_file(), read=read_hamlyn
)


def write_hamlyn(frames: Sequence[Frame], path: Path, tree: str = "rectified") -> None:
    """A sequence as it is shipped ("rectified" or "tracking"), of one pinhole camera, with depth rounded to 1 mm."""
    if not len(frames):
        raise InputError(path, "no frames to write", "expected at least one")
    camera, where = frames[0].camera, _TREES[tree]
    if not isinstance(camera, Pinhole):
        raise InputError(
            path, f"{with_article(camera.name)} camera", "convert it: intrinsics.txt holds a PINHOLE alone"
        )
    for folder in (where.colour, where.depth):
        (path / folder).mkdir(parents=True)
    for frame in frames:
        file = path / where.colour / f"{frame.number:010d}.jpg"
        write_image(file, to_bgr8(frame.image), quality=100)
        if frame.true_distance is not None:
            depth = np.rint(frame.true_distance * camera.rays()[0][..., 2])
            code = np.clip(depth, 0, 65535).astype(np.uint16)
            write_image(path / where.depth / f"{frame.number:010d}.png", code)
    matrix = camera.matrix
    matrix[:2, 2] -= 0.5  # the file's first pixel has its centre at (0, 0)
    np.savetxt(path / "intrinsics.txt", matrix)


def _tree(path: Path) -> _Tree | None:
    """The tree at a path; None where there is none."""
    trees = (tree for tree in _TREES.values() if (path / tree.depth).is_dir())
    return next((tree for tree in trees if numbered_files(path / tree.colour, _COLOUR)), None)
