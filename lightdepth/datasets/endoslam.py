"""EndoSLAM, as far as its files are surely known, and EndoMapper's simulated sequences, which one renderer made alike.

| tree | frames | camera | poses |
|---|---|---|---|
| EndoSLAM, real cameras | `Frames/` | MATLAB files, not read: give it | `Poses/`: of the robot's hand; left alone |
| EndoSLAM, UnityCam | `Frames/image_NNNN.png` | `Calibration/cam.txt` here or above | `Poses/*.csv`, metres |
| EndoMapper, simulated | `image_NNNN.png`, or in rgb/ | `calibration.txt`, lines `fx: 1` | `trajectory.csv`, dm |

A line of the csv is a frame from 0 and its header names the columns (tX tY tZ rX rY rZ rW). The renderer is Unity's:
its left-handed axes (y up) are turned into ours. Neither these axes nor UnityCam's unit are published, so a warning
goes with poses. Depth is no truth here: UnityCam's has 8 bits of an unknown scale (its readers disagree: centimetres,
millimetres), and the simulated sequences' EXR holds a code that its authors never described. cam.txt is taken as
OpenCV's matrix, with the first pixel's centre at (0, 0); calibration.txt as the renderer's, at (0.5, 0.5). The light is
not known.
"""

from __future__ import annotations

import csv
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lightdepth.calibration import read_camera
from lightdepth.camera import CameraModel, Pinhole, camera_from_params
from lightdepth.counting import with_article
from lightdepth.datasets.format import Format, frames_of, poses_or_why
from lightdepth.datasets.sequence import FrameSequence, list_images, numbered_files
from lightdepth.errors import InputError
from lightdepth.files.images import image_size, to_bgr8, write_image
from lightdepth.frame import Frame, frame_number
from lightdepth.option_names import option
from lightdepth.photometry import PhotometricCalibration
from lightdepth.regular import regular

_COLUMNS = ("tx", "ty", "tz", "rx", "ry", "rz", "rw")
_RENDERED = r"image_(\d+)\.(?:png|jpg)"
_FLIP = np.diag([1.0, -1.0, 1.0, 1.0])


def is_endoslam(path: Path) -> bool:
    """Whether a folder has Frames/ beside Poses/ or Pixelwise Depths/, or a simulated sequence of EndoMapper."""
    if _simulated(path):
        return True
    names = {p.name for p in path.iterdir() if p.is_dir()} if path.is_dir() else set()
    return "Frames" in names and bool(names & {"Poses", "Pixelwise Depths"}) and bool(list_images(path / "Frames"))


def image_folder(path: Path) -> Path:
    """Where the frames of a sequence lie."""
    return next((path / name for name in ("Frames", "rgb") if (path / name).is_dir()), path)


def camera_file(path: Path) -> Path | None:
    """What the camera is read from: calibration.txt of a simulated sequence, or UnityCam's Calibration/cam.txt."""
    if _simulated(path):
        return path / "calibration.txt"
    if not _rendered(path):
        return None
    places = (f / "Calibration" / "cam.txt" for f in (path, *list(path.resolve().parents)[:2]))
    return next((file for file in places if file.is_file()), None)


def read_endoslam(
    path: Path,
    camera: CameraModel | None = None,
    light: PhotometricCalibration | None = None,
    mask: np.ndarray | None = None,
    *,
    bit_depth: int | None = None,
) -> FrameSequence:
    """Frames of a sequence, with poses where a renderer wrote them. There is no true depth."""
    folder = image_folder(path)
    images = [folder / name for name in _rendered(path).values()] or (list_images(folder) if folder.is_dir() else [])
    if not images:
        raise InputError(path, "no Frames/ with images in it, and no image_NNNN.png", "is it a sequence of EndoSLAM?")
    width, height = image_size(images[0])
    if camera is None:
        file = camera_file(path)
        if file is None:
            raise InputError(
                path,
                "no camera: EndoSLAM's are MATLAB files (.mat), which are not read",
                'write the numbers into a camera.json ({"model": "PINHOLE", "width": W, "height": H, "params": [fx, '
                f"fy, cx, cy]}}) and give it with {option('camera')}",
            )
        camera = _read_calibration(file) if _simulated(path) else read_camera(file, (width, height))
    poses = poses_or_why(lambda: _poses_of(path, images))
    light = light or PhotometricCalibration()
    return frames_of(path, images, camera, light, mask, poses=poses, bit_depth=bit_depth, bordered=True)


FORMAT = Format(
    "endoslam",
    fits=is_endoslam,
    images=image_folder,
    has_camera=lambda path: camera_file(path) is not None,
    read=read_endoslam,
)


def write_endoslam(frames: Sequence[Frame], path: Path, simulated: bool = False) -> None:
    """Frames of a pinhole as UnityCam's sequences are shipped (`.../UnityCam/Colon`), or as EndoMapper's simulated
    ones, with poses where they have them; numbered from 0 without a gap. Depth is not written."""
    if [frame.number for frame in frames] != list(range(len(frames))) or not len(frames):
        raise InputError(
            path, "the frames are not numbered 0, 1, 2, ...", "number them so: poses are told apart by line"
        )
    camera = frames[0].camera
    if not isinstance(camera, Pinhole):
        raise InputError(path, f"{with_article(camera.name)} camera", "convert it: the files hold a PINHOLE alone")
    folder, poses = (path, path) if simulated else (path / "Frames", path / "Poses")
    for made in (folder, poses):
        made.mkdir(parents=True, exist_ok=True)
    unit, between = (100, ";") if simulated else (1000, ",")
    lines = [between.join(("tX", "tY", "tZ", "rX", "rY", "rZ", "rW", "time(s)" if simulated else "time"))]
    for frame in frames:
        write_image(folder / f"image_{frame.number:04d}.png", to_bgr8(frame.image))
        if frame.true_world_from_cam is not None:
            unity = _FLIP @ frame.true_world_from_cam @ _FLIP
            numbers = (*unity[:3, 3] / unit, *Rotation.from_matrix(unity[:3, :3]).as_quat(), frame.number / 30)
            lines.append(between.join(repr(float(v)) for v in numbers))
    fx, fy, cx, cy = camera.params
    if simulated:
        (path / "info.txt").write_text("depth and trajectory in dm\n", encoding="utf-8")
        (path / "calibration.txt").write_text(
            f"fx: {fx!r}\nfy: {fy!r}\ncx: {cx!r}\ncy: {cy!r}\n\ncols: {camera.width}\nrows: {camera.height}\n",
            encoding="utf-8",
        )
    else:
        place = path.resolve().parent / "Calibration"
        place.mkdir(exist_ok=True)
        (place / "cam.txt").write_text(f"{fx!r},0,{cx - 0.5!r},0,{fy!r},{cy - 0.5!r},0,0,1\n", encoding="utf-8")
    if len(lines) > 1:
        name = "trajectory.csv" if simulated else f"{path.name.lower()}_position_rotation.csv"
        (poses / name).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _rendered(path: Path) -> dict[int, str]:
    """The renderer's frames by number."""
    return {n: file.name for n, file in sorted(numbered_files(image_folder(path), _RENDERED).items())}


def _simulated(path: Path) -> bool:
    return (path / "calibration.txt").is_file() and bool(_rendered(path))


def _read_calibration(path: Path) -> CameraModel:
    """`fx: 1.0` and so on, a line each."""
    found = {}
    for line in regular(path).read_text(errors="replace", encoding="utf-8-sig").splitlines():
        key, colon, value = line.partition(":")
        try:
            found[key.strip()] = float(value) if colon else 0.0
        except ValueError as error:
            raise InputError(path, f"{key.strip()} is {value.strip()!r}", "expected a number") from error
    names = ("cols", "rows", "fx", "fy", "cx", "cy")
    missing = [name for name in names if name not in found]
    if missing:
        raise InputError(
            path, f"{', '.join(missing)} missing", f"expected lines such as `fx: 400`, of {', '.join(names)}"
        )
    width, height, *params = (found[name] for name in names)
    return camera_from_params("PINHOLE", int(width), int(height), params, str(path))


def _poses_of(path: Path, images: Sequence[Path]) -> list[np.ndarray | None]:
    found = _poses(path)
    return [found.get(frame_number(image.name)) for image in images]


def _poses(path: Path) -> dict[int, np.ndarray]:
    """world_from_cam [mm] in our axes by frame number; empty where no renderer wrote any."""
    if _simulated(path):
        file, mm = path / "trajectory.csv", 100.0
        info = path / "info.txt"
        if not file.is_file():
            return {}
        if not info.is_file() or "dm" not in info.read_text(errors="replace", encoding="utf-8-sig").lower().split():
            raise InputError(info, "does not say that lengths are in dm", f"restore it, or remove {file.name}")
    else:
        files = sorted((path / "Poses").glob("*.csv")) if _rendered(path) else []
        if len(files) > 1:
            raise InputError(
                f"{path / 'Poses'}", f"{', '.join(f.name for f in files)}", "leave the sequence's own alone there"
            )
        if not files:
            return {}
        file, mm = files[0], 1000.0
    poses = _read_csv(file, mm)
    warnings.warn(
        f"{file}: poses are taken in Unity's axes (y up, left-handed) and {'metres' if mm == 1000 else 'decimetres'}; "
        "the data set does not say: compare a trajectory before trusting them",
        stacklevel=4,
    )
    return poses


def _read_csv(path: Path, mm: float) -> dict[int, np.ndarray]:
    with regular(path).open(newline="", encoding="utf-8-sig", errors="replace") as stream:
        header = stream.readline()
        between = ";" if ";" in header else ","
        names = [name.strip().lower() for name in header.split(between)]
        if not set(_COLUMNS) <= set(names):
            raise InputError(
                path,
                f"the first line is {header.strip()[:60]!r}",
                "expected a header that names tX tY tZ (position) and rX rY rZ rW (quaternion). The order of columns "
                "differs from file to file: write the header, or move the file away to read the frames without poses",
            )
        rows = [row for row in csv.reader(stream, delimiter=between) if row]
    poses = {}
    for number, row in enumerate(rows):
        try:
            values = [float(row[names.index(name)]) for name in _COLUMNS]
        except (ValueError, IndexError) as error:
            if number == len(rows) - 1 and number:
                break  # a last line that was cut off: that frame has no pose
            raise InputError(path, f"line {number + 2} is {between.join(row)[:60]!r}", "expected numbers") from error
        length = float(np.linalg.norm(values[3:]))
        if not np.isfinite(values).all() or abs(length - 1) > 1e-2:
            raise InputError(path, f"line {number + 2}: a quaternion of length {length:.4g}, or NaN", "expected 1")
        unity = np.eye(4)
        unity[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
        unity[:3, 3] = np.multiply(values[:3], mm)
        poses[number] = _FLIP @ unity @ _FLIP
    return poses
