"""Commands whose inputs ask for more memory than there is: small files that announce much.

`python tests/hungry_commands.py FOLDER NUMBER...` runs some of them, each in a forked process with a limit of memory
and of time, and prints for each a line of JSON: exit code, what was said, the peak of its memory.
"""

from __future__ import annotations

import io
import json
import os
import resource
import shutil
import signal
import struct
import sys
import tarfile
import tempfile
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
from bad_commands import DATA, DECLINE, OUT, Command
from mistakes import made

LIMIT = 6 << 30
"""Bytes of address space that may be asked for: above the 1.5 GB that are allowed, so that the peak tells."""
SECONDS = 20


def png(width: int, height: int) -> bytes:
    """A PNG of grey that is honest: all its rows are there, in a few kilobytes."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packed = zlib.compressobj(1)
    row, rows = bytes(1 + width), bytearray()
    for _ in range(height):
        rows += packed.compress(row)
    rows += packed.flush()
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
        + chunk(b"IDAT", bytes(rows))
        + chunk(b"IEND", b"")
    )


def npy(shape: str, kind: str = "<f4") -> bytes:
    head = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"
    head = head.ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode() + bytes(64)


def npz(name: str, shape: str) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(f"{name}.npy", npy(shape))
        archive.writestr("meta.npy", npy("()", "<U9"))
    return buffer.getvalue()


def safetensors(header: dict | bytes, length: int | None = None) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text) if length is None else length) + text


def frames(folder: Path, camera: Path, files: dict[str, bytes]) -> None:
    (folder / "frames").mkdir(parents=True)
    shutil.copy(camera, folder / "camera.json")
    for name, content in files.items():
        (folder / "frames" / name).write_bytes(content)


def prepared(here: Path) -> None:
    """The inputs: the usual ones, and what asks for more than there is."""
    made(here)
    good = json.loads((here / "camera/camera.json").read_text())
    wide = here / "wide"
    wide.mkdir()
    (wide / "camera.json").write_text(json.dumps({**good, "width": 99999999999}))
    (wide / "large.json").write_text(json.dumps({**good, "width": 99999, "height": 99999}))
    (wide / "deep.json").write_text("[" * 200_000)
    (wide / "long.json").write_text(json.dumps({**good, "params": [1.0] * 500_000}))
    (wide / "digits.json").write_text('{"model": "PINHOLE", "width": ' + "9" * 5000 + "}")
    (wide / "laughs.xml").write_text(
        '<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a0 "ha">'
        + "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12))
        + "]><rig>&a11;</rig>"
    )
    aliases = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n"
    aliases += "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12))
    (wide / "aliases.yaml").write_text(aliases)
    (wide / "deep.yaml").write_text("[" * 100_000)
    vast = png(30_000, 30_000)
    (wide / "mask.png").write_bytes(vast)
    (wide / "mask.npy").write_bytes(npy("(3000000, 3000000)", "|u1"))
    (wide / "card.safetensors").write_bytes(safetensors(b"{}", 10 << 30))
    expanded = {"w": {"dtype": "F32", "shape": [100_000, 100_000], "data_offsets": [0, 40_000_000_000]}}
    (wide / "tensor.safetensors").write_bytes(
        safetensors({"__metadata__": {"network": "{}", "card": "{}"}, **expanded})
    )
    network = {"kind": "tiny", "width": 1_000_000}
    (wide / "network.safetensors").write_bytes(
        safetensors({"__metadata__": {"network": json.dumps(network), "card": "{}"}})
    )
    (wide / "mesh.ply").write_text(
        "ply\nformat binary_little_endian 1.0\nelement vertex 900000000000\nproperty float x\nproperty float y\n"
        "property float z\nelement face 900000000000\nproperty list uchar int vertex_indices\nend_header\n"
    )
    (wide / "many.tum").write_text("0 0 0 0 0 0 0 1\n" + "1e308 1e308 1e308 1e308 0 0 0 1\n" * 3)
    camera = here / "frames" / "camera.json"
    frames(here / "png", camera, {f"{i}.png": vast for i in range(2)})
    frames(here / "npy", camera, {f"{i}.npy": npy("(4000000, 4000000, 3)", "|u1") for i in range(2)})
    head = b"BM" + struct.pack("<IHHIIiiHHIIiiII", 100, 0, 0, 54, 40, 60_000, 60_000, 1, 24, 0, 0, 0, 0, 0, 0)
    frames(here / "bmp", camera, {f"{i}.bmp": head for i in range(2)})
    tiff = cv2.imencode(".tiff", np.zeros((8, 8), np.uint8))[1].tobytes()
    frames(here / "tiff", camera, {f"{i}.tiff": tiff[: len(tiff) // 2] for i in range(2)})
    frames(here / "ppm", camera, {f"{i}.ppm": b"P6 70000 70000 255\n" for i in range(2)})
    for name, file in (("points", "points3D.bin"), ("images", "images.bin"), ("cameras", "cameras.bin")):
        model = here / name
        model.mkdir()
        for other in ("cameras.bin", "images.bin", "points3D.bin"):
            (model / other).write_bytes(struct.pack("<Q", 0))
        (model / file).write_bytes(struct.pack("<Q", 1 << 60) + bytes(200))
    (here / "stella.msg").write_bytes(b"\xdf\xff\xff\xff\xff" + b"\x91" * 100_000)
    shutil.copytree(here / "colmap", here / "lines")
    (here / "lines" / "points3D.txt").write_text("1 " + "9" * 2_000_000 + "\n")
    scared = here / "scared"
    (scared / "data").mkdir(parents=True)
    with tarfile.open(scared / "data" / "frame_data.tar.gz", "w:gz", compresslevel=1) as tar:
        entry = tarfile.TarInfo("frame_data000000.json")
        entry.size = 200 << 20
        tar.addfile(entry, _Zeros(entry.size))
    for name in ("left.mp4", "rgb.mp4"):
        (scared / "data" / name).write_bytes(b"")
    predictions = here / "predictions"
    predictions.mkdir()
    (predictions / "000000.npz").write_bytes(npz("distance", "(1000000, 1000000)"))


class _Zeros(io.RawIOBase):
    """So many zero bytes, of which none is kept."""

    def __init__(self, size: int) -> None:
        self._left = size

    def read(self, size: int = -1) -> bytes:
        given = min(self._left, 1 << 20 if size < 0 else size)
        self._left -= given
        return bytes(given)


ROWS = [
    Command(f"convert-camera HERE/wide/camera.json {OUT}.json", words="camera.json"),
    Command(f"convert-camera HERE/wide/large.json {OUT}.json --model OPENCV --most-px .inf", words="--most-px"),
    Command(f"convert-camera HERE/wide/deep.json {OUT}.json", words="deep.json"),
    Command(f"convert-camera HERE/wide/digits.json {OUT}.json", words="digits.json"),
    Command(f"convert-camera HERE/wide/long.json {OUT}.json", words="long.json"),
    Command(f"convert-camera HERE/wide/laughs.xml {OUT}.json", words="laughs.xml"),
    Command(f"predict {DATA} {DECLINE} --config HERE/wide/aliases.yaml {OUT}", 2, "aliases.yaml"),
    Command(f"predict {DATA} {DECLINE} --config HERE/wide/deep.yaml {OUT}", 2, "deep.yaml"),
    Command(f"train --data.split HERE/wide/aliases.yaml --data.root HERE {OUT}", words="aliases.yaml"),
    Command(f"ablate --base HERE/wide/aliases.yaml {OUT}", words="no rows"),
    Command(f"predict {DATA} {DECLINE} --mask HERE/wide/mask.png {OUT}", words="mask.png"),
    Command(f"predict {DATA} {DECLINE} --mask HERE/wide/mask.npy {OUT}", words="mask.npy"),
    Command(f"import {DATA} --overlay-mask HERE/wide/mask.png {OUT}", words="mask.png"),
    Command(f"predict {DATA} --checkpoint HERE/wide/card.safetensors {OUT}", words="card.safetensors"),
    Command(f"predict {DATA} --checkpoint HERE/wide/tensor.safetensors {OUT}", words="tensor.safetensors"),
    Command(f"predict {DATA} --checkpoint HERE/wide/network.safetensors {OUT}", words="NetworkConfig.width"),
    Command(f"predict HERE/png {DECLINE} {OUT}", words="png"),
    Command(f"predict HERE/npy {DECLINE} {OUT}", words="npy"),
    Command(f"predict HERE/bmp {DECLINE} {OUT}", words="bmp"),
    Command(f"predict HERE/ppm {DECLINE} {OUT}", words="ppm"),
    Command(f"predict HERE/tiff {DECLINE} {OUT}", words="tiff"),
    Command(f"densify {DATA} --map HERE/points {DECLINE} {OUT}", words="points"),
    Command(f"densify {DATA} --map HERE/images {DECLINE} {OUT}", words="images"),
    Command(f"densify {DATA} --map HERE/cameras {DECLINE} {OUT}", words="cameras"),
    Command(f"densify {DATA} --map HERE/stella.msg {DECLINE} {OUT}", words="stella.msg"),
    Command(f"densify {DATA} --map HERE/lines {DECLINE} {OUT}", words="POINT3D_ID"),
    Command(f"sparse {DATA} --poses HERE/wide/many.tum {OUT}", words="many.tum"),
    Command(f"import HERE/scared --format scared {OUT}", words="scared"),
    Command(f"evaluate HERE/predictions --truth {DATA} {OUT}", words="000000.npz"),
    Command(f"evaluate HERE/colmap --truth {DATA} --truth-mesh HERE/wide/mesh.ply {OUT}", words="mesh.ply"),
    Command(f"synth {OUT} --frames 4 --size [10000,10000] --scene.shape.step 0.01", words="--scene.shape.step"),
]


def run_limited(command: Command, here: Path) -> dict[str, object]:
    """What comes of a command in a process of its own with limits; its peak of memory in MB."""
    with tempfile.TemporaryDirectory() as at, open(Path(at) / "said", "w+b") as said:
        (Path(at) / "cwd").mkdir()
        child = os.fork()
        if child == 0:
            code = 70
            try:
                os.chdir(Path(at) / "cwd")
                os.dup2(said.fileno(), 1)
                os.dup2(said.fileno(), 2)
                resource.setrlimit(resource.RLIMIT_AS, (LIMIT, LIMIT))
                signal.alarm(SECONDS)
                from lightdepth.cli import main

                code = main(command.argv(here, Path(at) / "cwd" / "out"))
            except SystemExit as stopped:
                code = int(stopped.code or 0)
            except BaseException:
                import traceback

                traceback.print_exc()
            finally:
                sys.stderr.flush()
                os._exit(code)
        _, status, usage = os.wait4(child, 0)
        said.seek(0)
        text = said.read().decode("utf-8", "replace")
        left = sorted(os.listdir(Path(at) / "cwd"))
    code = os.waitstatus_to_exitcode(status)
    return {"typed": command.typed, "code": code, "said": text[-3000:], "mb": usage.ru_maxrss / 1024, "left": left}


if __name__ == "__main__":
    from importlib import metadata

    from lightdepth.command_line.verbs import GROUP, verb_parser

    for verb in sorted({row.typed.split()[0] for row in ROWS}):  # so that each process need not
        (entry,) = metadata.entry_points(group=GROUP, name=verb)
        verb_parser(entry.load(), verb)
    for number in sys.argv[2:]:
        print(json.dumps(run_limited(ROWS[int(number)], Path(sys.argv[1]))), flush=True)
