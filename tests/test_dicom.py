"""DICOM files through the command line: read with true times, nothing kept that tells a patient, refused by header."""

from __future__ import annotations

import json
import pickle
import struct
import sys
import warnings
from pathlib import Path

import numpy as np
import pydicom
import pytest
from dicom_files import CANARY, KINDS, write_dicom, write_dicom_video
from raising import refused, warned
from test_picture_rows import predicted, refusal
from videos import CAMERA, OCTAGON, picture, write_video

from lightdepth.calibration import write_camera
from lightdepth.cli import main
from lightdepth.datasets import VideoFile, open_sequence
from lightdepth.datasets.video_sequence import open_clip, video_at

COUNT = 4
LOSSY = {"JPEG": 0.02, "JPEG in fragments": 0.02, "native YBR": 0.01, "native YBR 422": 0.02}


@pytest.fixture
def folder(tmp_path) -> Path:
    write_camera(CAMERA, tmp_path / "camera.json")
    return tmp_path


def images(count: int = COUNT) -> list[np.ndarray]:
    return [picture(i) for i in range(count)]


@pytest.mark.parametrize("kind", KINDS)
def test_pictures_of_every_kind_are_those_that_were_written(folder, kind):
    path = write_dicom(folder / "clip.dcm", images(), kind)
    clip = open_clip(path)
    assert (len(clip), clip.width, clip.height) == (COUNT, 256, 208)
    assert clip.bits == (12 if "12" in kind else 8)
    top = 65535 if "12" in kind else 255
    for i in (2, 0, 3):
        expected = picture(i) / 255
        if "grey" in kind:
            expected = np.repeat(expected.mean(-1, keepdims=True), 3, -1)
        off = np.abs(clip.read(i) / top - expected)
        assert off.mean() < LOSSY.get(kind, 2.1e-3 if "grey" in kind else 1e-9)


@pytest.mark.parametrize("name", ["clip.dcm", "CLIP.DCM", "1.2.840.10008.42", "IM000001"])
def test_they_are_found_by_ending_or_mark(folder, name):
    path = write_dicom(folder / name, images())
    assert video_at(path) == path and video_at(folder) == path


def test_the_command_line_makes_of_them_what_it_makes_of_the_same_pictures_in_a_video(folder):
    path = write_dicom(folder / "IM000001", images())
    found = predicted(path, folder / "out")
    lossless = write_video(folder / "a.mkv", images(), np.arange(COUNT) / 25, "ffv1", "bgr0")
    expected = predicted(lossless, folder / "expected")
    assert list(found) == list(expected)
    assert all(np.array_equal(found[n], expected[n], equal_nan=True) for n in expected)
    again = pickle.loads(pickle.dumps(open_sequence(path)))
    assert again[2].time == pytest.approx(0.08) and again[2].image.shape == (208, 256, 3)


@pytest.mark.parametrize(
    ("elements", "times"),
    [
        ({}, [0, 0.04, 0.08, 0.12]),
        ({"FrameTimeVector": [0, 40, 60, 20]}, [0, 0.04, 0.1, 0.12]),
        ({"FrameTime": None, "CineRate": 50}, [0, 0.02, 0.04, 0.06]),
        ({"FrameTime": None, "RecommendedDisplayFrameRate": 20}, [0, 0.05, 0.1, 0.15]),
        ({"FrameTime": 0, "CineRate": 10}, [0, 0.1, 0.2, 0.3]),
        ({"FrameTime": None}, None),
    ],
)
def test_times_are_the_header_s(folder, elements, times):
    frames = open_sequence(write_dicom(folder / "a.dcm", images(), **elements))
    assert [f.time for f in frames] == ([None] * COUNT if times is None else pytest.approx(times))


def test_a_vector_of_steps_that_no_clip_has_is_left_aside(folder):
    path = write_dicom(folder / "a.dcm", images(), FrameTimeVector=[0, 1e300, 1e300, 1e300])
    with warned("FrameTimeVector", "4 frames"):
        assert open_sequence(path)[2].time == pytest.approx(0.08)


def test_a_vector_of_times_of_another_length_is_left_aside_and_said(folder):
    path = write_dicom(folder / "a.dcm", images(), FrameTimeVector=[0, 40])
    with warned("FrameTimeVector", "4 frames"):
        assert open_sequence(path)[2].time == pytest.approx(0.08)


@pytest.mark.parametrize("kind", ["native RGB", "JPEG", "video"])
def test_nothing_that_tells_the_patient_is_kept(folder, tmp_path_factory, capsys, kind):
    count = 6
    if kind == "video":
        inner = write_video(folder / "inner.mp4", images(count), np.arange(count) / 25, tags={"title": CANARY})
        path = write_dicom_video(folder / f"{CANARY}.dcm", inner, (208, 256), count)
        inner.unlink()
    else:
        path = write_dicom(folder / f"{CANARY}.dcm", images(count), kind)
    assert path.read_bytes().count(CANARY.encode()) >= 15
    out = tmp_path_factory.mktemp("out")
    options = ["--every", "1", "--blur", "0", "--find_text", "false"]
    assert main(["import", str(path), "-o", str(out / "kept"), *options]) == 0
    assert main(["import", str(path), "-o", str(out / "mailed"), "--no-frames", *options]) == 0
    assert len(open_sequence(out / "kept")) == count
    if kind == "JPEG":
        plain = path.rename(folder / "plain.dcm")  # a name of the user's own choice may be in run.json of other verbs
        assert main(["predict", str(plain), "-o", str(out / "predicted"), "--checkpoint", "decline"]) == 0
        assert main(["select", str(plain), "-o", str(out / "list.txt")]) == 0
    written = [f for f in out.rglob("*") if f.is_file()]
    assert len(written) > count
    for file in written:
        everything = (str(file.relative_to(out)).encode() + file.read_bytes()).lower()
        for secret in (
            CANARY.lower().encode(),
            b"19500101",
            b"20210304",
            b"050607",
            CANARY.lower().encode("utf-16-le"),
        ):
            assert secret not in everything, file
    said = json.loads((out / "kept" / "run.json").read_text())["findings"]
    assert any("carries metadata (" in f["found"] and "DICOM header" in f["found"] for f in said)
    assert CANARY not in capsys.readouterr().err.replace(f"{CANARY}.dcm", "")


def test_a_video_in_a_dicom_file_is_read_in_place_with_its_own_times(folder):
    times = [0, 0.03, 0.1, 0.14, 0.2]
    inner = write_video(folder / "inner.mp4", images(5), times, bf="2")
    path = write_dicom_video(folder / "a.dcm", inner, (208, 256), 5)
    frames = open_sequence(path)
    assert [f.time for f in frames] == pytest.approx(times, abs=1e-3)
    whole = VideoFile(inner)
    clip = pickle.loads(pickle.dumps(open_clip(path)))
    assert all(np.array_equal(clip.read(i), whole.read(i)) for i in (3, 1, 4))


def test_a_bare_stream_has_the_times_of_the_header(folder):
    inner = write_video(folder / "inner.h264", images(5), np.arange(5) / 25, bf="0")
    clip = open_clip(write_dicom_video(folder / "a.dcm", inner, (208, 256), 5, FrameTime=20.0))
    assert clip.times == pytest.approx(np.arange(5) / 50)


def test_text_that_the_header_says_is_burnt_in_is_said(folder):
    path = write_dicom(folder / "a.dcm", images(), BurnedInAnnotation="YES")
    with warned("burnt into"):
        open_sequence(path)


def test_without_pydicom_one_line_names_the_extra(folder, monkeypatch, capsys):
    path = write_dicom(folder / "a.dcm", images())
    monkeypatch.setitem(sys.modules, "pydicom", None)
    said = refusal(capsys, "import", path, "-o", folder / "out")
    assert "a DICOM file, and pydicom is not installed; install it: pip install 'lightdepth[dicom]'" in said
    assert len(said.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("elements", "found"),
    [
        ({"Rows": 65535, "Columns": 65535}, "DICOM pictures of 65535x65535"),
        ({"NumberOfFrames": 10**9}, "announces 1000000000 frames of 256x208, and 4 are in the file"),
        ({"NumberOfFrames": 10**5}, "announces 100000 frames of 256x208, and 4 are in the file"),
        ({"Rows": 0}, "DICOM pictures of 256x0"),
        ({"Rows": 8000, "Columns": 8000}, "announces 4 frames of 8000x8000, and 0 are in the file"),
        ({"PhotometricInterpretation": "PALETTE COLOR", "SamplesPerPixel": 1}, "DICOM colours PALETTE COLOR"),
        ({"BitsAllocated": 32, "BitsStored": 32}, "DICOM samples of 32 bits in 32"),
        ({"PixelRepresentation": 1}, "DICOM samples of 8 bits in 8"),
    ],
)
@pytest.mark.parametrize("kind", ["native RGB"])
def test_what_cannot_be_read_is_refused_by_its_header(folder, capsys, kind, elements, found):
    path = write_dicom(folder / "a.dcm", images(), kind, **elements)
    assert found in refusal(capsys, "import", path, "-o", folder / "out")
    assert not (folder / "out").exists()


@pytest.mark.parametrize(
    ("syntax", "found"),
    [
        ("1.2.840.10008.1.2.1.99", "Deflated Explicit VR Little Endian"),
        ("1.2.840.10008.1.2.2", "Explicit VR Big Endian"),
        ("1.2.840.10008.1.2.4.70", "no decoder is installed"),
        ("1.2.840.10008.1.2.4.80", "no decoder is installed"),
        ("1.2.3.4", "a private one"),
    ],
)
def test_other_encodings_are_named(folder, capsys, syntax, found):
    path = write_dicom(folder / "a.dcm", images(), "JPEG")
    old, new = b"1.2.840.10008.1.2.4.50", syntax.encode()
    path.write_bytes(path.read_bytes().replace(old, new.ljust(len(old), b"\0"), 1))
    assert found in refusal(capsys, "predict", path, "-o", folder / "out")


def test_a_picture_of_another_size_than_the_header_says_is_refused(folder):
    path = write_dicom(folder / "a.dcm", images(), "JPEG", Rows=100)
    with refused(found="a picture of 256x208 where the header says 256x100"):
        open_sequence(path)


@pytest.mark.parametrize("kind", ["native RGB", "RLE", "JPEG", "JPEG in fragments"])
def test_of_a_file_cut_off_the_frames_there_are_given_and_the_others_refused(folder, kind):
    path = write_dicom(folder / "a.dcm", images(), kind)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * 0.8)])
    frames = open_sequence(path)
    assert len(frames) == COUNT and np.abs(frames[1].image - picture(1) / 255)[OCTAGON].mean() < 0.02
    with refused("which was cut off … 3"):
        frames[3]


@pytest.mark.parametrize("kind", ["native RGB", "RLE", "JPEG"])
def test_a_broken_file_is_refused_or_read_and_says_nothing_of_the_patient(folder, kind):
    data = write_dicom(folder / "whole.dcm", images(2), kind).read_bytes()
    rng = np.random.default_rng(7)
    for _ in range(40):
        broken = bytearray(data)
        for at in rng.integers(132, min(len(data), 2200), 6):
            broken[at] = rng.integers(256)
        (folder / "broken.dcm").write_bytes(broken)
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            try:
                clip = open_clip(folder / "broken.dcm")
                clip.read(0)
            except Exception as error:
                assert type(error).__name__ == "InputError", error
                assert CANARY not in str(error)
        assert not any(CANARY in str(w.message) for w in warned)


def test_items_without_end_and_elements_longer_than_the_file_are_refused(folder):
    data = write_dicom(folder / "a.dcm", images(2), "JPEG").read_bytes()
    at = data.index(struct.pack("<HH", 0xFFFE, 0xE000), data.index(struct.pack("<HH", 0x7FE0, 0x0010)))
    (folder / "b.dcm").write_bytes(data[:at] + b"\x12\x34" + data[at + 2 :])
    with refused(found="items are broken"):
        open_clip(folder / "b.dcm")
    (folder / "c.dcm").write_bytes(data[: at + 4] + b"\xf0\xff\xff\xff" + data[at + 8 :])
    with refused(found="0 are in the file"):
        open_clip(folder / "c.dcm")
    (folder / "d.dcm").write_bytes(b"no mark")
    with refused(found="the mark DICM is missing"):
        open_clip(folder / "d.dcm")
    meta = pydicom.dcmread(folder / "a.dcm")
    del meta.PixelData
    meta.save_as(folder / "e.dcm")
    with refused(found="without pictures"):
        open_clip(folder / "e.dcm")


@pytest.mark.parametrize("length", [0, 7, 2**31])
def test_a_jpeg_2000_picture_with_a_box_of_no_length_is_refused_and_not_read_for_ever(folder, length):
    data = write_dicom(folder / "a.dcm", images(1), "JPEG 2000").read_bytes()
    at = data.index(b"ftyp", data.index(b"jP  ")) - 4
    (folder / "b.dcm").write_bytes(data[:at] + struct.pack(">I", length) + data[at + 4 :])
    with refused(found="whose boxes are broken"):
        open_clip(folder / "b.dcm")


def test_several_files_of_a_series_are_named_and_one_is_asked_for(folder):
    for i in range(6):
        write_dicom(folder / f"IM{i:05d}", images(1))
    with refused(found="6 videos (IM00000, IM00001, IM00002, IM00003 and 2 more)", cure="give one of them"):
        open_sequence(folder)
