"""The verb sparse: a sparse map by pycolmap."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from densify.inputs import MapSource, map_and_frames
from lightdepth.command_line.following import Input, command
from lightdepth.command_line.options import Group
from lightdepth.command_line.outcome import end
from lightdepth.datasets import FormatName, FrameSequence, SequenceSource
from lightdepth.datasets.reading import stamps_of
from lightdepth.errors import InputError
from lightdepth.files.tum import read_tum
from lightdepth.frame import frame_number, readable
from lightdepth.maps.convention import MapConvention, MapReading
from lightdepth.ranges import Range
from lightdepth.reporting.run import recorded, run_folder
from lightdepth.sfm.config import SfmConfig
from lightdepth.sfm.made import made_sparse
from lightdepth.uncalibrated import open_frames


@dataclass(frozen=True)
class Beginning:
    """What is known of the frames' poses."""

    poses: str | None = None
    """Known poses of the frames: truth (those of the sequence), or a TUM file (world from camera) whose times are frame
    numbers, or seconds where the frames are stamped or --map-fps counts; only points are then found. Left out, poses
    are found as well."""
    repair: Path | None = None
    """Sparse map of the frames to make anew, by matching the images of its keyframes, beginning at its poses and
    keeping its coordinates and scale; not with --poses. Left out, the map is made of all frames."""

    def __post_init__(self) -> None:
        if self.repair is not None and self.poses is not None:
            raise InputError("--repair", "with --poses", "give one of them: a map has its own poses")


def sparse(
    data: Path,
    output: Path,
    format: FormatName | None = None,
    camera: Path | None = None,
    fov: Annotated[float | None, Range(10, 175)] = None,
    mask: Path | None = None,
    bit_depth: Annotated[int | None, Range(8, 32)] = None,
    begun: Group[Beginning] = Beginning(),
    sfm: SfmConfig = SfmConfig(),
    reading: Group[MapReading] = MapReading(),
    overwrite: bool = False,
    resume: bool = False,
) -> None:
    """A sparse map by pycolmap, where there is no SLAM output or a poor one.

    Args:
        data: Folder of frames, or video, to map.
        output: Folder to make, with one COLMAP model for each submap.
        format: Format of the frames: folder, video, c3vd, simcol, hamlyn, scared, endoslam or endomapper; found by
            looking if left out.
        camera: Calibration file that wins over the folder's own; `auto` finds the camera from the frames' motion.
        fov: Field of view across the image's width, degrees, at which --camera auto (which it implies) starts, and
            which is assumed where the frames do not connect or their motion hardly tells it. A larger one means a
            shorter focal length.
        mask: Image, white where tissue shows and black elsewhere; left out, the folder's own mask, where it has one.
        bit_depth: Bits per sample of pictures that have more than 8; left out, it is read from the files, else told by
            their highest values. A larger one reads the same numbers as darker.
        sfm: how frames are mapped
        overwrite: Replace a folder made before.
        resume: Go on with the run that was stopped there, as it was begun; features and matches that are done, up to
            the last minute, are not made again.
    """
    poses, repair = begun.poses, begun.repair
    source = SequenceSource(data, format, camera, mask=mask, bit_depth=bit_depth, fov=fov)
    arguments = recorded(
        reading,
        begun,
        output=output,
        data=data,
        format=format,
        camera=camera,
        fov=fov,
        mask=mask,
        bit_depth=bit_depth,
        sfm=sfm,
    )
    with run_folder(output, "sparse", arguments, overwrite, resume) as run:
        run.hash_inputs(**source.files, repair=repair, poses=None if poses in (None, "truth") else Path(poses))
        if repair is not None:
            map_and_frames(run, source, MapSource.read_as(repair, reading, repair_map=True), sfm)
        else:
            frames = open_frames(source, run, None, sfm)
            known = None if poses is None else _poses(poses, frames, source, reading)
            made_sparse(run, frames.without_truth(), sfm, known, source.image_files)
    read_as = source.typed("--camera", "--fov")  # the map has the camera
    options = {"--map": output / "sparse", **read_as, "-o": "runs/dense"}
    end(output, then=command("densify", Input("DATA", data), options=options))


def _poses(given: str, frames: FrameSequence, source: SequenceSource, reading: MapReading) -> dict[int, np.ndarray]:
    """Known poses (4, 4) by frame number."""
    if given == "truth":
        blind = frames.without_truth()
        found = ((f.number, f.true_world_from_cam) for f in readable(blind, range(len(blind))))
        known = {number: pose for number, pose in found if pose is not None}
        if not known:
            frames.first()  # says why, where those that there are cannot be read
            raise InputError(frames.source, "no frame has a pose", "give --poses FILE, a TUM trajectory")
        return known
    times, poses = read_tum(Path(given))
    clock = reading.over(MapConvention(frames=stamps_of(source.data, source.format))).clock
    numbers = [frame_number(name) + reading.frame_offset for name in clock.names(times, given, begun=None)]
    return dict(zip(numbers, poses, strict=True))
