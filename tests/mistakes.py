"""Data that are read without a word, and the ways in which a mistake is made in a copy of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from colons import CAMERA, EXACT, colon, slam

from lightdepth.calibration import read_camera, read_light, write_camera, write_light
from lightdepth.camera import KannalaBrandt
from lightdepth.datasets import open_sequence, write_c3vd, write_endomapper, write_folder, write_hamlyn, write_simcol
from lightdepth.datasets.splits import folders, read_split
from lightdepth.files.tum import write_tum
from lightdepth.maps import read_map, write_multimap, write_text_model
from lightdepth.photometry import PhotometricCalibration
from lightdepth.tube import lens

FISHEYE = KannalaBrandt(96, 80, 50.0, 50.0, 48.0, 40.0, -0.1, 0.0, 0.0, 0.0)
KINDS = ("frames", "c3vd", "simcol", "hamlyn", "endomapper", "colmap", "multimap", "tum", "camera", "light", "split")


@dataclass(frozen=True)
class Mistake:
    """What the user did; on which data; how; through which entrance; the words that the message must hold."""

    did: str
    data: str
    make: Callable[[Path], Any]
    words: tuple[str, ...]
    refused: bool = True


MISTAKES: list[Mistake] = []


def mistake(did: str, data: str, *words: str, refused: bool = True):
    """Adds a row: the function makes the mistake in a copy of the data, and may return what to open in its place."""

    def add(make: Callable[[Path], Any]) -> Callable[[Path], Any]:
        MISTAKES.append(Mistake(did, data, make, words, refused))
        return make

    return add


# ---- data without mistakes


def made(folder: Path) -> None:
    """One of each kind, in folder."""
    frames = colon(0, 3, 6.0).frames
    write_folder(frames, folder / "frames")
    write_c3vd(colon(0, 3, 6.0, lens("c3vd", 100, 80)).frames, folder / "c3vd")
    write_simcol(frames, folder / "simcol" / "Frames_S1")
    write_hamlyn(frames, folder / "hamlyn")
    counted = [replace(f, name=f"out{f.number + 1}") for f in colon(0, 3, 6.0, FISHEYE).frames]
    write_endomapper(counted, folder / "endomapper")
    export = slam(frames, config=EXACT).map
    write_text_model(export.submaps[0], folder / "colmap")
    write_multimap(export, folder / "multimap")
    write_text_model(export.submaps[0], folder / "tum")
    (folder / "tum" / "images.txt").unlink()
    keyframes = export.submaps[0].keyframes
    write_tum(
        folder / "tum" / "KeyFrameTrajectory.txt",
        [k.number for k in keyframes],
        [np.linalg.inv(k.cam_from_map) for k in keyframes],
    )
    (folder / "camera").mkdir()
    write_camera(CAMERA, folder / "camera" / "camera.json")
    write_camera(CAMERA, folder / "camera" / "camera.yaml")
    write_camera(FISHEYE, folder / "camera" / "Endoscope_01_geometrical.xml")
    (folder / "light").mkdir()
    write_light(PhotometricCalibration(), folder / "light" / "light.json")
    write_light(PhotometricCalibration(position_mm=(0, -1.1, -3.6)), folder / "light" / "light.xml")
    (folder / "split" / "root" / "a").mkdir(parents=True)
    (folder / "split" / "root" / "b").mkdir()
    (folder / "split" / "split.yaml").write_text("parts:\n  train: [a]\n  test: [b]\n")


def opened(kind: str, path: Path) -> object:
    """What a user does with data of this kind, or with the file or the call that a mistake put in its place."""
    if kind in ("frames", "c3vd", "hamlyn", "endomapper"):
        return list(open_sequence(path))
    if kind == "simcol":
        return list(open_sequence(path / "Frames_S1"))
    if kind in ("colmap", "multimap", "tum"):
        return read_map(path)
    if kind == "camera":
        return [read_camera(file) for file in sorted(path.iterdir())]
    if kind == "light":
        return [read_light(file) for file in sorted(path.iterdir())]
    return folders(read_split(path / "split.yaml"), path / "root", ("train", "test"))


# ---- how mistakes are made


def edit_text(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text, (file, old)
    file.write_text(text.replace(old, new))


def edit_json(file: Path, **changes: object) -> None:
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))


def edit_lines(file: Path, change: Callable[[list[str]], list[str]]) -> None:
    lines = [line for line in file.read_text().splitlines() if not line.startswith("#")]
    file.write_text("\n".join(change(lines)) + "\n")


def edit_poses(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    file = path / "truth" / "poses.tum"
    np.savetxt(file, change(np.loadtxt(file)), fmt="%.9f")


def edit_times(path: Path, times: list[float]) -> None:
    """Other times in a trajectory, of a video of 30 frames a second."""
    (path / "densify_map.json").write_text('{"fps": 30}')

    def change(lines):
        return [" ".join([f"{time:.6f}", *line.split()[1:]]) for time, line in zip(times, lines, strict=True)]

    edit_lines(path / "KeyFrameTrajectory.txt", change)


def edit_images(
    path: Path,
    pose: Callable[[list[str]], list[str]] = lambda words: words,
    keypoints: Callable[[np.ndarray], np.ndarray] = lambda xy: xy,
) -> None:
    """images.txt of a COLMAP model with other poses (words of a line) or keypoints (n, 2)."""

    def change(lines):
        out = []
        for i, line in enumerate(lines):
            if i % 2 == 0:
                out.append(" ".join(pose(line.split())))
            else:
                rows = np.array(line.split(), float).reshape(-1, 3)
                rows[:, :2] = keypoints(rows[:, :2])
                out.append(" ".join(f"{x:.9f} {y:.9f} {point:.0f}" for x, y, point in rows))
        return out

    edit_lines(path / "images.txt", change)


def rewrite_images(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    for file in (path / "frames").iterdir():
        cv2.imwrite(str(file), change(cv2.imread(str(file))))
    (path / "mask.png").unlink()
