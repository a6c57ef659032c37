"""What strangers hand in: each parser with small files that it reads, made by the project's own writers.

A parser reads a folder, in which one file is to be spoilt and the others are as they should be. `tests/fuzz.py` spoils.
"""

from __future__ import annotations

import io
import json
import shutil
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import msgpack
import numpy as np
import torch
import trimesh
import yaml
from colons import CAMERA, EXACT, colon, slam
from dicom_files import write_dicom
from foreign_lenses import FORMATS as LENSES
from foreign_lenses import drawn
from parsers import PARSERS, around, parser
from PIL import Image
from safetensors.torch import save
from scipy.io import savemat
from sequences import asked_of_all
from videos import write_video

from densify.batch.manifest import read_manifest
from densify.batch.units import units_of
from densify.bench.record import BenchFile
from densify.dense_map import run_record
from densify.evaluation.depth_files import DepthReading
from densify.scale_file import MapScale, Scales, scale_of
from lightdepth.calibration import read_camera, read_light, write_camera, write_light
from lightdepth.camera import KannalaBrandt, Pinhole, Scaramuzza
from lightdepth.checkpoint import load_model, save_model
from lightdepth.datasets import (
    open_sequence,
    write_c3vd,
    write_endomapper,
    write_endoslam,
    write_folder,
    write_hamlyn,
    write_scared,
    write_simcol,
)
from lightdepth.datasets.dicom import open_dicom
from lightdepth.datasets.sequence import read_mask
from lightdepth.datasets.splits import folders, read_split
from lightdepth.datasets.video import VideoFile
from lightdepth.files.colmap_cameras import read_cameras_binary
from lightdepth.files.exr import write_exr
from lightdepth.files.images import image_size, read_image
from lightdepth.files.meshes import read_cloud, read_mesh
from lightdepth.files.schema import checked_fields, read_json
from lightdepth.files.tum import read_tum, write_tum
from lightdepth.maps import read_map, read_trajectory, write_multimap, write_stella, write_text_model
from lightdepth.network import DepthNetwork, NetworkConfig, build_network
from lightdepth.network.pretrained import read_weights
from lightdepth.photometry import PhotometricCalibration
from lightdepth.prediction import DepthPrediction, read_prediction
from lightdepth.sparse_map import Submap
from lightdepth.tube import lens
from train.frame_lists import read_frame_list

__all__ = ["PARSERS", "text_model"]

FISHEYE = KannalaBrandt(96, 80, 50.0, 50.0, 48.0, 40.0, -0.1, 0.0, 0.0, 0.0)
SCARAMUZZA = Scaramuzza(96, 80, 48.0, 40.0, 50.0, 0.0, -0.004, 1e-6, 0.0, 1.0, 0.0, 0.0)
TINY = Pinhole(32, 24, 20.0, 20.0, 16.0, 12.0)


@cache
def frames() -> tuple[Any, ...]:
    return tuple(colon(0, 3, 6.0, TINY).frames)


@cache
def submap() -> Submap:
    """A map of 40 points, which makes small files."""
    whole = slam(list(colon(0, 3, 6.0).frames), config=EXACT).map.submaps[0]
    kept = whole.point_ids[:: max(1, len(whole.point_ids) // 40)]

    def seen(keyframe: Any) -> Any:
        held = np.isin(keyframe.point_ids, kept)
        return replace(keyframe, pixels=keyframe.pixels[held], point_ids=keyframe.point_ids[held])

    rows = np.isin(whole.point_ids, kept)
    keyframes = tuple(map(seen, whole.keyframes))
    return replace(whole, keyframes=keyframes, point_ids=whole.point_ids[rows], points=whole.points[rows], colors=None)


# ---- calibrations


def camera_used(path: Path, size: tuple[int, int] | None = None) -> object:
    """A camera has to work where it was read: what a file says is checked when it is read, not when it is used."""
    camera = read_camera(path, size)
    with np.errstate(all="ignore"):
        return camera.project(np.eye(3)), camera.unproject(np.array([[0.5, 0.5], [9.0, 7.0]])), camera.resized(32, 24)


@parser("camera in JSON", camera_used)
def _(folder: Path) -> list[str]:
    write_camera(FISHEYE, folder / "camera.json")
    names = ["camera.json"]
    for name, content in LENSES.items():
        if name.endswith(".json"):
            (folder / name).write_text(json.dumps(content(drawn(np.random.default_rng(1)))))
            names.append(name)
    return names


@parser("camera in YAML", lambda path: camera_used(path, (640, 480)))
def _(folder: Path) -> list[str]:
    write_camera(FISHEYE, folder / "camera.yaml")
    names = ["camera.yaml"]
    for name, content in LENSES.items():
        made = content(drawn(np.random.default_rng(1)))
        if name.endswith((".yaml", ".yml")) and made is not None:
            (folder / name).write_text(yaml.safe_dump(made))
            names.append(name)
    return names


@parser("camera in XML", camera_used)
def _(folder: Path) -> list[str]:
    write_camera(FISHEYE, folder / "vicalib.xml")
    write_camera(SCARAMUZZA, folder / "ocam.xml")
    matrix = "<rows>3</rows><cols>3</cols><dt>d</dt><data>50. 0. 48. 0. 50. 40. 0. 0. 1.</data>"
    (folder / "opencv.xml").write_text(
        '<?xml version="1.0"?>\n<opencv_storage>\n<image_width>96</image_width><image_height>80</image_height>\n'
        f'<camera_matrix type_id="opencv-matrix">{matrix}</camera_matrix>\n<distortion_coefficients '
        'type_id="opencv-matrix"><rows>1</rows><cols>4</cols><dt>d</dt><data>-.1 0 0 0</data>'
        "</distortion_coefficients>\n</opencv_storage>\n"
    )
    return ["vicalib.xml", "ocam.xml", "opencv.xml"]


@parser("camera in text", lambda path: camera_used(path, (96, 80)))
def _(folder: Path) -> list[str]:
    write_camera(FISHEYE, folder / "cameras.txt")
    write_camera(SCARAMUZZA, folder / "calib_results.txt")
    write_camera(CAMERA, folder / "intrinsics.txt")
    others = "SIMPLE_DIVISION 96 80 50 48 40 -0.1", "FOV 96 80 50 50 48 40 0.9", "EUCM 96 80 50 50 48 40 0.6 1.1"
    for number, words in enumerate(others):
        (folder / f"cameras{number}.txt").write_text(f"1 {words}\n")
    return sorted(p.name for p in folder.iterdir())


@parser("camera of MATLAB", camera_used)
def _(folder: Path) -> list[str]:
    bouguet = {"fc": [50.0, 50.0], "cc": [47.0, 39.0], "kc": [-0.1, 0, 0, 0, 0], "nx": 96.0, "ny": 80.0, "alpha_c": 0.0}
    savemat(folder / "Calib_Results.mat", bouguet)
    savemat(folder / "packed.mat", bouguet, do_compression=True)
    fisheye = {"MappingCoefficients": [50.0, -4e-3, 1e-6, 0.0], "StretchMatrix": np.eye(2)}
    rest = {"DistortionCenter": [48.0, 40.0], "ImageSize": [80.0, 96.0]}
    savemat(folder / "fisheye.mat", {"fisheyeParams": {"Intrinsics": {**fisheye, **rest}}})
    return ["Calib_Results.mat", "packed.mat", "fisheye.mat"]


@parser("light", read_light)
def _(folder: Path) -> list[str]:
    write_light(PhotometricCalibration(), folder / "light.json")
    write_light(PhotometricCalibration(position_mm=(0, -1.1, -3.6)), folder / "light.xml")
    return ["light.json", "light.xml"]


# ---- maps


def text_model(folder: Path) -> None:
    write_text_model(submap(), folder)


@parser("COLMAP in text", around(1, read_map))
def _(folder: Path) -> list[str]:
    text_model(folder)
    return ["cameras.txt", "images.txt", "points3D.txt"]


@parser("COLMAP in binary", around(1, read_map))
def _(folder: Path) -> list[str]:
    (folder / "cameras.bin").write_bytes(
        struct.pack("<Q", 1) + struct.pack("<IiQQ4d", 1, 1, CAMERA.width, CAMERA.height, *CAMERA.params)
    )
    images, points = [struct.pack("<Q", len(submap().keyframes))], [struct.pack("<Q", len(submap().points))]
    for number, keyframe in enumerate(submap().keyframes, 1):
        from lightdepth.files.rotations import quaternion_from_pose

        pose = (*quaternion_from_pose(keyframe.cam_from_map), *keyframe.cam_from_map[:3, 3])
        images.append(struct.pack("<I7dI", number, *pose, 1) + f"{keyframe.number:06d}.png".encode() + b"\0")
        images.append(struct.pack("<Q", len(keyframe.pixels)))
        images += [struct.pack("<2dQ", *p, i) for p, i in zip(keyframe.pixels, keyframe.point_ids, strict=True)]
    for i, point in zip(submap().point_ids, submap().points, strict=True):
        points.append(struct.pack("<Q3d3BdQ", i, *point, 1, 2, 3, 0.5, 1) + struct.pack("<2I", 1, 0))
    (folder / "images.bin").write_bytes(b"".join(images))
    (folder / "points3D.bin").write_bytes(b"".join(points))
    read_cameras_binary(folder / "cameras.bin")
    return ["cameras.bin", "images.bin", "points3D.bin"]


@parser("stella_vslam in msgpack", read_map)
def _(folder: Path) -> list[str]:
    write_stella(submap(), folder / "map.msg")
    write_stella(submap(), folder / "map.json")
    content = json.loads((folder / "map.json").read_text())
    for number, keyframe in enumerate(content["keyframes"].values()):
        del keyframe["src_frm_id"]
        keyframe |= {"ts": float(number), "undists": [p["pt"] for p in keyframe.pop("keypts")]}
    (folder / "old.msg").write_bytes(msgpack.packb(content))
    return ["map.msg", "old.msg"]


@parser("stella_vslam in JSON", read_map)
def _(folder: Path) -> list[str]:
    write_stella(submap(), folder / "map.json")
    return ["map.json"]


@parser("multi-map tree", around(3, read_map))
def _(folder: Path) -> list[str]:
    write_multimap(slam(list(colon(0, 3, 6.0).frames), config=EXACT).map, folder / "tree")
    (folder / "tree" / "3D_maps" / "0").rename(folder / "tree" / "3D_maps" / "old")
    shutil.rmtree(folder / "tree" / "3D_maps" / "old")
    text_model(folder / "tree" / "3D_maps" / "0")
    (folder / "tree" / "3D_maps" / "0" / "densify_map.json").write_text('{"pixel_center": 0.5, "frame_offset": 1}')
    return [f"tree/3D_maps/0/{name}" for name in ("densify_map.json", "images.txt")]


@parser("trajectory of a multi-map tree", lambda path: (read_trajectory(path), read_map(path.parents[1])))
def _(folder: Path) -> list[str]:
    write_multimap(slam(list(colon(0, 3, 6.0).frames), config=EXACT).map, folder)
    (folder / "3D_maps" / "0" / "images.txt").unlink()
    points = folder / "3D_maps" / "0" / "points3D.txt"
    points.write_text("".join(points.read_text().splitlines(keepends=True)[:60]))
    return [str(p.relative_to(folder)) for p in (folder / "camera_trajectory").iterdir()]


@parser("TUM trajectory with points", lambda path: read_map(path.parent))
def _(folder: Path) -> list[str]:
    poses = [np.linalg.inv(k.cam_from_map) for k in submap().keyframes]
    write_tum(folder / "a" / "KeyFrameTrajectory.txt", [0.1 * k.number for k in submap().keyframes], poses)
    write_camera(CAMERA, folder / "a" / "camera.json")
    (folder / "a" / "densify_map.json").write_text('{"fps": 10.0, "time_offset": 0.0}')
    np.savetxt(folder / "a" / "cloud.xyz", submap().points)
    shutil.copytree(folder / "a", folder / "b")
    (folder / "b" / "cloud.xyz").unlink()
    trimesh.PointCloud(submap().points).export(folder / "b" / "cloud.ply")
    names = ("KeyFrameTrajectory.txt", "cloud.xyz", "densify_map.json", "camera.json")
    return [f"a/{name}" for name in names] + ["b/cloud.ply"]


@parser("poses of TUM and KITTI", read_tum)
def _(folder: Path) -> list[str]:
    poses = [np.linalg.inv(k.cam_from_map) for k in submap().keyframes]
    write_tum(folder / "poses.tum", range(len(poses)), poses)
    np.savetxt(folder / "kitti.txt", np.stack(poses)[:, :3].reshape(-1, 12))
    return ["poses.tum", "kitti.txt"]


# ---- data sets


def sequence_at(steps: int, format: str | None = None) -> Callable[[Path], object]:
    return around(steps, lambda folder: list(open_sequence(folder, format)))


@parser("frames in a folder", sequence_at(1, "folder"))
def _(folder: Path) -> list[str]:
    write_folder(frames(), folder)
    (folder / "times.csv").write_text("name,seconds\n" + "".join(f"{f.name},{f.number / 30}\n" for f in frames()))
    return ["times.csv", "camera.json", "light.json", "mask.png"] if (folder / "mask.png").is_file() else ["times.csv"]


@parser("frames of C3VD", lambda path: list(open_sequence(next(p for p in path.parents if p.name == "c3vd"), "c3vd")))
def _(folder: Path) -> list[str]:
    write_c3vd(colon(0, 3, 6.0, lens("c3vd", 50, 40)).frames, folder / "c3vd")
    return ["c3vd/pose.txt", *sorted(str(p.relative_to(folder)) for p in folder.rglob("*.tiff"))[:1]]


@parser("frames of SimCol", lambda path: list(open_sequence(path.parent / "Frames_S1", "simcol")))
def _(folder: Path) -> list[str]:
    write_simcol(frames(), folder / "Frames_S1")
    return [p.name for p in folder.iterdir() if p.suffix == ".txt"]


@parser("frames of Hamlyn", sequence_at(1, "hamlyn"))
def _(folder: Path) -> list[str]:
    write_hamlyn(frames(), folder)
    texts = [str(p.relative_to(folder)) for p in folder.rglob("*.txt")]
    return [name for name in texts if "/" not in name] or texts


@parser("frames of EndoSLAM", sequence_at(1, "endoslam"))
def _(folder: Path) -> list[str]:
    write_endoslam(frames(), folder, simulated=True)
    return ["trajectory.csv", "calibration.txt", "info.txt"]


@parser("frames of EndoMapper", sequence_at(1, "endomapper"))
def _(folder: Path) -> list[str]:
    write_endomapper(
        [replace(f, name=f"out{f.number + 1}") for f in colon(0, 3, 6.0, FISHEYE.resized(32, 24)).frames],
        folder,
    )
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.suffix in (".xml", ".json", ".txt"))


def _tarred(folder: Path) -> None:
    """A plain tar is read as one that is packed: with gzip's checksum a spoilt one would never be unpacked."""
    for packed in folder.rglob("*.tar.gz"):
        with tarfile.open(packed) as tar:
            members = [(m.name, tar.extractfile(m).read()) for m in tar.getmembers() if m.isfile()]  # type: ignore[union-attr]
        with tarfile.open(packed, "w", format=tarfile.PAX_FORMAT) as tar:
            for name, data in members:
                entry = tarfile.TarInfo(name)
                entry.size, entry.pax_headers = len(data), {"comment": "x" * 40}
                tar.addfile(entry, io.BytesIO(data))


@parser("archives of SCARED", sequence_at(2, "scared"))
def _(folder: Path) -> list[str]:
    write_scared(frames(), folder)
    _tarred(folder)
    return ["data/frame_data.tar.gz", "data/scene_points.tar.gz"]


@parser("frame data of SCARED", sequence_at(3, "scared"))
def _(folder: Path) -> list[str]:
    write_scared(frames(), folder, archives=False)
    return ["data/frame_data/frame_data000000.json", "data/scene_points/scene_points000000.tiff"]


@parser("split", lambda path: folders(read_split(path), path.parent / "root", ("train", "test")), handed_in=False)
def _(folder: Path) -> list[str]:
    for name in ("a", "b"):
        (folder / "root" / name).mkdir(parents=True)
        (folder / "root" / name / "x").write_text("x")
    (folder / "split.yaml").write_text("parts:\n  train: [a]\n  test:\n  - b\n")
    return ["split.yaml"]


@parser("list of frames", read_frame_list, handed_in=False)
def _(folder: Path) -> list[str]:
    (folder / "frames.txt").write_text("# chosen\n000001\na/000002.png\n")
    return ["frames.txt"]


@parser("table of sequences", lambda path: units_of(read_manifest(path, path.parent / "out"), asked_of_all()))
def _(folder: Path) -> list[str]:
    write_folder(frames(), folder / "a")
    text_model(folder / "map")
    rows = "data,map,light,mm_per_unit,name,camera,mask,fov,trust_map,map_fps\n"
    rows += 'a,map,"gamma=2.2,mu=0",3.1,case-1,,,,,\n./a,,a/light.json,light,,auto,a/m.png,90,true,30\n"b",,,,,,,,,\n'
    (folder / "commas.csv").write_text(rows)
    (folder / "semicolons.csv").write_text("\ufeffdata;name;;\r\na;x;;\r\n\r\n;;;\r\n")
    (folder / "tabs.tsv").write_text("data\tformat\tbit-depth\na\tfolder\t10\n")
    return ["commas.csv", "semicolons.csv", "tabs.tsv"]


# ---- pictures, videos, depth


def _png_repaired(data: bytes) -> bytes:
    """With right checksums, as far as chunks can be told."""
    fixed, at = bytearray(data), 8
    while at + 12 <= len(fixed):
        (length,) = struct.unpack_from(">I", fixed, at)
        if at + 12 + length > len(fixed):
            break
        struct.pack_into(">I", fixed, at + 8 + length, zlib.crc32(bytes(fixed[at + 4 : at + 8 + length])))
        at += 12 + length
    return bytes(fixed)


def _picture(path: Path) -> object:
    return image_size(path), read_image(path)


def _encoded(folder: Path, *names: str, **options: Any) -> list[str]:
    picture = Image.fromarray(np.rint(frames()[0].image * 255).astype(np.uint8))
    for name in names:
        picture.save(folder / name, **options)
    return list(names)


@parser("picture in PNG", _picture, repaired=_png_repaired)
def _(folder: Path) -> list[str]:
    cv2.imwrite(str(folder / "1.png"), (frames()[0].image * 65535).astype(np.uint16))
    return [*_encoded(folder, "0.png"), "1.png"]


@parser("picture in JPEG", _picture)
def _(folder: Path) -> list[str]:
    exif = Image.Exif()
    exif[274] = 6
    return [*_encoded(folder, "0.jpg"), *_encoded(folder, "1.jpg", exif=exif, progressive=True)]


@parser("picture in TIFF", _picture)
def _(folder: Path) -> list[str]:
    names = [*_encoded(folder, "0.tif"), *_encoded(folder, "1.tif", compression="tiff_lzw")]
    cv2.imwrite(str(folder / "2.tif"), frames()[0].image.astype(np.float32))
    return [*names, "2.tif"]


@parser("picture in another format", _picture)
def _(folder: Path) -> list[str]:
    return _encoded(folder, "0.bmp", "0.webp", "0.gif", "0.jp2", "0.ppm", "0.avif")


@parser("picture in NPY", _picture)
def _(folder: Path) -> list[str]:
    np.save(folder / "0.npy", frames()[0].image[:4, :4])
    return ["0.npy"]


@parser("mask", read_mask, repaired=_png_repaired)
def _(folder: Path) -> list[str]:
    cv2.imwrite(str(folder / "mask.png"), np.pad(np.full((20, 20), 255, np.uint8), 4))
    return ["mask.png"]


def _npz_repaired(data: bytes) -> bytes:
    """The spoilt bytes of one member, in a zip that is in order; every eighth is left with its own."""
    if data[:2] == b"PK":
        return data
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        archive.writestr("distance.npy", data)
    return made.getvalue()


def _depth(path: Path) -> object:
    return DepthReading("depth", 1.0).read(path, TINY)


@parser("depth in NPZ", _depth, repaired=_npz_repaired)
def _(folder: Path) -> list[str]:
    np.savez_compressed(folder / "0.npz", depth=frames()[0].true_distance)
    np.savez(folder / "1.npz", depth=np.ones((24, 32), np.float32), valid=np.ones((24, 32), bool))
    np.save(folder / "2", np.ones((24, 32), np.float32))
    (folder / "2.npy").rename(folder / "2.npz")
    return ["0.npz", "1.npz", "2.npz"]


@parser("depth in other files", _depth)
def _(folder: Path) -> list[str]:
    np.save(folder / "0.npy", frames()[0].true_distance)
    write_exr(folder / "0.exr", frames()[0].true_distance)
    cv2.imwrite(str(folder / "0.tiff"), frames()[0].true_distance)
    return ["0.npy", "0.exr", "0.tiff"]


@parser("prediction", read_prediction, handed_in=False, repaired=_npz_repaired)
def _(folder: Path) -> list[str]:
    ones = np.ones((24, 32), np.float32)
    DepthPrediction("000000", ones, ones > 0, TINY, "nobody").save(folder / "000000.npz")
    return ["000000.npz"]


@parser("mesh", read_mesh)
def _(folder: Path) -> list[str]:
    box = trimesh.creation.box()
    for name in ("a.ply", "a.obj", "a.stl", "a.glb", "a.off"):
        box.export(folder / name)
    box.export(folder / "b.ply", encoding="ascii")
    return ["a.ply", "a.obj", "a.stl", "a.glb", "a.off", "b.ply"]


@parser("point cloud", read_cloud)
def _(folder: Path) -> list[str]:
    trimesh.PointCloud(submap().points).export(folder / "a.ply")
    return ["a.ply"]


def _video(path: Path) -> object:
    video = VideoFile(path)
    return [video.read(i) for i in range(min(len(video), 3))]


@parser("video", _video)
def _(folder: Path) -> list[str]:
    images = [np.rint(f.image * 255).astype(np.uint8) for f in frames()]
    write_video(folder / "a.mp4", images, [0, 0.04, 0.08])
    write_video(folder / "a.mkv", images, [0, 0.04, 0.08])
    write_video(folder / "a.avi", images, [0, 0.04, 0.08], codec="mjpeg", pixels="yuvj420p")
    return ["a.mp4", "a.mkv", "a.avi"]


def _dicom(path: Path) -> object:
    clip = open_dicom(path)
    return [clip.read(i) for i in range(min(len(clip), 3))]


@parser("DICOM", _dicom)
def _(folder: Path) -> list[str]:
    images = [np.rint(f.image * 255).astype(np.uint8) for f in frames()]
    kinds = ("native RGB", "implicit, by planes", "RLE", "JPEG", "JPEG 2000")
    for number, kind in enumerate(kinds):
        write_dicom(folder / f"{number}.dcm", images, kind)
    return [f"{number}.dcm" for number in range(len(kinds))]


# ---- weights


def _zip_repaired(data: bytes) -> bytes:
    """With right checksums of what an archive stores as it is, as far as its entries can be told."""
    fixed, at = bytearray(data), data.find(b"PK\1\2")
    while 0 <= at <= len(fixed) - 46:
        (size,), (start,) = struct.unpack_from("<I", fixed, at + 20), struct.unpack_from("<I", fixed, at + 42)
        if start + 30 <= len(fixed):
            content = start + 30 + sum(struct.unpack_from("<2H", fixed, start + 26))
            checksum = struct.pack("<I", zlib.crc32(bytes(fixed[content : content + size])))
            fixed[at + 16 : at + 20] = fixed[start + 14 : start + 18] = checksum
        at = data.find(b"PK\1\2", at + 4)
    return bytes(fixed)


@cache
def network() -> DepthNetwork:
    return build_network(NetworkConfig(width=1, inputs=("rgb",)))


def _loaded(path: Path) -> object:
    """By its folder where that is a checkpoint, as hubs keep them."""
    return load_model(path.parent if (path.parent / "config.json").is_file() else path)


@parser("checkpoint in safetensors", _loaded)
def _(folder: Path) -> list[str]:
    save_model(network(), folder / "a.safetensors", {"rows": 32})
    (folder / "hub").mkdir()
    (folder / "hub" / "model.safetensors").write_bytes(save(network().state_dict()))
    card = {"network": network().config.to_dict(), "card": {"rows": 32}}
    (folder / "hub" / "config.json").write_text(json.dumps(card))
    return ["a.safetensors", "hub/model.safetensors", "hub/config.json"]


@parser("checkpoint of Lightning", load_model, repaired=_zip_repaired)
def _(folder: Path) -> list[str]:
    state = {f"network.{name}": value for name, value in network().state_dict().items()}
    saved = {"hyper_parameters": {"network": network().config.to_dict(), "rows": 32}, "state_dict": state}
    torch.save(saved, folder / "a.ckpt")
    torch.save(saved, folder / "old.ckpt", _use_new_zipfile_serialization=False)
    return ["a.ckpt", "old.ckpt"]


@parser("weights of an encoder", read_weights, repaired=_zip_repaired)
def _(folder: Path) -> list[str]:
    some = {name: value for name, value in list(network().state_dict().items())[:8]}
    torch.save({"state_dict": some}, folder / "a.pth")
    (folder / "a.safetensors").write_bytes(save(some))
    return ["a.pth", "a.safetensors"]


# ---- what the program wrote itself


@parser("bench.json", lambda path: checked_fields(BenchFile, read_json(path), str(path)), handed_in=False)
def _(folder: Path) -> list[str]:
    cell = {"scene": "a", "seed": 0, "wrong_share": 0.1, "rows": {"x": {"rms_mm": 1.0}}}
    (folder / "bench.json").write_text(json.dumps({"kind": "bench", "suite_version": 1, "config": {}, "cells": [cell]}))
    return ["bench.json"]


@parser("run.json", around(1, run_record), handed_in=False)
def _(folder: Path) -> list[str]:
    (folder / "run.json").write_text(json.dumps({"verb": "export", "step": 0.1, "unit": "mm", "arguments": {}}))
    return ["run.json"]


@parser("scale.json", lambda path: scale_of(path.parent, 0), handed_in=False)
def _(folder: Path) -> list[str]:
    told = MapScale(0, 2.0, (1.6, 2.5), "the light", 0.1, 900), MapScale(1, refused="it is dark", cure="more light")
    Scales(told).write_file(folder, "map units", PhotometricCalibration())
    return ["scale.json"]
