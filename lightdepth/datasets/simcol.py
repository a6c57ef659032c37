"""SimCol3D, rendered colons: FrameBuffer_NNNN.png, Depth_NNNN.png in Frames_<S>, poses and camera beside that folder.

Depth is along the axis, 16 bits, cm = v / 256 / 255 * 20 (in multiples of 256, so in steps of 0.78 mm); 0 and the full
scale (clipped at 200 mm) are unknown. SavedPosition_<S>.txt holds `x y z` [cm] and SavedRotationQuaternion_<S>.txt
`qx qy qz qw` of the camera in the world, one line a frame from frame 0, in Unity's left-handed axes (y up): ours are
S T S with S = diag(1, -1, 1, 1). cam.txt is a 3x3 camera matrix whose principal point, half the image size, shows that
the first pixel's centre is at (0.5, 0.5). These files are looked for beside the frames and in the folder above. The
light of the renderer is not published: it is assumed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lightdepth.calibration import read_camera
from lightdepth.camera import CameraModel, Pinhole
from lightdepth.counting import with_article
from lightdepth.datasets.format import DepthCode, Format, checked_images, frames_of, poses_or_why
from lightdepth.datasets.sequence import FrameSequence, numbered_files
from lightdepth.errors import InputError
from lightdepth.files.images import image_size, to_bgr8, write_image
from lightdepth.frame import Frame
from lightdepth.option_names import option
from lightdepth.photometry import PhotometricCalibration
from lightdepth.regular import regular

FULL_SCALE_MM = 200.0
_TOP = 255 * 256
_CODE = DepthCode("SimCol3D", _TOP, FULL_SCALE_MM, clipped=_TOP)
_FLIP = np.diag([1.0, -1.0, 1.0, 1.0])
_COLOUR, _DEPTH = r"FrameBuffer_(\d+)\.png", r"Depth_(\d+)\.png"
_POSITION, _ROTATION = "SavedPosition", "SavedRotationQuaternion"


def is_simcol(path: Path) -> bool:
    """Whether a folder has SimCol3D's colour files."""
    return any(path.glob("FrameBuffer_*.png"))


def camera_file(path: Path) -> Path | None:
    """cam.txt, beside the frames or in the folder above."""
    return _beside(path, "cam.txt")


def read_simcol(
    path: Path,
    camera: CameraModel | None = None,
    light: PhotometricCalibration | None = None,
    mask: np.ndarray | None = None,
    *,
    bit_depth: int | None = None,
) -> FrameSequence:
    """Frames of a SimCol3D trajectory, with distance and pose where the data set has them."""
    colour, depth = numbered_files(path, _COLOUR), numbered_files(path, _DEPTH)
    images = [colour[n] for n in sorted(colour)]
    if not images:
        raise InputError(path, "no FrameBuffer_NNNN.png in it", "is it a Frames_ folder of SimCol3D?")
    numbers = checked_images(path, images, depth)
    if camera is None:
        file = camera_file(path)
        if file is None:
            raise InputError(
                path, "no cam.txt here or in the folder above", f"put it there, or give {option('camera')} FILE"
            )
        width, height = image_size(images[0])
        # read_camera takes a bare matrix as OpenCV's, with the first centre at (0, 0): undone
        camera = read_camera(file, (width, height)).with_pixel_center(1.0)
    ray_z = camera.rays()[0][..., 2]
    return frames_of(
        path,
        images,
        camera,
        light or PhotometricCalibration(),
        mask,
        poses=poses_or_why(lambda: _poses_of(path, numbers)),
        distance=lambda i: _CODE.distance(depth[numbers[i]], ray_z) if numbers[i] in depth else None,
        bit_depth=bit_depth,
    )


FORMAT = Format(
    "simcol",
    fits=is_simcol,
    images=lambda path: path,
    has_camera=lambda path: camera_file(path) is not None,
    read=read_simcol,
    word="FrameBuffer",
)


def write_simcol(frames: Sequence[Frame], path: Path) -> None:
    """A trajectory as SimCol3D ships it, in path (`.../Frames_S1`), its poses and camera in the folder above. The
    frames are of one pinhole camera and numbered from 0 without a gap; distance and poses where they have them."""
    if [frame.number for frame in frames] != list(range(len(frames))) or not len(frames):
        raise InputError(
            path, "the frames are not numbered 0, 1, 2, ...", "number them so: SimCol3D's poses are told apart by line"
        )
    camera = frames[0].camera
    if not isinstance(camera, Pinhole):
        raise InputError(path, f"{with_article(camera.name)} camera", "convert it: cam.txt holds a PINHOLE alone")
    path.mkdir(parents=True)
    positions, quaternions = [], []
    for frame in frames:
        bgr = to_bgr8(frame.image).astype(np.uint16) * 257
        opaque = np.full((*bgr.shape[:2], 1), 65535, np.uint16)
        write_image(path / f"FrameBuffer_{frame.number:04d}.png", np.concatenate([bgr, opaque], -1))
        if frame.true_distance is not None:
            depth = frame.true_distance * camera.rays()[0][..., 2]
            code = 256 * np.rint(255 * np.clip(depth / FULL_SCALE_MM, 0, 1))
            write_image(path / f"Depth_{frame.number:04d}.png", code.astype(np.uint16))
        if frame.true_world_from_cam is not None:
            unity = _FLIP @ frame.true_world_from_cam @ _FLIP
            positions.append(unity[:3, 3] / 10)
            quaternions.append(Rotation.from_matrix(unity[:3, :3]).as_quat())
    if positions:
        np.savetxt(path.parent / f"{_POSITION}_{_scene(path)}.txt", positions)
        np.savetxt(path.parent / f"{_ROTATION}_{_scene(path)}.txt", quaternions)
    (path.parent / "cam.txt").write_text(
        " ".join(repr(float(v)) for v in camera.matrix.ravel()) + "\n", encoding="utf-8"
    )


def _scene(path: Path) -> str:
    """S1 of Frames_S1."""
    return path.resolve().name.removeprefix("Frames_")


def _beside(path: Path, name: str) -> Path | None:
    """A file in the folder of frames, or in the folder above."""
    return next((f / name for f in (path, path.resolve().parent) if (f / name).is_file()), None)


def _pose_file(path: Path, kind: str) -> Path | None:
    return _beside(path, f"{kind}_{_scene(path)}.txt")


def _poses_of(path: Path, numbers: list[int]) -> np.ndarray | None:
    """(n, 4, 4) world_from_cam [mm] of the frames with these numbers; None where there are no files."""
    poses = _read_poses(path)
    if poses is not None and numbers[-1] >= len(poses):
        raise InputError(
            f"{_pose_file(path, _POSITION)}",
            f"{len(poses)} poses, but there is a frame {numbers[-1]}",
            "expected a line for each frame, from frame 0",
        )
    return None if poses is None else poses[numbers]


def _read_poses(path: Path) -> np.ndarray | None:
    """(n, 4, 4) world_from_cam [mm] in our axes; None where there are neither positions nor rotations."""
    position, rotation = _pose_file(path, _POSITION), _pose_file(path, _ROTATION)
    if position is None and rotation is None:
        return None
    if position is None or rotation is None:
        missing = _POSITION if position is None else _ROTATION
        raise InputError(
            f"{position or rotation}",
            f"there is no {missing}_{_scene(path)}.txt beside it",
            "add it, or remove both to read the frames without poses",
        )
    centres, quaternions = _numbers(position, "x y z"), _numbers(rotation, "qx qy qz qw")
    if len(centres) != len(quaternions):
        raise InputError(
            position, f"{len(centres)} lines, but {rotation.name} has {len(quaternions)}", "expected as many in both"
        )
    length = np.linalg.norm(quaternions, axis=1)
    if (np.abs(length - 1) > 1e-2).any():
        line = int((np.abs(length - 1) > 1e-2).argmax())
        raise InputError(rotation, f"line {line + 1}: the quaternion's length is {length[line]:.4g}", "expected 1")
    unity = np.tile(np.eye(4), (len(centres), 1, 1))
    unity[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    unity[:, :3, 3] = centres * 10
    return _FLIP @ unity @ _FLIP


def _numbers(path: Path, columns: str) -> np.ndarray:
    regular(path)
    try:
        rows = np.loadtxt(path, ndmin=2, encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise InputError(path, f"not lines of numbers ({error})", f"expected `{columns}` on each") from error
    if rows.shape[1] != len(columns.split()):
        raise InputError(path, f"{rows.shape[1]} numbers a line", f"expected `{columns}`")
    if not np.isfinite(rows).all():
        raise InputError(
            path,
            f"line {int((~np.isfinite(rows)).any(1).argmax()) + 1} has NaN or infinite numbers",
            "expected a pose for each frame",
        )
    return rows
