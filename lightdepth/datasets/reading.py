"""open_sequence: whatever is at a path, as frames."""

from __future__ import annotations

from pathlib import Path

from lightdepth.calibration import read_camera, read_light
from lightdepth.camera import CameraModel
from lightdepth.datasets import c3vd, endomapper, endoslam, hamlyn, simcol
from lightdepth.datasets.c3vd import is_c3vd, read_c3vd
from lightdepth.datasets.checks import check_sequence
from lightdepth.datasets.endomapper import is_endomapper, read_endomapper
from lightdepth.datasets.endoslam import is_endoslam, read_endoslam
from lightdepth.datasets.folder import read_folder
from lightdepth.datasets.hamlyn import is_hamlyn, read_hamlyn
from lightdepth.datasets.scared import is_scared, read_scared
from lightdepth.datasets.sequence import FrameSequence, list_images, read_image, read_mask
from lightdepth.datasets.simcol import is_simcol, read_simcol
from lightdepth.errors import InputError
from lightdepth.frame import check_image_size

FORMATS = ("folder", "c3vd", "simcol", "hamlyn", "scared", "endoslam", "endomapper")


def open_sequence(
    path: str | Path,
    format: str | None = None,
    camera: str | Path | None = None,
    light: str | Path | None = None,
    mask: str | Path | None = None,
    map_camera: CameraModel | None = None,
) -> FrameSequence:
    """Frames at `path`, of a format found by looking or named; lazy but for a few frames that are checked.

    `camera`, `light`, `mask` are files (light also `gamma=2.2,mu=0`) that win over what is in the folder;
    `map_camera` serves where neither a file nor the format gives a camera, and wins over EndoMapper's calibration:
    its own maps were made with other numbers. `check_sequence` says what is doubtful.
    """
    return check_sequence(_open(path, format, camera, light, mask, map_camera))


def _open(
    path: str | Path,
    format: str | None,
    camera: str | Path | None,
    light: str | Path | None,
    mask: str | Path | None,
    map_camera: CameraModel | None,
) -> FrameSequence:
    path = Path(path)
    if format in (None, "endomapper") and endomapper.cluster_of(path) is not None:
        format = "endomapper"
    elif not path.is_dir():
        found = "is a file" if path.is_file() else "does not exist"
        raise InputError(f"{path}: {found}; expected a folder of frames")
    if format is None:
        looks = {
            "c3vd": is_c3vd,
            "simcol": is_simcol,
            "hamlyn": is_hamlyn,
            "scared": is_scared,
            "endoslam": is_endoslam,
            "endomapper": is_endomapper,
        }
        format = next((name for name, fits in looks.items() if fits(path)), "folder")
    chosen_light = read_light(light) if light is not None else None
    chosen_mask = read_mask(Path(mask)) if mask is not None else None
    chosen = _read_camera(Path(camera), _image_folder(path, format)) if camera is not None else None
    if format == "c3vd":
        return read_c3vd(path, chosen, chosen_light, chosen_mask)
    if format == "simcol":
        if chosen is None and map_camera is not None and simcol.camera_file(path) is None:
            chosen = _at_size_of_images(map_camera, path)
        return read_simcol(path, chosen, chosen_light, chosen_mask)
    if format == "hamlyn":
        if chosen is None and map_camera is not None and not (path / "intrinsics.txt").is_file():
            chosen = _at_size_of_images(map_camera, _image_folder(path, format))
        return read_hamlyn(path, chosen, chosen_light, chosen_mask)
    if format == "scared":
        return read_scared(path, chosen, chosen_light, chosen_mask)
    if format == "endoslam":
        if chosen is None and map_camera is not None and endoslam.camera_file(path) is None:
            chosen = _at_size_of_images(map_camera, _image_folder(path, format))
        return read_endoslam(path, chosen, chosen_light, chosen_mask)
    if format == "endomapper":
        if chosen is None and map_camera is not None:
            chosen = _at_size_of_images(map_camera, _image_folder(path, format))
        return read_endomapper(path, chosen, chosen_light, chosen_mask)
    if format == "folder":
        if chosen is None and map_camera is not None and not (path / "camera.json").is_file():
            chosen = _at_size_of_images(map_camera, _image_folder(path, format))
        return read_folder(path, chosen, chosen_light, chosen_mask)
    raise InputError(f"format {format!r}; expected one of {', '.join(FORMATS)}")


def _image_folder(path: Path, format: str) -> Path:
    if format == "endomapper":
        return endomapper.image_folder(path)
    if format == "c3vd":
        return c3vd.image_folder(path)
    if format == "hamlyn":
        return hamlyn.image_folder(path)
    if format == "endoslam":
        return endoslam.image_folder(path)
    return path / "frames" if (path / "frames").is_dir() else path


def _read_camera(file: Path, folder: Path) -> CameraModel:
    """The camera of a file; intrinsics.txt, which holds no size, is for the images in the folder."""
    return read_camera(file, _size_of_images(folder) if file.suffix.lower() == ".txt" else None)


def _at_size_of_images(camera: CameraModel, folder: Path) -> CameraModel:
    """A map's camera at the size of the images: a SLAM often works at half size. Cropped images are refused."""
    size = _size_of_images(folder)
    if size is None:
        return camera
    width, height = size
    if abs(width / camera.width / (height / camera.height) - 1) > 0.01:
        check_image_size(str(folder), width, height, camera)
    return camera if (width, height) == (camera.width, camera.height) else camera.resized(width, height)


def _size_of_images(folder: Path) -> tuple[int, int] | None:
    """Width and height of the first image, where there is one."""
    images = list_images(folder)
    if not images:
        return None
    height, width = read_image(images[0]).shape[:2]
    return width, height
