"""A folder of frames: images (in `frames/` or directly), camera.json, light.json, mask.png; truth/ where there is any.

times.csv has a line `NAME,seconds` for each frame whose time is known, after a line of headings; it wins over a time
that is a frame's name (`frame_00.03s.png`), and this over truth's.

truth/distance/NAME.tiff is float32 [mm] along the ray, 0 where unknown; truth/poses.tum holds world_from_cam, one line
`time tx ty tz qx qy qz qw` per frame in order, millimetres. Where it has another number of lines, as of a sequence of
which only some frames are kept, poses and frames meet by time, or by number where times of the frames are not known.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from lightdepth.calibration import read_camera, read_light, write_camera, write_light
from lightdepth.camera import CameraModel
from lightdepth.datasets.format import Format, Poses, checked_images, frames_of, poses_or_why
from lightdepth.datasets.no_camera import NoCamera
from lightdepth.datasets.sequence import (
    FrameSequence,
    legible,
    list_images,
    no_images,
    read_mask,
)
from lightdepth.errors import InputError
from lightdepth.files.images import image_size, read_raw, to_bgr8, write_image
from lightdepth.files.tum import read_tum, write_tum
from lightdepth.frame import Frame, check_image_size, frame_number
from lightdepth.photometry import PhotometricCalibration
from lightdepth.regular import regular
from lightdepth.which_frame import WhichFrame


def image_folder(path: Path) -> Path:
    """Where the frames of a sequence lie."""
    return path / "frames" if (path / "frames").is_dir() else path


def read_folder(
    path: Path,
    camera: CameraModel | None = None,
    light: PhotometricCalibration | None = None,
    mask: np.ndarray | None = None,
    *,
    bit_depth: int | None = None,
) -> FrameSequence:
    """Frames of a folder. What is given here wins over the files in it; without any camera it is refused."""
    images = list_images(image_folder(path))
    if not images:
        raise InputError(image_folder(path), no_images(image_folder(path)), "expected frames such as 000123.png")
    known = {frame_number(file.name) for file in (path / "truth" / "distance").glob("*.tiff")}
    checked_images(path, images, known)
    first = legible(images)
    if camera is None:
        if not _has_camera(path):
            above = path.resolve().parent
            if (above / "camera.json").is_file():
                raise InputError(path, f"no camera.json, but {above} has one", f"give the sequence's folder, {above}")
            raise NoCamera.at(path, "no camera.json")
        camera = read_camera(path / "camera.json")
        if first is not None:
            check_image_size(str(first), *image_size(first), camera)
    if light is None:
        light = read_light(path / "light.json") if (path / "light.json").is_file() else PhotometricCalibration()
    if mask is None and (path / "mask.png").is_file():
        mask = read_mask(path / "mask.png", first)
    truth = path / "truth"
    clock = read_times(path / "times.csv") if (path / "times.csv").is_file() else {}
    times = _known_times(images, clock)
    poses: Poses = None
    if (truth / "poses.tum").is_file():
        poses = poses_or_why(lambda: _true_poses(truth / "poses.tum", images, times)[0])

    def distance(i: int) -> np.ndarray | None:
        file = truth / "distance" / f"{images[i].stem}.tiff"
        return read_raw(file).astype(np.float32) if file.is_file() else None

    return frames_of(
        path,
        images,
        camera,
        light,
        mask,
        times=times if None not in times else _with_true_times(truth / "poses.tum", images, times),
        poses=poses,
        distance=distance,
        bit_depth=bit_depth,
    )


def stamps(path: Path, images: Sequence[Path]) -> tuple[np.ndarray, np.ndarray | None]:
    """Numbers (n,) of a folder's images and their times (n,) [s]; None where these are not known of all."""
    numbers = np.array([frame_number(image.name) for image in images], np.int64)
    clock = read_times(path / "times.csv") if (path / "times.csv").is_file() else {}
    times = _with_true_times(path / "truth" / "poses.tum", images, _known_times(images, clock))
    return numbers, None if None in times else np.array(times, np.float64)


def _known_times(images: Sequence[Path], clock: Mapping[str, float]) -> list[float | None]:
    """Times [s] of images, of times.csv or of their names."""
    return [clock.get(image.stem, WhichFrame.named(image.name).time) for image in images]


def _with_true_times(file: Path, images: Sequence[Path], times: list[float | None]) -> list[float | None]:
    """The times of images [s], those that are not known from the true poses, where these can be read."""
    if None not in times or not file.is_file():
        return times
    try:
        true = _true_poses(file, images, times)[1]
    except InputError:
        return times  # whoever asks for the poses is told
    return [t if time is None else time for time, t in zip(times, true, strict=True)]


def _true_poses(
    file: Path, images: Sequence[Path], times: Sequence[float | None]
) -> tuple[list[np.ndarray | None], list[float | None]]:
    """The pose (4, 4) of each image and its time [s], None for an image that has none. Raises InputError where the file
    cannot be read, or nothing says whose its poses are."""
    stamps, poses = read_tum(file)
    rows = range(len(images)) if len(poses) == len(images) else _rows_of(file, stamps, images, times)
    return [None if r is None else poses[r] for r in rows], [None if r is None else float(stamps[r]) for r in rows]


def _rows_of(
    file: Path, stamps: np.ndarray, images: Sequence[Path], times: Sequence[float | None]
) -> Sequence[int | None]:
    """The line of each image among poses at `stamps` (n,): by time, else by the number in its name, where the stamps
    are frame numbers, or count evenly from the first frame on."""
    step = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    known = [time for time in times if time is not None]
    if len(known) == len(times) and step > 0:
        nearest = [int(np.abs(stamps - time).argmin()) for time in known]
        near = [abs(stamps[r] - time) <= step / 2 for r, time in zip(nearest, known, strict=True)]
        if any(near):
            return [r if ok else None for r, ok in zip(nearest, near, strict=True)]
    numbers = [frame_number(image.name) for image in images]
    if (stamps == np.rint(stamps)).all():
        line = {int(stamp): r for r, stamp in enumerate(stamps)}
    elif np.abs(stamps - np.arange(len(stamps)) * step).max() < 0.1 * step:
        line = {r: r for r in range(len(stamps))}
    else:
        line = {}
    if not set(numbers) <= set(line):
        raise InputError(
            file,
            f"{len(stamps)} poses for {len(images)} frames",
            "expected one for each frame: in order, or at its time (of times.csv or its name), or with its number",
        )
    return [line[number] for number in numbers]


def _has_camera(path: Path) -> bool:
    return (path / "camera.json").is_file()


FORMAT = Format(
    "folder",
    fits=lambda path: bool(list_images(image_folder(path))),
    images=image_folder,
    has_camera=_has_camera,
    read=read_folder,
)


def write_folder(frames: Iterable[Frame], path: Path) -> None:
    """The layout that read_folder reads, with truth where the frames have it."""
    (path / "frames").mkdir(parents=True)
    poses, times, first = [], [], None
    for frame in frames:
        first = first or frame
        write_image(path / "frames" / f"{frame.name}.png", to_bgr8(frame.image))
        if frame.true_distance is not None:
            (path / "truth" / "distance").mkdir(parents=True, exist_ok=True)
            write_image(path / "truth" / "distance" / f"{frame.name}.tiff", frame.true_distance.astype(np.float32))
        if frame.true_world_from_cam is not None:
            poses.append(frame.true_world_from_cam)
            times.append(frame.time or 0.0)
    if first is None:
        raise InputError(path, "no frames to write", "expected at least one")
    write_camera(first.camera, path / "camera.json")
    write_light(first.light, path / "light.json")
    if first.mask is not None:
        write_image(path / "mask.png", first.mask.astype(np.uint8) * 255)
    if poses:
        write_tum(path / "truth" / "poses.tum", times, poses)


def write_times(path: Path, times: Mapping[str, float]) -> None:
    """times.csv: the time [s] of frames by name, to the microsecond."""
    path.write_text(
        "name,seconds\n" + "".join(f"{name},{time:.6f}\n" for name, time in times.items()),
        encoding="utf-8",
        errors="surrogateescape",  # names of files that are not UTF-8 come back as they are
    )


def read_times(path: Path) -> dict[str, float]:
    """Times [s] of frames by name."""
    times = {}
    regular(path, "expected lines NAME,seconds")
    try:
        lines = path.read_text(encoding="utf-8-sig", errors="surrogateescape").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, f"cannot be read as times of frames ({error})", "expected lines NAME,seconds") from error
    for row, line in enumerate(lines[1:], 2):
        name, _, seconds = line.partition(",")
        try:
            times[name] = float(seconds)
        except ValueError:
            times[name] = float("nan")
        if not np.isfinite(times[name]):
            raise InputError(path, f"line {row}: {line!r}", "expected NAME,seconds")
    return times
