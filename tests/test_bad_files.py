"""Files that declare more than they hold, or more than anybody has: refused by name, and by their headers."""

from __future__ import annotations

import io
import json
import struct
import tarfile
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import msgpack
import numpy as np
import pytest
import trimesh
from colons import CAMERA, colon
from PIL import Image
from raising import refused
from strangers import text_model
from videos import picture, write_video

from lightdepth.calibration import read_camera
from lightdepth.camera import Brown, Pinhole
from lightdepth.datasets import open_sequence, write_folder
from lightdepth.datasets.scared_files import numbered_members
from lightdepth.datasets.sequence import read_mask
from lightdepth.datasets.video import VideoFile
from lightdepth.errors import InputError
from lightdepth.files.arrays import array_in, read_arrays
from lightdepth.files.exr import read_exr, write_exr
from lightdepth.files.images import image_size, read_image
from lightdepth.files.meshes import read_mesh
from lightdepth.files.reading import reading
from lightdepth.files.schema import read_json
from lightdepth.files.tum import read_tum
from lightdepth.maps import read_map
from lightdepth.which_frame import WhichFrame

MOST_MB = 150


@contextmanager
def little_memory() -> Iterator[None]:
    """The block takes no more than `MOST_MB` of what Python and NumPy count, whatever a file declares."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < MOST_MB << 20
    finally:
        tracemalloc.stop()


# ---- the door


class _LibraryError(Exception):
    pass


@pytest.mark.parametrize(
    "error",
    [ValueError("a"), KeyError("a"), IndexError(), OverflowError("a"), struct.error("a"), zlib.error("a"), EOFError()]
    + [
        NotImplementedError("a"),
        RuntimeError("encrypted"),
        _LibraryError("a\nb" * 200),
        OSError(13, "no right"),
        OSError(),
    ]
    + [MemoryError(), RecursionError(), tarfile.ReadError("a"), zipfile.BadZipFile("a"), cv2.error("a")]
    + [Image.DecompressionBombError("a"), UnicodeDecodeError("utf-8", b"\xff", 0, 1, "a")],
    ids=repr,
)
def test_whatever_a_library_raises_is_told_of_the_file_in_one_short_line(error):
    with refused(where="file.bin") as raised, reading("file.bin", "a map"):
        raise error
    assert "\n" not in str(raised.value) and len(str(raised.value)) < 400
    assert raised.value.__cause__ is error


def test_what_says_more_already_and_our_own_mistakes_pass_through():
    with refused(where="line 3", found="x"), reading("file.bin"):
        raise InputError("line 3", "x", "y")
    with pytest.raises(OSError), reading("file.bin"):
        raise OSError(5, "the disk, not the file")
    lightdepth_s = {"__name__": "lightdepth.made_up"}
    with pytest.raises(AssertionError), reading("file.bin"):
        exec(compile("def f():\n    assert False, 'ours'\nf()", "made_up", "exec"), lightdepth_s)
    with refused(where="file.bin"), reading("file.bin"):
        exec(compile("def f():\n    assert False\nf()", "made_up", "exec"), {"__name__": "trimesh.made_up"})


# ---- numbers

OURS = {"model": "PINHOLE", "width": 96, "height": 80, "params": [50.0, 50.0, 48.0, 40.0]}
CALIBRATIONS = {
    "a side of 20 digits": ("a.json", json.dumps({**OURS, "width": 10**20})),
    "a side of 5000 digits": ("a.json", json.dumps(OURS).replace("96", "9" * 5000)),
    "a side of 65536": ("a.json", json.dumps({**OURS, "width": 65536, "params": [5e4, 5e4, 3e4, 40.0]})),
    "a focal length of 1e-300": ("a.json", json.dumps({**OURS, "params": [1e-300, 50.0, 48.0, 40.0]})),
    "a focal length of 1e308": ("a.json", json.dumps({**OURS, "params": [1e308, 50.0, 48.0, 40.0]})),
    "NaN": ("a.json", json.dumps({**OURS, "params": [float("nan"), 50.0, 48.0, 40.0]})),
    "brackets": ("a.json", "[" * 100_000),
    "braces in YAML": ("a.yaml", "{" * 1200),
    "an id of 30 digits": ("cameras.txt", f"{'1' * 30} PINHOLE 96 80 50 50 48 40\n"),
    "a number of 5000 digits": ("cameras.txt", f"{'1' * 5000} PINHOLE 96 80 50 50 48 40\n"),
    "a side of 30 digits": ("cameras.txt", f"1 PINHOLE {'9' * 30} 80 50 50 48 40\n"),
    "a side of infinity": (
        "a.yaml",
        "image_width: .inf\nimage_height: 80\nK: [[5, 0, 4], [0, 5, 4], [0, 0, 1]]\nD: [0]\n",
    ),
    "elements in one another": ("a.xml", "<a>" * 50_000),
    "17 MB": ("a.yaml", "# " + "x" * (17 << 20)),
    "an empty file": ("a.mat", ""),
}


@pytest.mark.parametrize("what", CALIBRATIONS)
def test_a_calibration_of_numbers_that_no_camera_has_is_refused(tmp_path, what):
    name, text = CALIBRATIONS[what]
    (tmp_path / name).write_text(text)
    with refused(where=name):
        read_camera(tmp_path / name)


def test_terms_of_a_lens_without_size_are_none():
    points = np.array([[0.1, 0.2, 1.0]])
    tiny = Brown(96, 80, 50.0, 50.0, 48.0, 40.0, 6e-314, 1e-320, 0.0, 0.0)
    np.testing.assert_allclose(tiny.project(points)[0], Pinhole(96, 80, 50.0, 50.0, 48.0, 40.0).project(points)[0])


@pytest.mark.parametrize("name", ["9" * 30 + ".png", "x" + "1" * 300 + ".png", "9" * 5000, "9" * 400 + ".5s"])
def test_a_name_with_a_number_that_nothing_counts_to_is_refused(name):
    with refused() as raised:
        WhichFrame.named(name)
    assert len(str(raised.value)) < 300
    assert WhichFrame.named("a" * 300 + "0001403636579763555.png").number == 1403636579763555


@pytest.mark.parametrize(
    "line", ["0 1e308 0 0 0 0 0 1", "0 1e13 0 0 0 0 0 1", "0 0 0 0 0 0 0 0", "1e308 0 0 0 0 0 0 1"]
)
def test_a_pose_beyond_any_map_is_refused_with_its_line(tmp_path, line):
    (tmp_path / "poses.tum").write_text("0 0 0 0 0 0 0 1\n" + line + "\n")
    with refused(where="poses.tum", found="line 2"):
        read_tum(tmp_path / "poses.tum")


MODELS: dict[str, tuple[str, Callable[[str], str]]] = {
    "a point at 1e308": ("points3D.txt", lambda text: text + "999999 1e308 0 0 1 2 3 0\n"),
    "a point at 1e13": ("points3D.txt", lambda text: text + "999999 1e13 0 0 1 2 3 0\n"),
    "a point's id of 30 digits": ("points3D.txt", lambda text: text + f"{'9' * 30} 0 0 1 1 2 3 0\n"),
    "a frame's number of 30 digits": ("images.txt", lambda text: text.replace("000000", "9" * 30)),
    "a name of 5000 digits": ("images.txt", lambda text: text.replace("000000", "9" * 5000)),
    "a quaternion of zero": ("images.txt", lambda text: text + "9 0 0 0 0 0 0 0 1 000099.png\n\n"),
}


@pytest.mark.parametrize("what", MODELS)
def test_a_map_of_numbers_that_no_map_has_is_refused(tmp_path, what):
    name, change = MODELS[what]
    text_model(tmp_path)
    (tmp_path / name).write_text(change((tmp_path / name).read_text()))
    with refused():
        read_map(tmp_path)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_binary_map_that_counts_to_2_to_the_60_ends_too_early(tmp_path, name):
    one = struct.pack("<QIiQQ4d", 1, 1, 1, 96, 80, 50, 50, 48, 40)
    for part in ("cameras.bin", "images.bin", "points3D.bin"):
        (tmp_path / part).write_bytes(one if part == "cameras.bin" else struct.pack("<Q", 0))
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(struct.pack("<Q", 2**60) + content[8:])
    with little_memory(), refused(where=name, found="ends too early"):
        read_map(tmp_path)


def test_lists_in_one_another_that_announce_millions_take_no_memory(tmp_path):
    (tmp_path / "a.msg").write_bytes((b"\xdd" + struct.pack(">I", 60_000)) * 500 + b"\x80" * 100_000)
    tracemalloc.start()
    try:
        with refused(where="a.msg"):
            read_map(tmp_path / "a.msg")
        assert tracemalloc.get_traced_memory()[1] < 500 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "content",
    [{b"\xff": 1}, {(1, 2): 3}, msgpack.ExtType(5, b"x"), {"cameras": msgpack.Timestamp(1)}, [[]], 7, None],
    ids=repr,
)
def test_a_stella_map_of_anything_else_is_refused(tmp_path, content):
    (tmp_path / "a.msg").write_bytes(msgpack.packb(content))
    with refused(where="a.msg"):
        read_map(tmp_path / "a.msg")


# ---- pictures


def _png_header(width: int, height: int) -> bytes:
    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    data = b"IDAT" + zlib.compress(b"\0" * 1000)
    chunks = (struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in (head, data, b"IEND"))
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def _tiff_header(width: int, height: int) -> bytes:
    tags = [(256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 8), (262, 3, 1, 1), (273, 4, 1, 8), (279, 4, 1, 8)]
    entries = b"".join(struct.pack("<HHII", *tag) for tag in tags)
    return b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", len(tags)) + entries + struct.pack("<I", 0)


def _bmp_header(width: int, height: int) -> bytes:
    return b"BM" + struct.pack("<IIIIiiHHIIiiII", 100, 0, 54, 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0) + b"\0" * 60


def _gif_header(width: int, height: int) -> bytes:
    return (
        b"GIF89a"
        + struct.pack("<HHBBB", width, height, 0, 0, 0)
        + b"\x2c"
        + struct.pack("<4HB", 0, 0, width, height, 0)
    )


HUGE = {"png": _png_header, "tif": _tiff_header, "bmp": _bmp_header, "gif": _gif_header}


@pytest.mark.parametrize("size", [(30_000, 30_000), (65_000, 65_000), (9_000, 9_000), (2**31 - 1, 1)], ids=str)
@pytest.mark.parametrize("kind", HUGE)
def test_a_picture_of_more_than_8k_is_refused_before_it_is_decoded(tmp_path, kind, size):
    if kind == "gif" and max(size) > 65535:
        return
    path = tmp_path / f"0.{kind}"
    path.write_bytes(HUGE[kind](*size))
    for read in (image_size, read_image, read_mask):
        with little_memory(), refused(where=f"0.{kind}"):
            read(path)


def test_an_exr_larger_than_8k_is_refused_by_its_header(tmp_path):
    write_exr(tmp_path / "0.exr", np.ones((4, 4), np.float32))
    data = (tmp_path / "0.exr").read_bytes()
    window = struct.pack("<4i", 0, 0, 3, 3)
    (tmp_path / "0.exr").write_bytes(data.replace(window, struct.pack("<4i", 0, 0, 59_999, 59_999)))
    with little_memory(), refused(where="0.exr", found="60000x60000"):
        read_exr(tmp_path / "0.exr")


@pytest.mark.parametrize("side", [1, 7])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_frames_of_a_few_pixels_are_refused(tmp_path, side):
    write_folder(colon(0, 2, 3.0, CAMERA.resized(side, side)).frames, tmp_path / "frames")
    with refused(found=f"{side}x{side}"):
        open_sequence(tmp_path / "frames")


# ---- archives


def _npy(shape: tuple[int, ...], kind: str = "<f4", data: bytes = b"") -> bytes:
    made = io.BytesIO()
    np.lib.format.write_array_header_1_0(made, {"descr": kind, "fortran_order": False, "shape": shape})
    return made.getvalue() + data


@pytest.mark.parametrize(
    "shape", [(10**6, 10**6), (2**31, 2**31), (2**62, 8), (10_000, 10_000), (-1,), (10**40,), (0, 2**62)], ids=str
)
def test_an_array_that_declares_more_than_it_holds_takes_no_memory(shape):
    with little_memory(), refused(where="0.npy"):
        array_in(_npy(shape), "0.npy")


def test_arrays_come_back_as_numpy_saved_them():
    rng = np.random.default_rng(0)
    for array in (rng.normal(size=(3, 4)), np.asfortranarray(rng.normal(size=(3, 4))), np.array(5), np.zeros((0, 3))):
        made = io.BytesIO()
        np.save(made, array)
        found = array_in(made.getvalue(), "0.npy")
        np.testing.assert_array_equal(found, array)
        assert found.dtype == array.dtype and found.flags.writeable


def _zip(path: Path, data: bytes, method: int = zipfile.ZIP_DEFLATED) -> None:
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("depth.npy", data)


def _encrypted(path: Path) -> None:
    _zip(path, _npy((2,), data=b"\0" * 8))
    data = bytearray(path.read_bytes())
    for mark, at in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
        data[data.index(mark) + at] |= 1
    path.write_bytes(bytes(data))


def _declared(path: Path) -> None:
    _zip(path, _npy((2,), data=b"\0" * 8))
    data = bytearray(path.read_bytes())
    for mark, at in ((b"PK\3\4", 22), (b"PK\1\2", 24)):
        struct.pack_into("<I", data, data.index(mark) + at, 600 << 20)
    path.write_bytes(bytes(data))


def _other_method(path: Path) -> None:
    _zip(path, _npy((2,), data=b"\0" * 8))
    data = bytearray(path.read_bytes())
    for mark, at in ((b"PK\3\4", 8), (b"PK\1\2", 10)):
        data[data.index(mark) + at] = 97
    path.write_bytes(bytes(data))


ZIPS: dict[str, Callable[[Path], object]] = {
    "bzip2": lambda path: _zip(path, _npy((2,), data=b"\0" * 8), zipfile.ZIP_BZIP2),
    "LZMA": lambda path: _zip(path, _npy((2,), data=b"\0" * 8), zipfile.ZIP_LZMA),
    "a method of nobody's": _other_method,
    "encrypted": _encrypted,
    "600 MB from a few bytes": _declared,
    "1000 zeros for one byte": lambda path: _zip(path, _npy((2**28,)) + b"\0" * (8 << 20)),
    "a declared terabyte": lambda path: _zip(path, _npy((2**38,))),
    "Python objects": lambda path: np.savez(path, depth=np.array([{}], dtype=object)),
    "no array": lambda path: _zip(path, b"text"),
    "cut off": lambda path: (_zip(path, b"x" * 1000), path.write_bytes(path.read_bytes()[:60])),
}


@pytest.mark.parametrize("what", ZIPS)
def test_an_npz_of_another_make_is_refused_by_its_directory(tmp_path, what):
    ZIPS[what](tmp_path / "0.npz")
    with little_memory(), refused(where="0.npz"):
        read_arrays(tmp_path / "0.npz")


def _tar(path: Path, name: str, size: int, kind: bytes = tarfile.REGTYPE, count: int = 1) -> None:
    with tarfile.open(path, "w:gz", compresslevel=1) as tar:
        for i in range(count):
            entry = tarfile.TarInfo(name % i if "%" in name else name)
            entry.size, entry.type = size, kind
            tar.addfile(entry, io.BytesIO(bytes(size)))


def test_headers_of_an_archive_are_not_unpacked_into_memory(tmp_path):
    _tar(tmp_path / "a.tar.gz", "x", 200 << 20, tarfile.XHDTYPE)
    with little_memory(), refused(where="a.tar.gz", found="bytes"):
        numbered_members(tmp_path, "a", r"a(\d+)\.json").all()  # type: ignore[union-attr]


def test_members_that_unpack_to_gigabytes_are_refused(tmp_path):
    _tar(tmp_path / "a.tar.gz", "a%d.json", 2 << 20)
    with little_memory(), refused(where="a.tar.gz", found="bytes"):
        numbered_members(tmp_path, "a", r"a(\d+)\.json").all()  # type: ignore[union-attr]
    _tar(tmp_path / "b.tar.gz", "other%d", 90 << 20, count=3)
    with little_memory(), refused(where="b.tar.gz", found="once unpacked"):
        numbered_members(tmp_path, "b", r"b(\d+)\.json").all()  # type: ignore[union-attr]


def test_an_archive_that_is_no_gzip_is_not_tried_by_what_takes_the_memory_it_asks_for(tmp_path):
    header = b".\xff\xff\xff\xff" + (1 << 23).to_bytes(8, "little")  # LZMA's, with a dictionary of 4 GB
    (tmp_path / "a.tar.gz").write_bytes(header + bytes(5000))
    with little_memory(), refused(where="a.tar.gz", found="not a readable archive"):
        numbered_members(tmp_path, "a", r"a(\d+)\.json").all()  # type: ignore[union-attr]


# ---- meshes and videos


def test_a_mesh_whose_triangles_have_no_vertices_is_refused(tmp_path):
    box = trimesh.creation.box()
    box.export(tmp_path / "a.obj")
    (tmp_path / "a.obj").write_text((tmp_path / "a.obj").read_text() + "f 1 2 99999999\n")
    with refused(where="a.obj"):
        read_mesh(tmp_path / "a.obj")


def test_a_mesh_s_file_leads_to_no_other(tmp_path):
    (tmp_path / "canary.bin").write_bytes(b"\0" * 1000)
    content = {"asset": {"version": "2.0"}, "buffers": [{"uri": "canary.bin", "byteLength": 1000}]}
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    with refused(where="a.gltf", found="ends in .gltf"):
        read_mesh(tmp_path / "a.gltf")


def test_a_video_that_announces_billions_of_frames_is_refused(tmp_path):
    path = write_video(tmp_path / "a.mp4", [picture(i) for i in range(3)], [0, 0.04, 0.08])
    data = bytearray(path.read_bytes())
    at = data.index(b"stsz")
    struct.pack_into(">II", data, at + 8, 1, 2**32 - 1)  # every sample of one byte
    path.write_bytes(bytes(data))
    with little_memory(), refused(where="a.mp4"):
        VideoFile(path).read(0)


def test_json_of_brackets_in_one_another_names_its_file(tmp_path):
    (tmp_path / "a.json").write_text('{"a":' * 50_000)
    with refused(where="a.json"):
        read_json(tmp_path / "a.json")
