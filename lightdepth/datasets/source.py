"""Where a sequence of frames comes from: the options that every verb which reads one has."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from lightdepth.camera import CameraModel
from lightdepth.command_line.following import Input, Value
from lightdepth.datasets.no_camera import NoCamera
from lightdepth.datasets.reading import FormatName, image_files, open_sequence
from lightdepth.datasets.sequence import FrameSequence
from lightdepth.errors import InputError
from lightdepth.ranges import Range, checked


@dataclass(frozen=True)
@checked
class SequenceSource:
    """Frames, and the files that win over what lies beside them."""

    data: Path
    """Folder of frames, or a video (a DICOM file too), of any of the formats that --format lists."""
    format: FormatName | None = None
    """Format of the frames: folder (images with camera.json), video, or the data set c3vd, simcol, hamlyn, scared,
    endoslam or endomapper. Left out, it is told by the files."""
    camera: Path | None = None
    """Calibration file of the camera, used instead of the folder's own. Left out, the folder's own, else that of the
    map, where one is given. `auto` finds the camera from the frames' motion, in import, predict, densify, live and
    sparse."""
    light: str | None = None
    """Light of the endoscope, used instead of the folder's own: a light.json, a photometric XML, or values such as
    gamma=2.2,mu=0 (response and spread). Left out, the folder's own, else an assumed one."""
    mask: Path | None = None
    """Image, white where tissue shows and black elsewhere, used instead of the folder's own mask. Left out, the
    folder's own, where it has one, else the black border is found."""
    bit_depth: Annotated[int | None, Range(8, 32)] = None
    """Bits per sample of pictures that have more than 8, e.g. 10 where white is 1023; left out, it is read from the
    files, else told by their highest values. A larger one reads the same numbers as darker."""
    fov: Annotated[float | None, Range(10, 175)] = None
    """Field of view across the image's width, degrees, at which --camera auto (which it implies) starts, and which is
    assumed where the frames do not connect or their motion hardly tells it. A larger one means a shorter focal length.
    Left out, several are tried."""

    @property
    def asks_for_camera(self) -> bool:
        """Whether the camera is to be found from the frames."""
        auto = self.camera == Path("auto") and not self.camera.exists()
        if self.fov is not None and self.camera is not None and not auto:
            raise InputError("--fov", f"with the calibration {self.camera}", "give one of them")
        return auto or self.fov is not None

    def open(self, map_camera: CameraModel | None = None) -> FrameSequence:
        """The frames; `map_camera` as for open_sequence. Raises InputError where they cannot be read, NoCamera for
        verbs that find none."""
        if self.asks_for_camera:
            raise InputError(
                "--camera auto" if self.fov is None else "--fov",
                "this verb finds no camera",
                f"make a sequence with one first: lightdepth import {self.data} --camera auto -o DATA",
            )
        try:
            return open_sequence(self.data, self.format, self.camera, self.light, self.mask, map_camera, self.bit_depth)
        except NoCamera as error:
            raise error.of_other_verb(self.data) from error

    @property
    def image_files(self) -> dict[int, str]:
        """Names of the frames' files by frame number; none of a video."""
        return image_files(self.data, self.format)

    def typed(self, *left_out: str) -> dict[str, Value]:
        """The options that read these frames again, for a command that comes next; some of them may be left out."""
        light = Path(self.light) if self.light and "=" not in self.light else None
        said: dict[str, Value] = {
            "--format": self.format,
            "--camera": Input("CAMERA", self.camera),
            "--fov": None if self.fov is None else f"{self.fov:g}",
            "--light": self.light if light is None else Input("LIGHT", light),
            "--mask": Input("MASK", self.mask),
            "--bit-depth": None if self.bit_depth is None else str(self.bit_depth),
        }
        return {option: value for option, value in said.items() if option not in left_out}

    @property
    def files(self) -> dict[str, Path | None]:
        """The files and folders that are read, by the name of their option."""
        camera = None if self.asks_for_camera else self.camera
        light = Path(self.light) if self.light and "=" not in self.light and Path(self.light).is_file() else None
        return {"data": self.data, "camera": camera, "light": light, "mask": self.mask}
