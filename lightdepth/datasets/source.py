"""Where a sequence of frames comes from: the options that every verb which reads one has."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lightdepth.camera import CameraModel
from lightdepth.datasets.reading import FormatName, open_sequence
from lightdepth.datasets.sequence import FrameSequence


@dataclass(frozen=True)
class SequenceSource:
    """Frames, and the files that win over what lies beside them."""

    data: Path
    """Folder of frames, or a video, of any of the formats that --format lists."""
    format: FormatName | None = None
    """Format of the frames: folder (images with camera.json), video, or the data set c3vd, simcol, hamlyn, scared,
    endoslam or endomapper. Left out, it is told by the files."""
    camera: Path | None = None
    """Calibration file of the camera, used instead of the folder's own. Left out, the folder's own, else that of the
    map, where one is given."""
    light: str | None = None
    """Light of the endoscope, used instead of the folder's own: a light.json, a photometric XML, or values such as
    gamma=2.2,mu=0 (response and spread). Left out, the folder's own, else an assumed one."""
    mask: Path | None = None
    """Image, white where tissue shows and black elsewhere, used instead of the folder's own mask. Left out, the
    folder's own, where it has one, else the black border is found."""
    bit_depth: int | None = None
    """Bits of a sample in pictures that are stored in more than 8, e.g. 10 where white is 1023; left out, what the
    files say, else what their highest values show. A larger one reads the same numbers as darker."""

    def open(self, map_camera: CameraModel | None = None) -> FrameSequence:
        """The frames; `map_camera` as for open_sequence. Raises InputError where they cannot be read."""
        return open_sequence(self.data, self.format, self.camera, self.light, self.mask, map_camera, self.bit_depth)

    @property
    def files(self) -> dict[str, Path | None]:
        """The files and folders that are read, by the name of their option."""
        return {"data": self.data, "camera": self.camera, "mask": self.mask}
