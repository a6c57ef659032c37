"""What a sequence knows of the world that it shows, to judge by: true poses, and the wall where there is true depth."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from densify.dense_map import Surface
from densify.evaluation.errors import CUBE_MM, TrueSurface, depth_triangles, true_cloud
from densify.evaluation.smoothness import edges
from densify.evaluation.trajectory import span
from lightdepth.datasets import FrameSequence
from lightdepth.datasets.c3vd_surface import COVERAGE_MESH
from lightdepth.datasets.checks import unusable_truth
from lightdepth.errors import InputError
from lightdepth.files.meshes import read_mesh
from lightdepth.frame import Frame

_MESH_FRAMES, _MESH_TRIANGLES = 50, 2_000_000


@dataclass(frozen=True, eq=False)
class Truth:
    """What a sequence knows: true poses (4, 4) [mm] by frame number, all its frames' numbers, seconds between frames,
    and the wall, or why there is none."""

    source: str
    poses: Mapping[int, np.ndarray]
    numbers: Sequence[int]
    period: float | None
    surface: TrueSurface | None
    no_surface: str = ""


def check_truth(frames: FrameSequence, trusted: bool = False) -> None:
    """Raises InputError where the truth contradicts its own poses or cannot be in millimetres, unless it is trusted:
    nothing can be judged by it. What is wrong was warned of when the frames were opened."""
    wrong = [] if trusted else unusable_truth(frames)
    if wrong:
        raise InputError(
            frames.source,
            f"nothing can be judged by its truth: {'; '.join(wrong)}",
            "correct it, or give --trust-truth to judge by it all the same",
        )


def read_truth(frames: FrameSequence, mesh: Path | None = None, with_surface: bool = True) -> Truth:
    """Poses of every frame and, where there is true depth, the wall. Frames are read once, one at a time.

    The true mesh is the one given; else C3VD's own, beside its frames; else the triangulated true depth of some frames.
    A frame that cannot be read is left out with a warning. Raises InputError when no frame has a pose.
    """
    unread: list[InputError] = []
    poses: dict[int, np.ndarray] = {}
    times: list[float] = []
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    order = np.argsort(frames.numbers, kind="stable")
    if mesh is None and (Path(frames.source) / COVERAGE_MESH).is_file():
        mesh = Path(frames.source) / COVERAGE_MESH
    chosen = set() if mesh else set(order[:: -(-len(order) // _MESH_FRAMES)].tolist())
    any_depth = False

    def watched() -> Iterator[Frame]:
        nonlocal any_depth
        for i in order.tolist():
            try:
                frame = frames[i]
            except InputError as error:
                unread.append(error)
                continue
            if frame.true_world_from_cam is not None:
                poses[frame.number] = frame.true_world_from_cam
            if frame.time is not None:
                times.append(frame.time)
            any_depth |= frame.true_distance is not None and frame.true_world_from_cam is not None
            if with_surface:
                if i in chosen:
                    step = np.sqrt(2 * len(chosen) * frame.camera.width * frame.camera.height / _MESH_TRIANGLES)
                    parts.append(depth_triangles(frame, max(1, int(np.ceil(step)))))
                yield frame

    cloud = None
    try:
        cloud = true_cloud(watched())
    except InputError:
        if any_depth and with_surface:
            raise
    if len(unread) == len(frames):
        raise unread[0]
    if unread:
        found = f"{len(unread)} of {len(frames)} frames cannot be read and are no part of the truth ({unread[0]})"
        warnings.warn(f"{frames.source}: {found}", stacklevel=2)
    if not poses:
        raise InputError(frames.source, "no frame has a true pose", "give them: a trajectory or a surface needs them")
    period = float(np.median(np.diff(times))) if len(times) > 1 else None
    common = (frames.source, poses, sorted(frames.numbers), period)
    if cloud is None:
        return Truth(*common, None, "the sequence has true poses but no true depth" if with_surface else "")
    sampling = (
        f"{len(cloud)} points: every second pixel of {len(frames) - len(unread)} frames unprojected at true poses, one "
        f"point kept in each cube of {CUBE_MM:g} mm"
    )
    if mesh is not None:
        vertices, triangles = read_mesh(mesh)
        source = f"{mesh.name}, {len(triangles)} triangles"
    else:
        counts = np.cumsum([0, *(len(v) for v, _ in parts)])
        vertices = np.concatenate([v for v, _ in parts])
        triangles = np.concatenate([t + n for (_, t), n in zip(parts, counts, strict=False)])
        source = f"true depth of {len(parts)} frames triangulated, {len(triangles)} triangles"
    surface = Surface(vertices, triangles) if len(triangles) else None
    turns = edges(vertices, triangles)
    if mesh is not None and surface is not None:
        off = float(np.median(surface.distance(cloud[:: max(1, len(cloud) // 5000)])))
        if off > 2:
            raise InputError(
                mesh,
                f"the true depth is {off:.3g} mm from it (median)",
                "expected the surface that the sequence shows, in mm, in the frame of reference of its poses",
            )
    return Truth(*common, TrueSurface(cloud, sampling, surface, source, turns))


def shared_frames(ours: Collection[int], theirs: Sequence[int], what: str, source: str, common: bool) -> list[int]:
    """Frame numbers of both, in order. Raises InputError, saying which match, when there is none, or when ours has
    others too and they are not to be left out (`common`)."""
    mine, known = sorted(ours), set(theirs)
    both = [n for n in mine if n in known]
    if not both:
        raise InputError(
            source,
            f"none of its frames is among the {what}: it has {span(theirs)}, they are for {span(mine)}",
            "do both count from the same frame? (frame_offset in densify_map.json shifts a map's)",
        )
    if len(both) < len(mine) and not common:
        alone = [n for n in mine if n not in known]
        raise InputError(
            source,
            f"it has {span(theirs)}, the {what} are for {span(mine)}: {len(both)} match ({span(both)}), {len(alone)} "
            f"do not ({_listed(alone)})",
            "give the truth of the same frames, or --common to judge those that match",
        )
    return both


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers[:5])) + (f" and {len(numbers) - 5} more" if len(numbers) > 5 else "")
