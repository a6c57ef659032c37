"""COLMAP models: cameras, images and points3D, as .txt or .bin.

Written for what is found in the wild: with and without the rigs and frames files of COLMAP 3.12 and later (the poses in
the images file are complete without them), ids from 0, points without tracks, points without colour or error. What a
keyframe observed is taken from the images file alone. Pixels and poses are COLMAP's unless a `MapConvention` says
otherwise.

Formats: COLMAP documentation, "Output format".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lightdepth.errors import InputError
from lightdepth.files.colmap_cameras import BinaryFile, read_cameras_binary, read_cameras_text
from lightdepth.files.rotations import pose_from_quaternion, quaternion_from_pose
from lightdepth.files.text import is_comment, numbered_lines, parse_integer, parse_numbers, text_lines
from lightdepth.maps.checks import checked
from lightdepth.maps.convention import COLMAP, MapConvention
from lightdepth.maps.sensors import of_one_sensor
from lightdepth.sparse_map import Keyframe, PointColors, Submap, at_its_place, near_origin

PARTS = ("cameras", "images", "points3D")

_NO_POINT = 2**63  # COLMAP's invalid id is 2^64 - 1; text says -1


@dataclass(frozen=True)
class ModelImage:
    """One image as the file has it: pose (4, 4), and the keypoints (n, 2) that belong to a point, with its id (n,)."""

    name: str
    camera_id: int
    pose: np.ndarray
    pixels: np.ndarray
    point_ids: np.ndarray


def holds_model(folder: Path) -> bool:
    """Whether any of a model's files lies in the folder."""
    return any((folder / f"{part}{suffix}").is_file() for part in PARTS for suffix in (".txt", ".bin"))


def read_submap(folder: Path, map_id: int, convention: MapConvention = COLMAP) -> Submap:
    """One model folder -> submap, keyframes by frame number and points by id.

    Raises InputError, naming file and line, for whatever cannot be read or does not fit together.
    """
    suffix = _suffix(folder)
    paths = {part: folder / f"{part}{suffix}" for part in PARTS}
    if suffix == ".bin":
        cameras, images = read_cameras_binary(paths["cameras"]), _read_images_binary(paths["images"])
        ids, points, colors = _read_points_binary(paths["points3D"])
    else:
        cameras, images = read_cameras_text(paths["cameras"]), _read_images_text(paths["images"])
        ids, points = read_points_text(paths["points3D"])
        colors = read_colors_text(paths["points3D"])
    if not images:
        raise InputError(f"{paths['images']}", "no images in it", "an empty map cannot be densified, leave it out")
    keyframes = []
    for image in of_one_sensor(images, convention, folder):
        if image.camera_id not in cameras:
            raise InputError(
                f"{paths['images']}",
                f"image {image.name} has camera {image.camera_id}",
                f"expected one of {paths['cameras'].name}, which has {', '.join(map(str, cameras)) or 'none'}",
            )
        keyframes.append(
            convention.keyframe(image.name, cameras[image.camera_id], image.pose, image.pixels, image.point_ids)
        )
    return replace(assembled(folder, map_id, keyframes, ids, points), colors=colors)


def assembled(
    folder: Path,
    map_id: int,
    keyframes: list[Keyframe],
    ids: np.ndarray,
    points: np.ndarray,
    check: Callable[[Submap, Path], Submap] = checked,
) -> Submap:
    """The checked submap of keyframes, point ids (n,) and points (n, 3); every error names the folder."""
    if not len(points):
        raise InputError(folder, "no points in points3D", "an empty map cannot be densified, leave it out")
    order = np.argsort(ids, kind="stable")
    ids, points = ids[order], points[order]
    twice = ids[1:][ids[1:] == ids[:-1]]
    if len(twice):
        raise InputError(folder, f"point {twice[0]} is in points3D twice", "every point needs its own id")
    try:
        submap = near_origin(Submap(map_id, tuple(sorted(keyframes, key=lambda k: k.number)), ids, points))
    except InputError as error:
        raise error.within(folder) from error
    return check(submap, folder)


def _suffix(folder: Path) -> str:
    """Which of the two forms to read: binary where it is complete, as COLMAP does."""
    missing = {s: [f"{p}{s}" for p in PARTS if not (folder / f"{p}{s}").is_file()] for s in (".bin", ".txt")}
    for suffix, absent in missing.items():
        if not absent:
            return suffix
    absent = min(missing.values(), key=len)
    raise InputError(
        folder, f"{' and '.join(absent)} missing", "a model is cameras, images and points3D, all .txt or all .bin"
    )


# ---- text


def _read_images_text(path: Path) -> list[ModelImage]:
    expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
    images = []
    lines = iter(enumerate(text_lines(path), 1))
    for number, line in lines:
        if is_comment(line):
            continue
        where, tokens = f"{path}, line {number}", line.split(None, 9)
        if len(tokens) < 10:
            raise InputError(where, f"found {line.strip()[:60]!r}", f"expected {expected}, then a line of keypoints")
        parse_integer(tokens[0], where, expected)
        camera_id, name = parse_integer(tokens[8], where, expected), tokens[9].strip()
        numbers = parse_numbers(tokens[1:8], where, expected)
        pose = pose_from_quaternion(numbers[:4], numbers[4:], f"{where}: image {name}")
        number, line = next(lines, (number + 1, ""))  # the second line may be empty, but belongs to the image
        where, triples = f"{path}, line {number}", "X Y POINT3D_ID, repeated"
        keypoints = parse_numbers(line.split(), where, f"{triples} (the keypoints of {name})")
        if len(keypoints) % 3:
            raise InputError(
                where, f"{len(keypoints)} numbers", f"expected {triples}: the keypoints of {name}, or an empty line"
            )
        keypoints = keypoints.reshape(-1, 3)
        keypoints = keypoints[(keypoints[:, 2] >= 0) & (keypoints[:, 2] < _NO_POINT)]
        if not np.isfinite(keypoints).all():
            raise InputError(where, f"NaN or infinite keypoints of {name}", "expected pixels")
        images.append(ModelImage(name, camera_id, pose, keypoints[:, :2].copy(), keypoints[:, 2].astype(np.int64)))
    return images


def read_points_text(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Point ids (n,) and points (n, 3). Colour, error and track may be missing; error and track are not used."""
    expected = "POINT3D_ID X Y Z [R G B ERROR TRACK...]"
    entries = [(number, line.split(None, 4)[:4]) for number, line in numbered_lines(path)]
    try:
        ids = np.array([tokens[0] for _, tokens in entries], dtype=np.int64)
        points = np.array([tokens[1:] for _, tokens in entries], dtype=np.float64).reshape(-1, 3)
    except (ValueError, OverflowError):
        for number, tokens in entries:
            where = f"{path}, line {number}"
            if len(tokens) < 4:
                raise InputError(where, f"found {' '.join(tokens)!r}", f"expected {expected}") from None
            parse_integer(tokens[0], where, expected)
            parse_numbers(tokens[1:], where, expected)
        raise
    bad = np.flatnonzero(~np.isfinite(points).all(1))
    if len(bad):
        raise InputError(
            f"{path}, line {entries[bad[0]][0]}",
            f"point {ids[bad[0]]} is not finite ({len(bad)} such)",
            "expected finite X Y Z",
        )
    return ids, points


def read_colors_text(path: Path) -> PointColors | None:
    """Colours of the points, for a file that `read_points_text` has read; None where not every point has one."""
    entries = [line.split(None, 7)[:7] for _, line in numbered_lines(path)]
    try:
        ids = np.array([tokens[0] for tokens in entries], dtype=np.int64)
        values = np.array([tokens[4:7] for tokens in entries], dtype=np.float64)
    except ValueError:  # a point without a colour, or with something else in its place
        return None
    return _colors(ids, values)


def _colors(ids: np.ndarray, values: np.ndarray) -> PointColors | None:
    """None where colours (n, 3), 0 to 255, are none, or all the same, as programs write that know none."""
    known = values.ndim == 2 and values.size and values.min() >= 0 and values.max() <= 255 and np.ptp(values, 0).any()
    return PointColors(ids, values / 255) if known else None


# ---- binary


def _read_images_binary(path: Path) -> list[ModelImage]:
    keypoint = np.dtype([("xy", "<f8", 2), ("id", "<u8")])
    data, images = BinaryFile(path), []
    for _ in range(data.take("Q")[0]):
        numbers = data.take("I7dI")
        name = data.text()
        pose = pose_from_quaternion(np.array(numbers[1:5]), np.array(numbers[5:8]), f"{path}: image {name}")
        found = data.array(keypoint, data.take("Q")[0])
        found = found[found["id"] < _NO_POINT]
        if not np.isfinite(found["xy"]).all():
            raise InputError(path, f"NaN or infinite keypoints of {name}", "expected pixels")
        images.append(ModelImage(name, numbers[8], pose, found["xy"].copy(), found["id"].astype(np.int64)))
    data.end()
    return images


def _read_points_binary(path: Path) -> tuple[np.ndarray, np.ndarray, PointColors | None]:
    data, ids, points, colors = BinaryFile(path), [], [], []
    for _ in range(data.take("Q")[0]):
        point_id, *xyz = data.take("Q3d")
        colors.append(data.take("3Bd")[:3])
        data.array(np.dtype("<u4"), 2 * data.take("Q")[0])
        ids.append(point_id)
        points.append(xyz)
    data.end()
    if ids and max(ids) >= _NO_POINT:
        raise InputError(path, f"point id {max(ids)}", "expected ids below 2^63")
    known = np.array(ids, np.int64)
    found = _colors(known, np.array(colors, np.float64).reshape(-1, 3))
    return known, np.array(points, np.float64).reshape(-1, 3), found


# ---- writing


def write_text_model(
    submap: Submap,
    folder: Path,
    images: Mapping[str, np.ndarray] | None = None,
    colors: np.ndarray | None = None,
) -> None:
    """A submap as a COLMAP text model with proper tracks, exact to the last bit; `folder` is made.

    `images` by keyframe name, (H, W, 3) RGB in [0, 1], give the points their colour, or `colors` (n, 3) uint8 do;
    without them points are grey.
    SCARAMUZZA is written under its own name, which `read_map` reads and COLMAP does not know.
    """
    folder, submap = Path(folder), at_its_place(submap)
    folder.mkdir(parents=True, exist_ok=True)
    cameras = list(dict.fromkeys(k.camera for k in submap.keyframes))
    camera_lines = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"]
    for camera_id, camera in enumerate(cameras, 1):
        numbers = " ".join(repr(float(p)) for p in camera.params)
        camera_lines.append(f"{camera_id} {camera.name} {camera.width} {camera.height} {numbers}")
    (folder / "cameras.txt").write_text("\n".join(camera_lines) + "\n", encoding="utf-8", errors="surrogateescape")

    row = {int(i): r for r, i in enumerate(submap.point_ids.tolist())}
    errors, looks = _looks(submap, row, images or {})
    colors = looks if colors is None else colors
    tracks: list[list[tuple[int, int]]] = [[] for _ in row]
    image_lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", "# X Y POINT3D_ID ..."]
    for image_id, keyframe in enumerate(submap.keyframes, 1):
        quaternion, translation = quaternion_from_pose(keyframe.cam_from_map), keyframe.cam_from_map[:3, 3]
        pose = " ".join(repr(float(v)) for v in (*quaternion, *translation))
        image_lines.append(f"{image_id} {pose} {cameras.index(keyframe.camera) + 1} {keyframe.name}")
        words = []
        for index, ((u, v), point_id) in enumerate(
            zip(keyframe.pixels.tolist(), keyframe.point_ids.tolist(), strict=True)
        ):
            words.append(f"{u!r} {v!r} {point_id if point_id in row else -1}")
            if point_id in row:
                tracks[row[point_id]].append((image_id, index))
        image_lines.append(" ".join(words))
    (folder / "images.txt").write_text("\n".join(image_lines) + "\n", encoding="utf-8", errors="surrogateescape")

    point_lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX"]
    for point_id, r in row.items():
        xyz = " ".join(repr(float(v)) for v in submap.points[r])
        color = " ".join(str(int(c)) for c in colors[r])
        track = " ".join(f"{i} {k}" for i, k in tracks[r])
        point_lines.append(f"{point_id} {xyz} {color} {float(errors[r])!r} {track}".rstrip())
    (folder / "points3D.txt").write_text("\n".join(point_lines) + "\n", encoding="utf-8", errors="surrogateescape")


def _looks(submap: Submap, row: dict[int, int], images: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Each point's mean reprojection error [px] (n,), and colour (n, 3) in 0..255, over the keyframes that saw it."""
    errors, sightings = np.zeros(len(row)), np.zeros(len(row))
    colors, colored = np.zeros((len(row), 3)), np.zeros(len(row))
    for keyframe in submap.keyframes:
        ids, points, pixels = submap.observed_points(keyframe)
        rows = np.array([row[i] for i in ids.tolist()], dtype=int)
        projected = keyframe.camera.project(keyframe.in_camera(points))[0]
        errors[rows] += np.linalg.norm(projected - pixels, axis=1)
        sightings[rows] += 1
        image = images.get(keyframe.name)
        if image is not None:
            height, width = image.shape[:2]
            u, v = (np.clip(pixels[:, k].astype(int), 0, n - 1) for k, n in enumerate((width, height)))
            colors[rows] += image[v, u]
            colored[rows] += 1
    mean = np.where(colored[:, None] > 0, colors / np.maximum(colored, 1)[:, None], 0.5)
    return errors / np.maximum(sightings, 1), np.rint(255 * np.clip(mean, 0, 1)).astype(int)
