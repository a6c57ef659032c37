"""write_scared: frames as SCARED ships a keyframe folder, for tests and for tools that read nothing else."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lightdepth.camera import Brown, Pinhole
from lightdepth.datasets.scared_files import IMAGES, VIDEO
from lightdepth.errors import InputError
from lightdepth.files.images import to_bgr8, write_image
from lightdepth.frame import Frame


def write_scared(frames: Sequence[Frame], path: Path, archives: bool = True, metres: bool = False) -> None:
    """A keyframe folder as it is shipped, the first frame its keyframe, of frames of one pinhole or Brown camera.

    `archives` False leaves frame_data/ and scene_points/ extracted; `metres` writes the poses so. No right view was
    rendered: the left is shown in its place, without points. The video is compressed (H.264), so colours are not exact.
    """
    if not len(frames):
        raise InputError(path, "no frames to write", "expected at least one")
    camera = frames[0].camera
    if type(camera) not in (Pinhole, Brown) or camera.width % 2 or camera.height % 2:
        raise InputError(
            path, f"{camera.name} {camera.width}x{camera.height}", "expected a PINHOLE or OPENCV, even sizes"
        )
    fx, fy, cx, cy, *distortion = camera.with_pixel_center(1.0).params
    matrix = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    lens, stereo = [*(distortion or [0.0] * 4), 0.0], {"R": np.eye(3).tolist(), "T": [-4.2, 0.0, 0.0]}
    data = path / "data"
    data.mkdir(parents=True)
    _write_video(frames, path / VIDEO)
    records, points = {}, {}
    for i, frame in enumerate(frames):
        if frame.true_world_from_cam is not None:
            pose = np.linalg.inv(frame.true_world_from_cam)
            pose[:3, 3] *= 0.001 if metres else 1
            record = {"KL": matrix, "DL": lens, "KR": matrix, "DR": lens, **stereo}
            text = json.dumps({"camera-calibration": record, "camera-pose": pose.tolist()})
            records[f"frame_data{i:06d}.json"] = text.encode()
        if frame.true_distance is not None:
            xyz = _points(frame)
            both = np.concatenate([xyz, np.full_like(xyz, np.nan)])
            points[f"scene_points{i:06d}.tiff"] = _tiff(both)
    for name, members in (("frame_data", records), ("scene_points", points)):
        if members and archives:
            _write_archive(members, data / f"{name}.tar.gz")
        elif members:
            (data / name).mkdir()
            for member, blob in members.items():
                (data / name / member).write_bytes(blob)
    for image in IMAGES.values():
        write_image(path / image, to_bgr8(frames[0].image))
    if frames[0].true_distance is not None:
        xyz = _points(frames[0])
        (path / "left_depth_map.tiff").write_bytes(_tiff(np.where(xyz[..., 2:] > 0, xyz, np.nan).astype(np.float32)))
    store = cv2.FileStorage(str(path / "endoscope_calibration.yaml"), cv2.FILE_STORAGE_WRITE)
    for side in "12":
        store.write(f"M{side}", np.array(matrix))
        store.write(f"D{side}", np.array([lens]))
    store.write("R", np.eye(3))
    store.write("T", np.array([stereo["T"]]).T)
    store.release()


def _points(frame: Frame) -> np.ndarray:
    """(H, W, 3) float32 X Y Z in the camera, zero where unknown."""
    assert frame.true_distance is not None
    return (frame.camera.rays()[0] * np.where(frame.valid, frame.true_distance, 0)[..., None]).astype(np.float32)


def _tiff(points: np.ndarray) -> bytes:
    return cv2.imencode(".tiff", np.ascontiguousarray(points[..., ::-1]))[1].tobytes()


def _write_archive(members: dict[str, bytes], path: Path) -> None:
    with tarfile.open(path, "w:gz") as tar:
        for name, blob in members.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(blob)
            tar.addfile(entry, io.BytesIO(blob))


def _write_video(frames: Sequence[Frame], path: Path) -> None:
    import av

    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=Fraction(25), options={"crf": "4", "g": "5"})
        height, width = frames[0].image.shape[:2]
        stream.width, stream.height, stream.pix_fmt = width, 2 * height, "yuv420p"
        for frame in frames:
            rgb = np.ascontiguousarray(to_bgr8(frame.image)[..., ::-1])
            both = av.VideoFrame.from_ndarray(np.concatenate([rgb, rgb]), format="rgb24")
            container.mux(stream.encode(both))
        container.mux(stream.encode())
