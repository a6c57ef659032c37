"""Trajectories in parts, as a SLAM with many maps leaves them: their files, and their errors against true poses.

Each submap has a frame of reference and a scale of its own. "Sim(3)" aligns it with its own scale, "SE(3)" keeps the
scale of the map, which is only possible where it is known in millimetres. ATE is over camera centres, RMS, in mm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from densify.evaluation.errors import ate, rms, sideways_agreement
from densify.evaluation.records import AlignedFigures, TrajectoryFigures
from densify.similarity import Similarity, fit_similarity
from lightdepth.errors import InputError
from lightdepth.files.reading import reading
from lightdepth.files.tum import read_tum
from lightdepth.frame import frame_number
from lightdepth.maps import read_trajectory
from lightdepth.maps.convention import EXPORTER, Reader
from lightdepth.maps.endocartoscope import MAPS, TRAJECTORIES, TRAJECTORY_FILE
from lightdepth.maps.stella import declared_rate
from lightdepth.maps.tum import begun, is_trajectory
from lightdepth.sparse_map import Submap

CLIMB_POSES = 100
"""CLiMB's evaluation counts a submap from this many poses on, each with as much weight as it has poses."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One submap's poses: frame numbers (n,), ascending, camera centres (n, 3) in map units, and which are keyframes
    (n,) bool. `whole` is whether every localised frame is there, and not the keyframes alone."""

    id: int
    numbers: np.ndarray
    centers: np.ndarray
    keyframe: np.ndarray
    whole: bool

    def __post_init__(self) -> None:
        step = np.diff(self.numbers)
        if not (step > 0).all():
            assert (step >= 0).all(), "numbers must ascend"
            raise InputError(
                f"map {self.id}",
                f"frame {self.numbers[1:][step == 0][0]} is in its trajectory twice",
                "expected one pose a frame",
            )


def in_order(
    map_id: int,
    numbers: Sequence[int],
    centers: np.ndarray,
    keyframe: Sequence[bool] | None = None,
    whole: bool = False,
) -> Trajectory:
    """The trajectory with its poses by frame number; all are keyframes where nothing else is said."""
    order = np.argsort(numbers, kind="stable")
    marked = np.ones(len(order), bool) if keyframe is None else np.asarray(keyframe, bool)
    return Trajectory(map_id, np.asarray(numbers, int)[order], np.asarray(centers, float)[order], marked[order], whole)


def keyframe_trajectory(submap: Submap) -> Trajectory:
    """Where the keyframes of a sparse map were."""
    centers = np.stack([k.center for k in submap.keyframes])
    return in_order(submap.id, [k.number for k in submap.keyframes], centers)


def trajectory_files(path: Path) -> list[Path]:
    """The trajectories at a path: one file (TUM, or CLiMB's cam_traj_map), or a folder of cam_traj_map files or one
    that has such a folder; empty where there are none."""
    if path.is_file():
        return [path] if TRAJECTORY_FILE.fullmatch(path.name) or is_trajectory(path) else []
    if not path.is_dir():
        return []
    for folder in (path, path / TRAJECTORIES):
        files = sorted(p for p in folder.glob("*.txt") if TRAJECTORY_FILE.fullmatch(p.name))
        if files:
            return files
    return []


def read_trajectories(path: Path, reader: Reader = Reader()) -> list[Trajectory]:
    """What `trajectory_files` finds, as trajectories by map id. A TUM file is one map; its times are frame numbers, or
    seconds where the frames' own stamps, a densify_map.json or a stella_vslam map beside it, or the user, tell how to
    count them. Raises InputError when there is none."""
    files = trajectory_files(path)
    if not files:
        raise InputError(
            path, "no trajectory", "expected a TUM file (t tx ty tz qx qy qz qw) or CLiMB's cam_traj_map_*.txt"
        )
    found = []
    for file in files:
        with reading(file, "a trajectory"):
            found.append(_read(file, reader))
    return found


def _read(file: Path, reader: Reader) -> Trajectory:
    match = TRAJECTORY_FILE.fullmatch(file.name)
    map_id = int(match[1]) if match else 0
    tree: Path = file.parent
    roots: tuple[Path, ...] = ()
    if match:  # what is declared for the map holds for its trajectory
        maps = file.parent.parent / MAPS
        tree = next((p for p in maps.glob("*") if p.name.isdecimal() and int(p.name) == map_id), file.parent)
        roots = (maps, maps.parent)
    convention = reader.convention(tree, map_id, EXPORTER, roots)
    if match:
        poses = read_trajectory(file)
        numbers = [frame_number(p.name) + convention.frame_offset for p in poses]
        centers = [-p.cam_from_map[:3, :3].T @ p.cam_from_map[:3, 3] for p in poses]
        keyframe = [p.is_keyframe for p in poses]
        whole = not all(keyframe)
    else:
        times, map_from_cam = read_tum(file)
        clock, maps_beside = convention.clock, list(file.parent.glob("*.msg"))
        if clock.fps is None and len(maps_beside) == 1:
            clock = replace(clock, fps=declared_rate(maps_beside[0]))
        names = clock.names(times, file, begun(file.parent))
        numbers = [frame_number(name) + convention.frame_offset for name in names]
        centers = list(map_from_cam[:, :3, 3])
        keyframe, whole = [True] * len(numbers), "keyframe" not in file.name.lower()
    if not numbers:
        raise InputError(file, "no pose in it", "expected at least three")
    return in_order(map_id, numbers, np.stack(centers), keyframe, whole)


@dataclass(frozen=True, eq=False)
class AlignedTrajectory:
    """A submap's poses that have a true one, brought to it: numbers (n,), ATE (n,) [mm] after Sim(3), and after SE(3)
    where the map's scale is known; the error (n - 1,) [mm] of the steps from one to the next (RPE of centres) after
    Sim(3); how far the sideways motion agrees."""

    id: int
    numbers: np.ndarray
    true_from_map: Similarity
    ate_sim3: np.ndarray
    ate_se3: np.ndarray | None
    rpe: np.ndarray
    sideways: float

    def summary(self) -> AlignedFigures:
        return AlignedFigures(
            poses=len(self.numbers),
            rms_ate_mm=rms(self.ate_sim3),
            rms_ate_se3_mm=None if self.ate_se3 is None else rms(self.ate_se3),
            mm_per_unit=self.true_from_map.scale,
            sideways_agreement=self.sideways,
        )


def align_trajectory(
    trajectory: Trajectory, true_poses: Mapping[int, np.ndarray], mm_per_unit: float | None = None
) -> AlignedTrajectory:
    """Against true poses (4, 4) [mm] by frame number. Raises InputError when too few are common, or all on a line."""
    known = np.array([n in true_poses for n in trajectory.numbers.tolist()])
    if not known.any():
        raise InputError(
            "the trajectory",
            f"none of its poses has a true one: truth has {span(list(true_poses))}, the map {span(trajectory.numbers)}",
            "do both count from the same frame?",
        )
    numbers, centers = trajectory.numbers[known], trajectory.centers[known]
    true = np.stack([true_poses[n][:3, 3] for n in numbers.tolist()])
    sim3 = fit_similarity(centers, true)
    rigid = None
    if mm_per_unit is not None:
        rigid = ate(mm_per_unit * centers, true, fit_similarity(mm_per_unit * centers, true, with_scale=False))
    agreement = sideways_agreement(centers, true, sim3)
    steps = np.linalg.norm(np.diff(sim3.apply(centers) - true, axis=0), axis=1)
    return AlignedTrajectory(trajectory.id, numbers, sim3, ate(centers, true, sim3), rigid, steps, agreement)


def trajectory_summary(
    aligned: Sequence[AlignedTrajectory], trajectories: Sequence[Trajectory], numbers: Sequence[int]
) -> TrajectoryFigures:
    """Of all submaps together, out of the sequence's frames by number; how long each took is not known here."""
    located = {n for t in trajectories for n in t.numbers.tolist()} & set(numbers)
    whole = any(t.whole for t in trajectories)
    counted = [a for a in aligned if len(a.numbers) >= CLIMB_POSES]
    poses = [len(a.numbers) for a in counted]
    rigid = [a.ate_se3 for a in aligned if a.ate_se3 is not None]
    return TrajectoryFigures(
        frames=len(numbers),
        frames_localised=len(located) if whole else None,
        localised_share=len(located) / len(numbers) if whole else None,
        localised_of="all frames" if whole else "not known: the trajectory holds keyframes alone",
        keyframes=len({n for t in trajectories for n in t.numbers[t.keyframe].tolist()}),
        submaps=len(trajectories),
        submaps_aligned=len(aligned),
        poses=sum(len(a.numbers) for a in aligned),
        rms_ate_mm=rms(np.concatenate([a.ate_sim3 for a in aligned])),
        rms_ate_se3_mm=rms(np.concatenate(rigid)) if rigid else None,
        rms_rpe_mm=rms(np.concatenate([a.rpe for a in aligned])),
        climb_ate_mm=float(np.average([rms(a.ate_sim3) for a in counted], weights=poses)) if counted else None,
        climb_submaps=len(counted),
        climb_rule=f"mean over submaps of at least {CLIMB_POSES} poses, weighted by their number",
    )


def span(numbers: Sequence[int] | np.ndarray) -> str:
    """Frame numbers for people: "frames 3 to 9", the gaps not shown."""
    values = sorted(int(n) for n in numbers)
    if not values:
        return "none"
    return f"frames {values[0]} to {values[-1]}" if len(values) > 1 else f"frame {values[0]}"
