"""EndoMapper's COLMAP clusters as Seq_001 ships them: one folder of frames, many old binary models, each its own."""

from __future__ import annotations

import json
import shutil
import struct
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from colons import EXACT, colon, slam
from raising import refused

from lightdepth.camera import KannalaBrandt
from lightdepth.datasets import open_sequence, write_endomapper
from lightdepth.files.rotations import quaternion_from_pose
from lightdepth.frame import Frame
from lightdepth.maps import read_map
from lightdepth.sparse_map import Submap
from lightdepth.tube import lens

LENS = lens("fisheye", 96, 72)
REFINED = replace(LENS, fx=LENS.fx + 0.5)  # what the authors' COLMAP runs made of the lens
CLUSTERS = {3: (0, 1, 2, 3), 11: (3, 4, 5, 6, 7)}  # submap -> rows of frames; they share one


def frames() -> list[Frame]:
    return [replace(f, name=f"out{41 + f.number}") for f in colon(0, 8, 10.0, LENS).frames]


def write_legacy_model(submap: Submap, folder: Path) -> None:
    """COLMAP 3.6: cameras.bin, images.bin and points3D.bin, little-endian, without rigs and frames.

    Every keypoint belongs to a point here but one, which has COLMAP's invalid id.
    """
    folder.mkdir(parents=True)
    camera = submap.keyframes[0].camera
    assert isinstance(camera, KannalaBrandt)
    cameras = struct.pack("<QIiQQ8d", 1, 1, 5, camera.width, camera.height, *camera.params)
    (folder / "cameras.bin").write_bytes(cameras)
    images = [struct.pack("<Q", len(submap.keyframes))]
    tracks: dict[int, list[tuple[int, int]]] = {int(i): [] for i in submap.point_ids}
    for image_id, keyframe in enumerate(submap.keyframes, 1):
        pose = (*quaternion_from_pose(keyframe.cam_from_map), *keyframe.cam_from_map[:3, 3])
        images.append(struct.pack("<I7dI", image_id, *pose, 1) + keyframe.name.encode() + b"\0")
        images.append(struct.pack("<Q", len(keyframe.pixels) + 1) + struct.pack("<ddQ", 1.0, 1.0, 2**64 - 1))
        for k, (pixel, point) in enumerate(zip(keyframe.pixels.tolist(), keyframe.point_ids.tolist(), strict=True), 1):
            images.append(struct.pack("<ddQ", *pixel, point))
            tracks[point].append((image_id, k))
    (folder / "images.bin").write_bytes(b"".join(images))
    points = [struct.pack("<Q", len(submap.points))]
    for point, xyz in zip(submap.point_ids.tolist(), submap.points.tolist(), strict=True):
        track = tracks[point]
        points.append(struct.pack("<Q3d3BdQ", point, *xyz, 200, 100, 90, 0.7, len(track)))
        points.extend(struct.pack("<II", *element) for element in track)
    (folder / "points3D.bin").write_bytes(b"".join(points))


def cluster(number: int) -> Submap:
    """A submap of some of the frames, with the refined lens, in its own scale."""
    chosen = [replace(frames()[row], camera=REFINED) for row in CLUSTERS[number]]
    (submap,) = slam(chosen, number, EXACT).map.submaps
    keyframes = tuple(replace(k, name=f"out{k.number}.png") for k in submap.keyframes)
    return Submap(number, keyframes, submap.point_ids, submap.points)


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    """Seq_001 as it is unpacked: Sequences/Seq_001/meta-data/colmap/33."""
    root = tmp_path_factory.mktemp("endomapper")
    folder = root / "Sequences" / "Seq_001" / "meta-data" / "colmap" / "33"
    write_endomapper(frames(), folder)
    (folder / "cluster_list").mkdir()
    (folder / "GT").mkdir()
    for number in CLUSTERS:
        submap = cluster(number)
        write_legacy_model(submap, folder / "sparse" / str(number))
        names = [k.name for k in submap.keyframes]
        (folder / "sparse" / str(number) / "camerasModel.txt").write_text("\n".join(f"{n} {n}" for n in names) + "\n")
        given = [f"out{41 + row}.png" for row in CLUSTERS[number]]
        (folder / "cluster_list" / f"{number}.txt").write_text("\n".join(given) + "\n")
        (folder / "GT" / f"{number}.txt").write_text("")
    info = {"seq_number": 1, "endoscope_number": "0", "type": "procedure", "meta-data": ["Colmap Reconstructions"]}
    (root / "Sequences" / "Seq_001" / "Seq_001_info.json").write_text(json.dumps(info))
    return folder


@pytest.fixture
def folder(written, tmp_path) -> Path:
    """A copy to spoil."""
    shutil.copytree(written.parents[4], tmp_path / "data")
    return tmp_path / "data" / written.relative_to(written.parents[4])


def test_all_models_are_the_submaps_of_one_map_each_with_its_number(written):
    found = read_map(written)
    assert [s.id for s in found.submaps] == [3, 11]
    for submap in found.submaps:
        given = cluster(submap.id)
        assert [k.name for k in submap.keyframes] == [k.name for k in given.keyframes]
        np.testing.assert_array_equal(submap.points, given.points)
        for read, keyframe in zip(submap.keyframes, given.keyframes, strict=True):
            np.testing.assert_allclose(read.cam_from_map, keyframe.cam_from_map, atol=1e-12)
            np.testing.assert_array_equal(read.pixels, keyframe.pixels)
            np.testing.assert_array_equal(read.point_ids, keyframe.point_ids)
            assert read.camera == REFINED
    assert read_map(written / "sparse" / "11").submaps[0].id == 11


def test_the_folder_is_the_whole_sequence_with_the_endoscope_s_calibration(written):
    read = open_sequence(written)
    assert read.numbers == list(range(41, 49)) and read[0].camera.params == pytest.approx(LENS.params)
    for found, given in zip(read, frames(), strict=True):
        assert np.abs(found.image - given.image).max() < 1e-6 and found.light.mu == given.light.mu
        np.testing.assert_array_equal(found.mask, given.mask)


@pytest.mark.parametrize("number", CLUSTERS)
def test_a_model_s_folder_is_its_frames_with_its_own_camera(written, number):
    read = open_sequence(written / "sparse" / str(number))
    assert read.numbers == [k.number for k in cluster(number).keyframes]
    assert read[0].camera == REFINED and read[0].mask is not None
    given = {f.number: f for f in frames()}
    for frame in read:
        assert np.abs(frame.image - given[frame.number].image).max() < 1e-6


def test_a_cluster_s_list_is_the_frames_that_were_given_to_the_model(written, monkeypatch):
    read = open_sequence(written / "cluster_list" / "11.txt")
    assert read.numbers == [41 + row for row in CLUSTERS[11]] and read[0].camera == REFINED
    monkeypatch.chdir(written / "sparse")
    assert open_sequence("3").numbers == [k.number for k in cluster(3).keyframes]


def test_a_list_without_a_model_takes_the_endoscope_s_calibration(folder):
    shutil.rmtree(folder / "sparse" / "3")
    read = open_sequence(folder / "cluster_list" / "3.txt")
    assert read.numbers == [41, 42, 43, 44] and read[0].camera.params == pytest.approx(LENS.params)


def test_a_cluster_that_does_not_fit_its_frames_is_refused(folder):
    (folder / "cluster_list" / "3.txt").write_text("out41.png out999.png\n")
    with refused(where="3.txt", found="1 of its 2 frames are not there, the first is out999"):
        open_sequence(folder / "cluster_list" / "3.txt")
    (folder / "cluster_list" / "3.txt").write_text("1 2 3\n")
    with refused(where="3.txt", cure="expected the frames' names, out<N>.png"):
        open_sequence(folder / "cluster_list" / "3.txt")
    (folder / "img_train" / "out41.png").unlink()
    with refused(found="1 of its 4 frames are not there, the first is out41"):
        open_sequence(folder / "sparse" / "3")


def video(path: Path, fps: int) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=Fraction(fps))
        stream.width, stream.height, stream.pix_fmt = 32, 32, "yuv420p"
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8), format="rgb24")))
        container.mux(stream.encode())


def test_times_come_from_the_info_file_or_from_the_video_and_are_unknown_without(folder):
    sequence = folder.parents[2]
    assert open_sequence(folder)[0].time is None
    video(sequence / "Seq_001.mov", 50)
    assert [f.time for f in open_sequence(folder)][:2] == pytest.approx([40 / 50, 41 / 50])
    info = json.loads((sequence / "Seq_001_info.json").read_text())
    (sequence / "Seq_001_info.json").write_text(json.dumps({**info, "fps": 40}))
    assert open_sequence(folder)[0].time == pytest.approx(1.0)
    (sequence / "Seq_001_info.json").write_text(json.dumps(info))
    (sequence / "Seq_001.mov").write_bytes(b"no video")
    assert open_sequence(folder)[0].time is None


def test_frames_at_half_size_have_the_model_s_camera_at_half_size(folder):
    for image in (folder / "img_train").iterdir():
        cv2.imwrite(str(image), cv2.imread(str(image))[::2, ::2])
    camera = open_sequence(folder / "sparse" / "3")[0].camera
    assert camera == REFINED.resized(48, 36)
