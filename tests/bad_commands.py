"""Commands that cannot work, on small data: what is typed, how it ends, and what is said of it.

Inputs are made once, in one folder, HERE, which no command may change. HERE/bad holds files of every ending that are
empty, of text, of random bytes, or half of a good one.
"""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from mistakes import made

from lightdepth.cli import main


@dataclass(frozen=True)
class Command:
    """What is typed (`HERE/` is the inputs, `OUT` a place of its own), the exit code, and words of the message."""

    typed: str
    code: int = 3
    words: str = ""
    fault: str = ""
    """What is known to be wrong with the answer; the row is expected to fail until that is mended."""

    @property
    def verb(self) -> str:
        return self.typed.split()[0]

    def argv(self, here: Path, out: Path) -> list[str]:
        """The words; `~` stands for a space inside one."""
        words = self.typed.replace("HERE", str(here)).replace("OUT", str(out)).split(" ")
        return [word.replace("~", " ") for word in words if word]


GOOD = {
    "json": "camera/camera.json",
    "png": "frames/frames/000000.png",
    "tum": "tum/KeyFrameTrajectory.txt",
    "xml": "camera/Endoscope_01_geometrical.xml",
    "yaml": "camera/camera.yaml",
    "npz": "predictions/000000.npz",
    "ply": "dense/map_000/mesh.ply",
}
DATA = "HERE/frames"
DECLINE = "--checkpoint decline"
OUT = "-o OUT"
HIDDEN = Path(os.sep) / "proc" / "version" / "none"  # below a file: no folder can be made there


def prepared(here: Path) -> None:
    """All that the commands are given."""
    made(here)
    run = ["--checkpoint", "decline"]
    assert main(["predict", str(here / "frames"), "-o", str(here / "predictions"), "--no-previews", *run]) == 0
    densify = ["densify", str(here / "frames"), "--map", str(here / "colmap"), "--judge.no-on", "--no-fit-light"]
    assert main([*densify, "-o", str(here / "dense"), *run]) == 0
    bad = here / "bad"
    bad.mkdir()
    rng = np.random.default_rng(0)
    for ending in (*GOOD, "txt", "safetensors", "mp4", "dcm", "csv"):
        (bad / f"empty.{ending}").write_bytes(b"")
        (bad / f"text.{ending}").write_text("these are words\nand no numbers\n")
        (bad / f"bytes.{ending}").write_bytes(rng.bytes(3000))
    for ending, good in GOOD.items():
        whole = (here / good).read_bytes()
        (bad / f"half.{ending}").write_bytes(whole[: len(whole) // 2])
    (bad / "folder").mkdir()
    (bad / "list.yaml").write_text("- 1\n- 2\n")
    (bad / "key.yaml").write_text("no_such_setting: 3\n")
    (bad / "seed.yaml").write_text("seed: -4\n")
    (bad / "value.yaml").write_text("overwrite: [many, words]\n")
    (bad / "tabs.yaml").write_text("a:\n\t- b: [\n")
    (bad / "join.json").write_text(json.dumps({"first": 0, "second": 1}))
    (bad / "nan.json").write_text((here / "camera/camera.json").read_text().replace("52.0", "NaN"))
    (bad / "huge.json").write_text((here / "camera/camera.json").read_text().replace("96", "99999999999999999999"))
    (bad / "negative.json").write_text((here / "camera/camera.json").read_text().replace("52.0", "-52.0"))
    (bad / "zero.tum").write_text("0 0 0 0 0 0 0 0\n")
    (bad / "nan.tum").write_text("0 nan 0 0 0 0 0 1\n")
    (bad / "huge.tum").write_text("1e308 1e308 1e308 1e308 0 0 0 1\n")
    cv2.imwrite(str(bad / "grey.png"), np.linspace(0, 255, 96 * 80).reshape(80, 96).astype(np.uint8))
    cv2.imwrite(str(bad / "small.png"), np.full((10, 10), 255, np.uint8))
    cv2.imwrite(str(bad / "black.png"), np.zeros((80, 96), np.uint8))
    for name in ("bare", "mixed", "onepixel", "blackness", "numberless"):
        (here / name / "frames").mkdir(parents=True)
        if name != "bare":
            shutil.copy(here / "frames" / "camera.json", here / name)
    for i in range(3):
        shutil.copy(here / "frames" / "frames" / f"{i:06d}.png", here / "bare" / "frames")
        shutil.copy(here / "frames" / "frames" / f"{i:06d}.png", here / "numberless" / "frames" / f"{'abc'[i]}.png")
        cv2.imwrite(str(here / "mixed" / "frames" / f"{i}.png"), np.full((80 + i, 96), 90, np.uint8))
        cv2.imwrite(str(here / "onepixel" / "frames" / f"{i}.png"), np.full((1, 1), 90, np.uint8))
        cv2.imwrite(str(here / "blackness" / "frames" / f"{i}.png"), np.zeros((80, 96), np.uint8))
    shutil.copytree(here / "colmap", here / "halfmap")
    (here / "halfmap" / "points3D.txt").unlink()
    shutil.copytree(here / "colmap", here / "othermap")
    images = (here / "othermap" / "images.txt").read_text()
    (here / "othermap" / "images.txt").write_text(images.replace("00000", "90000"))
    (here / "file").write_text("a file")
    (here / "others").mkdir()
    (here / "others" / "thesis.txt").write_text("years of work")


# ---- the same mistakes in many verbs

READS_FRAMES = {
    "predict": DECLINE,
    "import": "",
    "calibrate-light": "--map HERE/colmap",
    "select": "",
    "adapt": "",
    "sparse": "",
    "densify": f"--map HERE/colmap {DECLINE}",
    "live": f"--map HERE/colmap {DECLINE}",
}
"""Verbs that read frames, with what else they need."""
OUTPUTS = {
    "demo": "",
    "synth": "--frames 3",
    "ablate": "",
    "bench": "",
    "bench estimators": "",
    "evaluate": "",
    "export": "",
    "convert-camera": "",
    "train": "",
}
"""The other verbs that make something."""


def _rows() -> list[Command]:
    rows = []
    for verb, more in READS_FRAMES.items():
        for wrong in ("HERE/nowhere", "HERE/bad/folder", "HERE/bad/text.txt", "HERE/bad/bytes.mp4", "HERE/numberless"):
            rows.append(Command(f"{verb} {wrong} {more} {OUT}", words=wrong.rpartition("/")[2]))
        for wrong in (
            "empty.json",
            "text.json",
            "bytes.json",
            "half.json",
            "nan.json",
            "negative.json",
            "none.json",
            "folder",
        ):
            rows.append(Command(f"{verb} {DATA} --camera HERE/bad/{wrong} {more} {OUT}", words=wrong))
        for wrong in ("empty.png", "text.png", "half.png", "grey.png", "small.png", "none.png", "folder"):
            rows.append(Command(f"{verb} {DATA} --mask HERE/bad/{wrong} {more} {OUT}", words=wrong))
        rows.append(Command(f"{verb} {DATA} --format colmap {more} {OUT}", 2, "expected one of folder"))
        rows.append(Command(f"{verb} {DATA} --format hamlyn {more} {OUT}", words="Hamlyn"))
        rows.append(Command(f"{verb} {DATA} --bit-depth 99 {more} {OUT}", words="--bit-depth: 99"))
        rows.append(Command(f"{verb} {DATA} --kamera x {more} {OUT}", 2, "did you mean --camera?"))
        rows.append(Command(f"{verb} {DATA} {more}", 2, "missing: -o OUTPUT"))
        rows.append(Command(f"{verb} {more} {OUT}", 2, "missing: DATA"))
    for verb in ("calibrate-light", "select", "adapt", "densify", "live"):
        more = DECLINE if verb in ("densify", "live") else ""
        for wrong in ("nowhere", "bad/folder", "bad/text.txt", "bad/half.tum", "halfmap", "othermap", "frames"):
            rows.append(Command(f"{verb} {DATA} --map HERE/{wrong} {more} {OUT}", words=wrong.rpartition("/")[2]))
        rows.append(Command(f"{verb} {DATA} --map-fps 0 {more} {OUT}", words="--map-fps: 0"))
    for verb in ("predict", "densify", "live", "adapt"):
        more = "" if verb in ("predict", "adapt") else "--map HERE/colmap"
        for wrong in ("empty.safetensors", "text.safetensors", "bytes.safetensors", "none.safetensors", "folder"):
            rows.append(Command(f"{verb} {DATA} {more} --checkpoint HERE/bad/{wrong} {OUT}", words=wrong))
    for verb in ("predict", "densify", "live", "demo", "evaluate", "bench"):
        data = DATA if verb in READS_FRAMES else "HERE/colmap" if verb == "evaluate" else ""
        rows.append(Command(f"{verb} {data} --device gpu {OUT}", 2, "expected one of auto, cpu, cuda, mps"))
    for verb, more in {**READS_FRAMES, **OUTPUTS}.items():
        data = f"{DATA} " if verb in READS_FRAMES else "HERE/dense " if verb in ("evaluate", "export") else ""
        data = "HERE/camera/camera.json " if verb == "convert-camera" else data
        for wrong, words in (
            ("list", "no settings in it"),
            ("tabs", "not YAML"),
            ("bytes", "not YAML"),
            ("key", "no_such_setting"),
        ):
            rows.append(Command(f"{verb} {data}{more} --config HERE/bad/{wrong}.yaml {OUT}", 2, words))
    return rows


ROWS = _rows()
