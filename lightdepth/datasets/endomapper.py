"""EndoMapper: extracted frames `out<N>.png`, with the calibration of the endoscope by number (FORMATS: EndoMapper).

The frames lie in img_train/, images/, frames/ or the folder itself; N counts from 1, so that video frame 0 is out1.
`Endoscope_XX_geometrical.xml` and `Endoscope_XX_photometrical.xml` are looked for beside the frames, and then in
Calibrations/ (in a folder for each endoscope, or without) here and in the folders above. Where there is more than one
endoscope, `Seq_NNN_info.json` says which it was. Calibrations are for 1440x1080, and are resized to smaller frames of
that shape. mask.png, in the folder or beside the frames, is white where tissue shows; without one the black border is
found. Times need the video's frame rate: `fps` in Seq_NNN_info.json, or the Seq_NNN.mov beside it.

The COLMAP clusters of Seq_001 and Seq_002 (a folder such as 33/, with img_train/, sparse/<M>, cluster_list/<M>.txt) are
read whole by that folder, and one by one by `33/sparse/<M>` (the frames of that model) or `33/cluster_list/<M>.txt`
(the frames that were given to it), with the camera of that model. The models are `read_map`'s.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lightdepth.calibration import read_camera, read_light, write_camera, write_light
from lightdepth.camera import CameraModel
from lightdepth.datasets.format import Format, checked_images, frames_of
from lightdepth.datasets.sequence import FrameSequence, list_images, no_images, read_mask
from lightdepth.errors import InputError
from lightdepth.files.images import image_size, to_bgr8, write_image
from lightdepth.files.schema import read_json
from lightdepth.frame import Frame, check_image_size, frame_number, resized_mask
from lightdepth.maps import read_map
from lightdepth.option_names import option
from lightdepth.photometry import PhotometricCalibration
from lightdepth.regular import regular

_LEVELS = 6  # folders above the frames in which calibrations are looked for
GEOMETRY, PHOTOMETRY = "geometrical", "photometrical"


def is_endomapper(path: Path) -> bool:
    """Whether a folder has EndoMapper's frames, or an endoscope's calibration beside images."""
    if (path / "camera.json").is_file():
        return False
    named = any(re.fullmatch(r"out\d+", image.stem) for image in list_images(image_folder(path)))
    return named or any(path.glob(f"Endoscope_*_{GEOMETRY}.xml"))


def cluster_of(path: Path) -> tuple[Path, int] | None:
    """The folder and the number of a COLMAP cluster, of a path FOLDER/sparse/<M> or FOLDER/cluster_list/<M>.txt."""
    path = path.resolve()
    folder, listed = path.parent.parent, path.parent.name == "cluster_list" and path.suffix == ".txt" and path.is_file()
    if not (listed or (path.parent.name == "sparse" and path.is_dir())) or not path.stem.isdecimal():
        return None
    images = list_images(_frames_of(folder))
    return (folder, int(path.stem)) if any(re.fullmatch(r"out\d+", image.stem) for image in images) else None


def image_folder(path: Path) -> Path:
    """Where the frames of a sequence, or of a cluster, lie."""
    cluster = cluster_of(path)
    return _frames_of(path if cluster is None else cluster[0])


def _frames_of(path: Path) -> Path:
    return next((path / name for name in ("img_train", "images", "frames") if (path / name).is_dir()), path)


def read_endomapper(
    path: Path,
    camera: CameraModel | None = None,
    light: PhotometricCalibration | None = None,
    mask: np.ndarray | None = None,
    fps: float | None = None,
    *,
    bit_depth: int | None = None,
) -> FrameSequence:
    """Frames of extracted video, or of one cluster. What is given here wins over the files; time is (N - 1) / fps where
    `fps` (40 or 50 in the data set) is given or found. Raises InputError where no camera is found."""
    images = list_images(image_folder(path))
    cluster, source = cluster_of(path), path
    if cluster is not None:
        images, own = _in_cluster(path, images)
        path = cluster[0]
        if camera is None and own is not None and images:
            width, height = image_size(images[0])
            camera = at_size(own, width, height, images[0].name)
    if not images:
        raise InputError(f"{image_folder(path)}", f"{no_images(image_folder(path))}", "expected out1.png, out2.png")
    if frame_number(images[0].name) < 1:
        raise InputError(
            images[0],
            "number 0, but EndoMapper counts frames from 1 (out1.png is the first of the video)",
            f"extract them so, or read them with {option('format')} folder",
        )
    numbers = checked_images(path, images)
    width, height = image_size(images[0])
    if camera is None:
        file = calibration_file(path, GEOMETRY)
        if file is None:
            raise InputError(
                path,
                f"no Endoscope_XX_{GEOMETRY}.xml here, nor in Calibrations/ here or above",
                f"put it beside the frames, or give {option('camera')} FILE",
            )
        camera = at_size(read_camera(file), width, height, images[0].name)
    if light is None:
        file = calibration_file(path, PHOTOMETRY)
        light = PhotometricCalibration() if file is None else read_light(file)
    if mask is None:
        found = [f for f in (path / "mask.png", image_folder(path) / "mask.png") if f.is_file()]
        mask = read_mask(found[0]) if found else None
        if mask is not None and abs(mask.shape[1] / mask.shape[0] / (width / height) - 1) < 0.01:
            mask = resized_mask(mask, (width, height))
    fps = fps or _fps(path)
    times = None if fps is None else [(number - 1) / fps for number in numbers]
    return frames_of(source, images, camera, light, mask, times=times, bit_depth=bit_depth, bordered=True)


# A map's camera wins: EndoMapper's own maps were made with other numbers than its calibrations
FORMAT = Format("endomapper", fits=is_endomapper, images=image_folder, has_camera=lambda _: False, read=read_endomapper)


def write_endomapper(frames: Sequence[Frame], path: Path, endoscope: str = "00") -> None:
    """img_train/out<N>.png by the frames' numbers, which count from 1, the two XML files and mask.png. Truth, gain and
    reflectance have no place in it."""
    if not len(frames):
        raise InputError(path, "no frames to write", "expected at least one")
    early = [frame.name for frame in frames if frame.number < 1]
    if early:
        raise InputError(
            path,
            f"frame {early[0]} has number {frame_number(early[0])}",
            "expected at least 1: EndoMapper counts from 1",
        )
    (path / "img_train").mkdir(parents=True)
    write_camera(frames[0].camera, path / f"Endoscope_{endoscope}_{GEOMETRY}.xml")
    write_light(frames[0].light, path / f"Endoscope_{endoscope}_{PHOTOMETRY}.xml")
    if frames[0].mask is not None:
        write_image(path / "mask.png", frames[0].mask.astype(np.uint8) * 255)
    for frame in frames:
        write_image(path / "img_train" / f"out{frame.number}.png", to_bgr8(frame.image))


def _in_cluster(path: Path, images: list[Path]) -> tuple[list[Path], CameraModel | None]:
    """The images of a cluster, and the camera of its model where there is one."""
    cluster = cluster_of(path)
    assert cluster is not None
    model = cluster[0] / "sparse" / path.stem
    keyframes = read_map(model).submaps[0].keyframes if model.is_dir() else ()
    if path.suffix == ".txt":
        names = regular(path).read_text(errors="replace", encoding="utf-8-sig").split()
        odd = [name for name in names if not re.fullmatch(r"(?:.*[/\\])?out\d+(?:\.\w+)?", name)]
        if odd or not names:
            raise InputError(
                path, f"{odd[0][:60] if odd else 'nothing in it'}", "expected the frames' names, out<N>.png"
            )
        numbers = {frame_number(name) for name in names}
    else:
        numbers = {keyframe.number for keyframe in keyframes}
    missing = sorted(numbers - {frame_number(image.name) for image in images})
    if missing:
        raise InputError(
            path,
            f"{len(missing)} of its {len(numbers)} frames are not there, the first is out{missing[0]}",
            "add them, or take them out of the list",
        )
    chosen = [image for image in images if frame_number(image.name) in numbers]
    return chosen, keyframes[0].camera if keyframes else None


def _fps(path: Path) -> float | None:
    """Frames per second: what the sequence's info file says, else the video's own; None where there is neither."""
    for folder in _upwards(path):
        for file in sorted(folder.glob("Seq_*_info.json")):
            data = read_json(file)
            found = data.get("fps") if isinstance(data, dict) else None
            if isinstance(found, int | float) and 1 <= found <= 1000:
                return float(found)
        videos = sorted(folder.glob("Seq_*.mov"))
        if len(videos) == 1:
            return _frame_rate(videos[0])
    return None


def _frame_rate(video: Path) -> float | None:
    import av

    try:
        with av.open(str(video)) as container:
            rate = container.streams.video[0].average_rate
    except (OSError, IndexError, av.error.FFmpegError):
        return None
    return float(rate) if rate else None


def at_size(camera: CameraModel, width: int, height: int, name: str) -> CameraModel:
    """The calibration at the size of the frames; cropped frames are refused."""
    if abs(width / camera.width / (height / camera.height) - 1) > 0.01:
        check_image_size(name, width, height, camera)
    return camera if (width, height) == (camera.width, camera.height) else camera.resized(width, height)


def calibration_file(path: Path, kind: str) -> Path | None:
    """The calibration of this kind closest to the frames; of several, the one of the sequence's endoscope."""
    for folder in _upwards(path):
        patterns = ("", "Calibrations/", "Calibrations/Endoscope_*/")
        found = {f.name: f for pattern in patterns for f in sorted(folder.glob(f"{pattern}Endoscope_*_{kind}.xml"))}
        if not found:
            continue
        number = _endoscope(path)
        if number is None and len(found) == 1:
            return next(iter(found.values()))
        if number is None:
            raise InputError(
                folder,
                f"{len(found)} calibrations ({', '.join(found)}) and no Seq_NNN_info.json that says which endoscope "
                "it was",
                f"put the right one beside the frames, or give {option('camera')} and {option('light')}",
            )
        for name, file in found.items():
            label = name.removeprefix("Endoscope_").removesuffix(f"_{kind}.xml")
            if label == number or (label.isdigit() and number.isdigit() and int(label) == int(number)):
                return file
        raise InputError(
            folder,
            f"{', '.join(found)}, but the sequence was made with endoscope {number}",
            f"give its calibration with {option('camera')} and {option('light')}",
        )
    return None


def _endoscope(path: Path) -> str | None:
    """The endoscope's number in the sequence's info file; None where there is no such file."""
    for folder in _upwards(path):
        for file in sorted(folder.glob("Seq_*_info.json")):
            data = read_json(file)
            number = data.get("endoscope_number") if isinstance(data, dict) else None
            if number is None:
                raise InputError(file, "endoscope_number missing", "expected the number of the endoscope, or N/A")
            return str(number)
    return None


def _upwards(path: Path) -> list[Path]:
    path = path.resolve()
    return [path, *list(path.parents)[: _LEVELS - 1]]
