"""What a verb works on: the frames, their sparse map or one made of them, and the light that the map tells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from densify.config import MethodConfig
from densify.placing import Placing
from densify.scaling import WALL_MM
from lightdepth.calibration import write_camera
from lightdepth.camera import CameraModel, Provenance
from lightdepth.command_line.dry import Step
from lightdepth.counting import counted
from lightdepth.datasets import FrameSequence, SequenceSource
from lightdepth.datasets.coloured import colours_of
from lightdepth.datasets.pairing import check_shared_frames
from lightdepth.datasets.with_map import open_with_map
from lightdepth.detective import PairingConfig, check_pairing
from lightdepth.detective.clock import by_the_images
from lightdepth.errors import InputError
from lightdepth.frame import Frame, check_image_size
from lightdepth.light.fit_on_map import fit_assumed_light
from lightdepth.light.views import with_light
from lightdepth.maps import write_text_model
from lightdepth.maps.convention import MapReading
from lightdepth.models import ConstantModel, DepthModel
from lightdepth.ranges import above, checked
from lightdepth.reporting.kept import kept
from lightdepth.reporting.progress import Stages
from lightdepth.reporting.run import Run, plain
from lightdepth.sfm.config import Progress, SfmConfig
from lightdepth.sfm.keeping import KeptDatabase
from lightdepth.sfm.made import made_sparse
from lightdepth.sfm.polish import polished_submap
from lightdepth.sfm.repair import Repair, repaired_submap
from lightdepth.sparse_map import Keyframe, SparseMap, Submap, with_provenance
from lightdepth.uncalibrated import check_camera_asked, open_frames


@dataclass(frozen=True)
@checked
class SurfaceFiles:
    """How surfaces are written."""

    formats: tuple[Literal["ply", "glb", "obj"], ...] = ("ply",)
    """Formats of the mesh files to write: ply, which must be among them, and besides it glb and obj if wanted."""
    mm_per_unit: Annotated[float | Literal["light"] | None, above(0)] = None
    """Millimetres per map unit, where known: lengths and surfaces are then written in mm, else in map units. It is one
    factor for all submaps, right for those that share a unit. A larger one makes a larger surface. The word light finds
    each submap's own factor, with an interval, from the light beside the lens; where it finds none, surfaces stay in
    map units."""
    wall_mm: Annotated[float, above(0)] = WALL_MM
    """Median distance of the wall, mm, that --mm-per-unit light starts from: it tries scales that make the distance 0.4
    to 2.5 times this. A larger one looks for larger scales."""

    def __post_init__(self) -> None:
        if "ply" not in self.formats:
            raise InputError("--formats", f"{list(self.formats)}", "expected ply, and besides it glb and obj if wanted")


@dataclass(frozen=True)
class MapSource(PairingConfig):
    """A sparse map, and what is asked of it."""

    map: Path | None = None
    """Sparse map of the frames (poses and points of a SLAM): COLMAP model(s), a multi-map tree, a stella_vslam
    map, or a TUM trajectory with points; left out, pycolmap makes one from the frames."""
    repair_map: bool = False
    """Make the map anew before it is used, by matching the images of its keyframes, beginning at its poses and keeping
    its coordinates and scale; written to sparse/ in the run folder. Switched off, it is used as it is."""
    polish_map: bool = False
    """Move keyframes whose poses disagree with the map's own points to where these points put them, each only if hidden
    blocks of points confirm it; this is done before repair_map. Where any moved, the map is written to polished/ in the
    run folder, in its old coordinates and scale. Switched off, poses stay as they are."""

    @classmethod
    def read_as(cls, map: Path, reading: MapReading, trust_map: bool = False, repair_map: bool = False) -> MapSource:
        """A map that is read as was said elsewhere."""
        return cls(
            trust_map,
            map,
            repair_map,
            map_folder=reading.map_folder,
            map_sensor=reading.map_sensor,
            frame_offset=reading.frame_offset,
            map_fps=reading.map_fps,
            time_offset=reading.time_offset,
            time_tolerance=reading.time_tolerance,
        )


def map_and_frames(
    run: Run, source: SequenceSource, mapped: MapSource, sfm: SfmConfig
) -> tuple[SparseMap, FrameSequence]:
    """The map that was given, or one made of the frames, and the frames, under the map's camera where they have none.
    A map made at another image size is rescaled to theirs. Raises InputError where no frame is of the map, or where
    the images say that they are not its."""
    if mapped.map is None and mapped.polish_map:
        raise InputError("--polish-map", "given without --map: pycolmap's own poses fit its points", "leave it out")
    if mapped.map is None:
        frames = open_frames(source, run, None, sfm).without_truth()
        return made_sparse(run, frames, sfm, files=source.image_files), frames
    check_camera_asked(source)
    sparse_map, frames = open_with_map(source, mapped.map, mapped)
    frames = frames.without_truth()
    sparse_map = by_the_images(sparse_map, frames)
    map_camera = sparse_map.submaps[0].keyframes[0].camera
    check_shared_frames(sparse_map, frames)
    _say_localised(run, sparse_map, frames)
    width, height = frames.image_size()
    given = frames.first().camera if source.camera is not None else None
    if (map_camera.width, map_camera.height) != (width, height):
        run.log(f"map made at {map_camera.width}x{map_camera.height}, rescaled to the frames' {width}x{height}")
    fitted = fitted_to_frames(sparse_map, width, height, given)  # first: a cropped image is refused by its size
    check_pairing(sparse_map, frames, mapped, run, given)
    if mapped.polish_map:
        fitted = polished(run, fitted)
    return (repaired(run, fitted, frames, sfm) if mapped.repair_map else fitted), frames


def _say_localised(run: Run, sparse_map: SparseMap, frames: FrameSequence) -> None:
    """How much of the sequence the map's SLAM knew its place in, where the map tells; and where a far map begins."""
    there = set(frames.numbers)
    told = {}
    for submap in sparse_map.submaps:
        if any(submap.origin):
            at = ", ".join(f"{value:.0f}" for value in submap.origin)
            run.log(
                f"map {submap.id} lies far from its origin: {at} is subtracted from its coordinates, see origin.json"
            )
        if submap.localised is not None:
            count = len(there.intersection(submap.localised))
            told[submap.id] = {"localised": count, "frames": len(there), "keyframes": len(submap.keyframes)}
            run.log(
                f"map {submap.id}: {count} of {len(there)} frames localised ({count / len(there):.0%}), "
                f"{len(submap.keyframes)} of them keyframes"
            )
    if told:
        run.record["localised"] = plain(told)


def polished(run: Run, sparse_map: SparseMap) -> SparseMap:
    """The map with the poses that its points bear out; submaps of which one moved are written to polished/ in the run
    folder, as COLMAP models. A dry run leaves the map as it is."""
    if run.plan is not None:
        return sparse_map
    submaps, told = [], []
    for submap in sparse_map.submaps:
        new, polish = polished_submap(submap)
        if not polish.left:
            write_text_model(new, run.folder / "polished" / str(submap.id))
        run.log(f"poses: {polish}")
        submaps.append(new)
        told.append({**plain(polish), "sentence": str(polish)})
    run.record["polish"] = told
    return replace(sparse_map, submaps=tuple(submaps))


def repaired(run: Run, sparse_map: SparseMap, frames: FrameSequence, config: SfmConfig) -> SparseMap:
    """The map made anew from the images of its keyframes, submap by submap, written to sparse/ in the run folder."""
    keyframes = counted(sum(len(s.keyframes) for s in sparse_map.submaps), "keyframe")
    run.begins(f"the map of {keyframes} would be made anew first", lambda: [Step(f"matching {keyframes}")])
    submaps, told = [], []
    for submap in sparse_map.submaps:
        seen = [k for k in submap.keyframes if k.number in frames.numbers]
        images = FrameSequence([k.name for k in seen], _ImagesOf(frames, seen), frames.source) if seen else []
        run.log(f"repair of map {submap.id}: {len(seen)} keyframes are matched")
        folder, database = run.folder / "sparse" / str(submap.id), KeptDatabase(run, f"matching {submap.id}")
        with Stages(f"repair of map {submap.id}") as told_of:
            make = partial(_Repaired.of, submap, images, folder, config, told_of, database)
            new, repair = kept(run, f"repair {submap.id}", _Repaired, make, folder=folder).both
        worse = repair.left or len(new.keyframes) < len(seen)
        (run.warn if worse else run.log)(f"repair: {repair}")
        submaps.append(with_provenance(new, submap.keyframes[0].camera.provenance))
        told.append(repair)
    if submaps[0].keyframes[0].camera.provenance is not None:
        write_camera(submaps[0].keyframes[0].camera, run.folder / "camera.json")
    run.record["repair"] = plain(told)
    return replace(sparse_map, submaps=tuple(submaps))


@dataclass(frozen=True)
class _Repaired:
    """A submap that was made anew, and what that changed."""

    submap: Submap
    repair: Repair

    @classmethod
    def of(
        cls,
        submap: Submap,
        images: Sequence[Frame],
        folder: Path,
        config: SfmConfig,
        progress: Progress,
        database: KeptDatabase,
    ) -> _Repaired:
        return cls(*repaired_submap(submap, images, folder, config, progress, database))

    @property
    def both(self) -> tuple[Submap, Repair]:
        return self.submap, self.repair


def doubts_of_inputs(run: Run, sparse_map: SparseMap, frames: FrameSequence) -> tuple[str, ...]:
    """Sentences on map and frames with which no verdict is green: frames that may not be the map's, a camera whose
    focal length nobody knows well, and light that was not white and steady, which is looked at here, said and
    recorded."""
    cameras = _uncertain_cameras(sparse_map)
    for known in cameras:
        run.warn_once(known.doubt)
    run.log("colours of the keyframes are checked")
    row_of = {number: row for row, number in enumerate(frames.numbers)}
    keyframes = [row_of[k.number] for s in sparse_map.submaps for k in s.keyframes if k.number in row_of]
    colours = colours_of(frames, keyframes)
    for doubt in colours.doubts:
        run.warn(doubt)
    run.record["colour"] = colours.record()
    pairing = run.record.get("pairing") or {}
    doubtful = pairing.get("judgement") in ("doubtful", "wrong")
    return (*([pairing["sentence"]] if doubtful else []), *(known.in_short for known in cameras), *colours.doubts)


def _uncertain_cameras(sparse_map: SparseMap) -> list[Provenance]:
    """Of the cameras that surfaces are made with, those with a doubt."""
    found = (k.camera.provenance for submap in sparse_map.submaps for k in submap.keyframes)
    return [known for known in dict.fromkeys(found) if known is not None and known.doubt]


@dataclass(frozen=True)
class _ImagesOf:
    """Loads the images of keyframes, under the map's camera."""

    frames: FrameSequence
    keyframes: Sequence[Keyframe]

    def __call__(self, i: int) -> Frame:
        return self.frames.of_keyframe(self.keyframes[i])


def fitted_light(
    run: Run, frames: FrameSequence, sparse_map: SparseMap, model: DepthModel, config: MethodConfig, wanted: bool
) -> FrameSequence:
    """The frames under the light that the map tells, where nobody gave theirs and what the model delivers with it, by
    these settings, is better.

    They stay as they are where no fit is wanted, and for the constant model, which looks at no light."""
    if not wanted or isinstance(model, ConstantModel):
        return frames
    light = fit_assumed_light(run, frames, sparse_map, model, Placing(config))
    return frames if light is None else with_light(frames, light)


def fitted_to_frames(sparse_map: SparseMap, width: int, height: int, camera: CameraModel | None = None) -> SparseMap:
    """The map with cameras and keypoints at the size of the frames, which a SLAM often halves; `camera` replaces the
    map's own. Raises InputError when sizes differ by more than a rescaling."""

    def fitted(keyframe: Keyframe) -> Keyframe:
        own = keyframe.camera
        sx, sy = width / own.width, height / own.height
        if abs(sx / sy - 1) > 0.01:
            check_image_size(f"{sparse_map.source}: keyframe {keyframe.name}", width, height, own)
        resized = own if (sx, sy) == (1, 1) else own.resized(width, height)
        return replace(keyframe, camera=camera or resized, pixels=keyframe.pixels * (sx, sy))

    submaps = (replace(s, keyframes=tuple(map(fitted, s.keyframes))) for s in sparse_map.submaps)
    return replace(sparse_map, submaps=tuple(submaps))
