"""What the verb export makes of dense maps, into its run folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from densify.dense_map import map_folders, run_record
from densify.exporting.colmap import write_colmap
from densify.exporting.exported import Exportable, read_exportables
from densify.exporting.meshes import write_mesh, write_surfaces
from densify.exporting.nerfstudio import write_nerfstudio
from densify.exporting.trees import write_climb, write_trajectory
from densify.run_frames import frame_of, run_frames
from lightdepth.counting import counted
from lightdepth.datasets import FrameSequence
from lightdepth.errors import InputError
from lightdepth.ranges import ANY, at_least, checked
from lightdepth.reporting.progress import Progress
from lightdepth.reporting.run import Run

MAP_KINDS = Literal["colmap", "nerfstudio", "ply", "glb", "obj", "tum", "climb"]


@dataclass(frozen=True)
@checked
class MapExport:
    """What goes with the maps of a densify run."""

    data: Path | None = None
    """Frames of the run, for pictures, masks and times; left out, those that the run names, where they still are."""
    map: Path | None = None
    """Sparse map that the run was made of, for tracks; left out, the one that the run names, where it still is."""
    points: Annotated[int, at_least(0)] = 100_000
    """Largest number of the surface's vertices that are written as points of colmap, nerfstudio and climb, besides the
    map's own points. More show the surface more finely and make larger files."""
    frame_offset: Annotated[int, ANY] = 1
    """Number added to each frame's number where climb is written, which counts frames from 1 and we from 0. A larger
    one gives later numbers."""


def export_maps(run: Run, source: Path, to: str, options: MapExport) -> None:
    """Every dense map of a run, each into a folder of its name."""
    if options.points < 0:
        raise InputError("--points", f"{options.points}", "expected a number of points, or 0 for none")
    maps = read_exportables(source, options.map)
    frames = _frames(run, source, options.data) if to in ("colmap", "nerfstudio", "tum", "climb") else None
    times = _times(frames, maps) if to in ("tum", "climb") else {}
    run.record["unit"] = maps[0].unit
    if to == "climb":
        single = [m for m in maps if m.name.startswith("map_")] or maps
        seconds = run_record(source).get("seconds")
        work = float(seconds) if isinstance(seconds, (int, float)) else 0.0
        write_climb(single, run.folder, times, options.frame_offset, options.points, (0.0, work))
        how = f"frames counted from {options.frame_offset}, in {single[0].unit}"
        run.log(f"3D_maps/, camera_trajectory/ and runtime.txt have {counted(len(single), 'map')}, {how}")
        return
    with Progress("Exporting keyframes", sum(len(m.submap.keyframes) for m in maps)) as bar:
        for exported in maps:
            _write_map(run, to, exported, frames, times, options.points, bar)
            _keep_origin(run, source, exported.name)


def _write_map(
    run: Run,
    to: str,
    exported: Exportable,
    frames: FrameSequence | None,
    times: Mapping[int, float],
    points: int,
    bar: Progress,
) -> None:
    """One map into the folder of its name, and a line of what lies there."""
    folder, keyframes = run.folder / exported.name, len(exported.submap.keyframes)
    folder.mkdir()
    said: list[str] = []
    if to == "colmap":
        said = write_colmap(exported, folder, frames, points, bar.advance)
        if not exported.tracked:
            several = exported.name.startswith("joined_")
            why = "they are of several maps" if several else "give --map MAP, from which the run was made"
            run.warn(f"{exported.name}: the map's points have no tracks: {why}")
    elif to == "nerfstudio":
        said = write_nerfstudio(exported, folder, frames, points, bar.advance)
    elif to == "ply":
        write_surfaces(exported, folder)
    elif to == "tum":
        write_trajectory(exported, folder / "trajectory.tum", times)
    else:
        write_mesh(exported, folder / f"mesh.{to}")
    if to not in ("colmap", "nerfstudio"):
        bar.advance(keyframes)
    for words in said:
        run.warn(f"{exported.name}: {words}")
    made = ", ".join(sorted(p.name + "/" * p.is_dir() for p in folder.iterdir()))
    vertices = "" if to == "tum" else f"{len(exported.dense.vertices)} vertices, "
    run.log(f"{exported.name}/ has {made}: {counted(keyframes, 'keyframe')}, {vertices}in {exported.unit}")


def _keep_origin(run: Run, source: Path, name: str) -> None:
    """origin.json of a map that lies far from its origin, beside what was made of it, whose coordinates are near."""
    for file in (folder / "origin.json" for folder in map_folders(source) if folder.name == name):
        if file.is_file():
            (run.folder / name / file.name).write_bytes(file.read_bytes())
            run.log(f"{name}: the map lies far from its origin; {file.name} has the offset to add")


def _frames(run: Run, source: Path, given: Path | None) -> FrameSequence | None:
    """The frames that a run was made of, where they are found; a warning where they are not."""
    frames, missing = run_frames(source, given)
    if missing:
        run.warn(f"{missing}: no pictures, times or masks; give --data")
    return frames


def _times(frames: FrameSequence | None, maps: list[Exportable]) -> dict[int, float]:
    """Seconds of keyframes by frame number, where the frames have them."""
    found = {}
    for number in sorted({k.number for m in maps for k in m.submap.keyframes}):
        frame = frame_of(frames, number)
        if frame is not None and frame.time is not None:
            found[number] = frame.time
    return found
