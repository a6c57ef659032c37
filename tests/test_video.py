"""Video files as sequences: the right picture at the right time after any jump, and clear words for damaged files."""

from __future__ import annotations

import json
import pickle
import shutil
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from raising import refused, warned
from torch.utils.data import DataLoader, Dataset
from videos import CAMERA, OCTAGON, picture, uneven_times, write_video

from lightdepth.calibration import write_camera, write_light
from lightdepth.datasets import VideoFile, open_sequence
from lightdepth.errors import InputError
from lightdepth.frame import Frame
from lightdepth.photometry import PhotometricCalibration
from lightdepth.tube import lens

COUNT = 30
TIMES = uneven_times(COUNT)
KINDS = {
    "mp4": ("a.mp4", "libx264", "yuv420p", {"bf": "2"}),
    "mov": ("a.mov", "libx264", "yuv420p", {"bf": "2"}),
    "open groups": ("open.mkv", "libx264", "yuv420p", {"bf": "3", "x264-params": "open-gop=1"}),
    "lossless": ("a.mkv", "ffv1", "bgr0", {}),
    "every frame alone": ("a.avi", "mjpeg", "yuvj420p", {}),
    "ten bits": ("ten.mkv", "libx264", "yuv420p10le", {}),
    "a stream": ("a.ts", "libx264", "yuv420p", {"bf": "2"}),
    "no times of its own": ("b.avi", "mpeg4", "yuv420p", {"bf": "2"}),
}


@pytest.fixture(scope="session")
def videos(tmp_path_factory) -> dict[str, Path]:
    """The same moving tissue in several containers and codecs, at a variable frame rate."""
    folder = tmp_path_factory.mktemp("videos")
    images = [picture(i) for i in range(COUNT)]
    return {
        kind: write_video(folder / name, images, TIMES, codec, pixels, **options)
        for kind, (name, codec, pixels, options) in KINDS.items()
    }


@pytest.fixture
def with_camera(videos, tmp_path) -> Path:
    """A video with camera.json beside it."""
    shutil.copy(videos["mp4"], tmp_path / "a.mp4")
    write_camera(CAMERA, tmp_path / "camera.json")
    return tmp_path / "a.mp4"


@pytest.mark.parametrize("kind", KINDS)
def test_any_frame_is_the_same_however_it_is_reached(videos, kind):
    video = VideoFile(videos[kind])
    forward = [video.read(i).copy() for i in range(len(video))]
    assert len(video) == COUNT
    order = np.random.default_rng(0).permutation(np.repeat(np.arange(COUNT), 2))
    assert all(np.array_equal(video.read(i), forward[i]) for i in order)
    top = 65535 if kind == "ten bits" else 255
    worst = max(np.abs(frame / top - picture(i) / 255).mean() for i, frame in enumerate(forward))
    assert worst < (1e-9 if kind == "lossless" else 0.03)
    nearest = np.abs(forward[12] / top - picture(12) / 255).mean()
    assert all(np.abs(forward[i] / top - picture(12) / 255).mean() > 1.5 * nearest for i in (11, 13))


@pytest.mark.parametrize("kind", KINDS)
def test_times_are_those_that_were_written(videos, kind):
    times = VideoFile(videos[kind]).times
    if kind == "no times of its own":  # AVI keeps the order of decoding alone
        assert (np.diff(times) > 0).all() and np.abs(times - TIMES).max() < 0.1
        return
    late = times[0] if kind == "a stream" else 0  # a transport stream starts where it likes
    assert np.abs(times - late - TIMES).max() <= 1e-3


def test_reading_forward_decodes_every_picture_once_and_jumps_go_to_keyframes(videos, monkeypatch):
    from lightdepth.datasets import video as module

    decoded = []
    original = module._decoded
    monkeypatch.setattr(module, "_decoded", lambda *a: (decoded.append(1) or frame for frame in original(*a)))
    video = VideoFile(videos["mp4"])
    decoded.clear()
    for i in range(COUNT):
        video.read(i)
    assert len(decoded) == COUNT
    decoded.clear()
    video.read(video.keyframes[-1])
    assert len(decoded) <= 2


class Reads(Dataset):
    def __init__(self, frames) -> None:
        self.frames = frames

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, i: int) -> np.ndarray:
        return self.frames[i].image


def test_a_sequence_of_video_goes_to_other_processes(with_camera):
    frames = open_sequence(with_camera)
    expected = [frames[i].image for i in range(8)]  # its decoder is open when the workers are forked
    loaded = [batch[0].numpy() for batch in DataLoader(Reads(frames[:8]), num_workers=2)]
    np.testing.assert_array_equal(loaded, expected)
    again = pickle.loads(pickle.dumps(frames[2:5]))
    np.testing.assert_array_equal(again[1].image, expected[3])


def test_a_video_is_a_sequence_with_what_lies_beside_it(with_camera):
    write_light(PhotometricCalibration(2.0, 1.0, source="measured"), with_camera.parent / "light.json")
    frames = open_sequence(with_camera)
    assert len(frames) == COUNT and frames.names[7] == "000007" and frames.by_number(7).number == 7
    frame = frames[7]
    assert isinstance(frame, Frame) and frame.image.dtype == np.float32 and frame.light.gamma == 2.0
    assert frame.camera == CAMERA and frame.time == pytest.approx(TIMES[7], abs=1e-3)
    assert (frame.mask & OCTAGON).sum() / (frame.mask | OCTAGON).sum() > 0.97  # found
    assert open_sequence(with_camera, light="gamma=2.2,mu=0")[0].light.mu == 0


def test_the_black_border_of_a_video_is_said(with_camera):
    with warned("black border"):
        open_sequence(with_camera)


def test_without_a_camera_a_video_is_refused_and_a_map_s_camera_serves(videos, tmp_path):
    with refused(where="a.mp4", found="no camera.json beside it", cure="give --camera FILE"):
        open_sequence(videos["mp4"])
    assert open_sequence(videos["mp4"], map_camera=CAMERA.resized(128, 104))[0].camera == CAMERA
    write_camera(CAMERA, tmp_path / "other.json")
    assert open_sequence(videos["mp4"], camera=tmp_path / "other.json")[0].camera == CAMERA
    (tmp_path / "intrinsics.txt").write_text("150 0 127.5\n0 150 103.5\n0 0 1\n")
    assert open_sequence(videos["mp4"], camera=tmp_path / "intrinsics.txt")[0].camera == CAMERA


@pytest.mark.parametrize("given", ["folder", "file"])
def test_endomapper_s_tree_holds_the_video_and_its_endoscope_s_calibration(videos, tmp_path, given):
    sequence = tmp_path / "Sequences" / "Seq_027"
    sequence.mkdir(parents=True)
    shutil.copy(videos["mov"], sequence / "Seq_027.mov")
    camera = lens("fisheye", 256, 208)
    for number, scale in (("01", 1.1), ("02", 1.0)):
        place = tmp_path / "Calibrations" / f"Endoscope_{number}"
        place.mkdir(parents=True)
        write_camera(camera.resized(512, 416), place / f"Endoscope_{number}_geometrical.xml")
        light = PhotometricCalibration(2.2, scale, source="measured")
        write_light(light, place / f"Endoscope_{number}_photometrical.xml")
    info = sequence / "Seq_027_info.json"
    info.write_text(json.dumps({"seq_number": 27, "endoscope_number": 2}))
    path = sequence if given == "folder" else sequence / "Seq_027.mov"
    frame = open_sequence(path)[3]
    assert frame.camera.params == pytest.approx(camera.params) and frame.light.mu == 1.0
    info.write_text(json.dumps({"seq_number": 27, "endoscope_number": "N/A"}))
    with refused(found="made with endoscope N/A"):
        open_sequence(path)
    assert open_sequence(path, map_camera=CAMERA)[3].camera == CAMERA
    shutil.copy(videos["mp4"], sequence / "other.mp4")
    if given == "folder":
        with refused(where="Seq_027", found="2 videos (Seq_027.mov, other.mp4)"):
            open_sequence(path)


def test_of_a_video_cut_off_the_frames_there_are_given_and_the_others_refused(videos, tmp_path):
    data = videos["mp4"].read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) * 6 // 10])
    write_camera(CAMERA, tmp_path / "camera.json")
    frames, whole = open_sequence(tmp_path / "cut.mp4"), VideoFile(videos["mp4"])
    assert len(frames) == COUNT
    given = []
    for i in range(COUNT):
        try:
            frames[i]
            given.append(i)
        except InputError as error:
            assert f"frame {i}" in str(error) and ("cut off" in str(error) or "does not decode" in str(error))
    assert 8 <= len(given) <= 24 and given[:8] == list(range(8))
    np.testing.assert_array_equal(frames._load.video.read(5), whole.read(5))
    assert frames[3].number == 3  # after the refusals


def test_a_frame_that_is_damaged_is_refused_and_the_others_are_right(videos, tmp_path):
    with av.open(str(videos["every frame alone"])) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    data = bytearray(videos["every frame alone"].read_bytes())
    at = data.find(packets[5])
    data[at : at + len(packets[5])] = bytes(len(packets[5]))
    (tmp_path / "bad.avi").write_bytes(data)
    video, whole = VideoFile(tmp_path / "bad.avi"), VideoFile(videos["every frame alone"])
    with refused(found="frame 5 of 30 does not decode"):
        video.read(5)
    np.testing.assert_array_equal(video.read(4), whole.read(4))
    np.testing.assert_array_equal(video.read(20), whole.read(20))


@pytest.mark.parametrize("content", [b"", b"no video", bytes(5000), b"#EXTM3U\n#EXTINF:1,\na.mp4\n"])
def test_what_is_no_video_is_refused_by_name(tmp_path, content):
    (tmp_path / "a.mp4").write_bytes(content)
    with refused(where="a.mp4", found="not a video that can be read"):
        open_sequence(tmp_path / "a.mp4")


def test_metadata_that_is_no_text_and_a_codec_that_nobody_knows_are_no_crash(videos, tmp_path):
    data = videos["mp4"].read_bytes()
    (tmp_path / "a.mp4").write_bytes(data.replace(b"iso2avc1", b"iso2av\xd21"))
    np.testing.assert_array_equal(VideoFile(tmp_path / "a.mp4").read(3), VideoFile(videos["mp4"]).read(3))
    (tmp_path / "b.mp4").write_bytes(data.replace(b"avc1", b"zzz1"))
    with refused(where="b.mp4", found="a codec that FFmpeg does not know"):
        VideoFile(tmp_path / "b.mp4")


def test_a_file_that_is_neither_video_nor_folder_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("notes")
    with refused(where="notes.txt", found="is a file"):
        open_sequence(tmp_path / "notes.txt")
    with refused(cure="expected a folder of frames, or a video"):
        open_sequence(tmp_path / "nowhere.mp4")
    with refused(found="no video in it"):
        open_sequence(tmp_path, "video")


def turned_by_flag(video: Path, path: Path) -> Path:
    """The matrix of an mp4's track header, set to a quarter turn as telephones do."""
    data = bytearray(video.read_bytes())
    upright = b"".join(v.to_bytes(4, "big") for v in (1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30))
    turned = b"".join((v % 2**32).to_bytes(4, "big") for v in (0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30))
    at = data.find(upright, data.find(b"tkhd"))
    data[at : at + len(turned)] = turned
    path.write_bytes(data)
    return path


def test_pixels_are_the_stored_ones_whatever_turn_the_file_asks_for(videos, tmp_path):
    path = turned_by_flag(videos["mp4"], tmp_path / "turned.mp4")
    video = VideoFile(path)
    assert (video.width, video.height) == (256, 208) and video.rotation in (90, 270)
    np.testing.assert_array_equal(video.read(4), VideoFile(videos["mp4"]).read(4))
    write_camera(CAMERA, tmp_path / "camera.json")
    with warned("a flag", "degrees"):
        assert open_sequence(path)[4].image.shape == (208, 256, 3)
    write_camera(CAMERA.resized(256, 208).cropped(0, 0, 208, 256), tmp_path / "turned.json")
    with refused(found="the calibration is of the turned 208x256", cure="turn the pixels for good"):
        open_sequence(path, camera=tmp_path / "turned.json")


def test_odd_sizes_and_pixel_formats_are_rgb(tmp_path):
    image = picture(0, None, (97, 71))
    for name, codec, pixels in (("a.mkv", "ffv1", "yuv444p"), ("b.mkv", "ffv1", "gray"), ("c.mkv", "ffv1", "yuv422p")):
        video = VideoFile(write_video(tmp_path / name, [image] * 3, [0, 0.04, 0.08], codec, pixels))
        assert video.read(1).shape == (71, 97, 3) and video.read(1).dtype == np.uint8
        expected = image if pixels != "gray" else (image @ [0.299, 0.587, 0.114])[..., None]
        assert np.abs(video.read(1) - expected.astype(float)).mean() < 4
    assert float(Fraction(1, 25)) == pytest.approx(video.times[1])
