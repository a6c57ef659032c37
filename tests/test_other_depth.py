"""Depth of other programs is judged as our own is: the same arrays give the same figures, whatever file holds them."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from colons import colon, truth
from PIL import Image

from lightdepth.cli import main
from lightdepth.datasets import write_folder
from lightdepth.files.exr import write_exr
from lightdepth.metrics import ALIGNMENTS, NAMES

FRAMES = colon(0).frames[:3]
RAY_Z = FRAMES[0].camera.rays()[0][..., 2]


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "seq"
    write_folder(FRAMES, folder)
    return folder


@pytest.fixture(scope="module")
def distances() -> list[np.ndarray]:
    """Distance [mm] with noise and with holes, in steps that 16 bits hold."""
    rng = np.random.default_rng(1)
    made = [truth(f).distance * rng.lognormal(0, 0.1, truth(f).distance.shape) for f in FRAMES]
    return [np.where(rng.random(d.shape) < 0.05, 0, np.rint(d * 256) / 256).astype(np.float32) for d in made]


def judged(folder: Path, data: Path, *options: str) -> dict:
    assert main(["evaluate", str(folder), "--truth", str(data), "-o", f"{folder}-errors", *options]) == 0
    return json.loads((Path(f"{folder}-errors") / "metrics.json").read_text())


@pytest.fixture(scope="module")
def ours(data, distances, tmp_path_factory) -> dict:
    """Figures of our own .npz of the same arrays."""
    folder = tmp_path_factory.mktemp("ours") / "ours"
    folder.mkdir()
    for frame, d in zip(FRAMES, distances, strict=True):
        replace(truth(frame), distance=np.where(d > 0, d, 1), valid=d > 0).save(folder / f"{frame.name}.npz")
    return judged(folder, data)["mean"]


WRITERS: dict[str, Callable[[Path, np.ndarray], object]] = {
    "npy": lambda p, v: np.save(p, v),
    "npy of a batch of one, in double precision": lambda p, v: np.save(p, v[None, None].astype(np.float64)),
    "npz": lambda p, v: np.savez(p, depth=v, colour=np.zeros((4, 3))),
    "exr": write_exr,
    "tiff": lambda p, v: cv2.imwrite(str(p), v),
    "png": lambda p, v: Image.fromarray(np.rint(v * 256).astype(np.uint16)).save(p),
}


@pytest.mark.parametrize("writer", WRITERS)
def test_distance_in_any_file_has_the_figures_of_our_own_npz(writer, data, distances, ours, tmp_path):
    suffix, folder = writer.split()[0], tmp_path / "theirs"
    folder.mkdir()
    for frame, d in zip(FRAMES, distances, strict=True):
        WRITERS[writer](folder / f"depth_{frame.number}.{suffix}", d)
    scale = ("--depth-scale", str(1 / 256)) if suffix == "png" else ()
    found = judged(folder, data, "--depth-kind", "distance", *scale)
    assert found["mean"] == ours and found["frames_judged"] == 3
    assert found["predicted_unit"] == ("mm" if scale else "up to scale")


@pytest.mark.parametrize("kind", ["depth", "disparity"])
def test_depth_and_disparity_have_the_figures_of_the_distance_that_they_say(kind, data, distances, ours, tmp_path):
    folder = tmp_path / "theirs"
    folder.mkdir()
    for frame, d in zip(FRAMES, distances, strict=True):
        depth = d.astype(np.float64) * RAY_Z
        values = depth / 2 if kind == "depth" else 40 / np.where(depth > 0, depth, np.inf)
        np.save(folder / f"{frame.name}.npy", values)
    found = judged(folder, data, "--depth-kind", kind, "--depth-scale", "2" if kind == "depth" else "40")
    assert found["predicted_unit"] == "mm" and set(found["mean"]) == set(ours)
    assert found["mean"] == pytest.approx(ours, rel=1e-5)
    assert all(f"{name}_{alignment}" in ours for name in NAMES for alignment in ALIGNMENTS)


def test_depth_at_half_the_size_is_brought_to_the_frames(data, tmp_path):
    folder = tmp_path / "theirs"
    folder.mkdir()
    for frame in FRAMES:
        height, width = frame.image.shape[:2]
        small = cv2.resize(truth(frame).distance, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        np.save(folder / f"{frame.name}.npy", small)
    found = judged(folder, data, "--depth-kind", "distance")["mean"]
    assert found["abs_rel_none"] < 0.03 and found["share_of_truth"] > 0.9


def test_a_picture_of_the_depth_beside_the_numbers_is_left_alone(data, distances, ours, tmp_path):
    folder = tmp_path / "theirs"
    folder.mkdir()
    for frame, d in zip(FRAMES, distances, strict=True):
        np.save(folder / f"{frame.name}.npy", d)
        cv2.imwrite(str(folder / f"{frame.name}.png"), np.zeros((*d.shape, 3), np.uint8))
    assert judged(folder, data, "--depth-kind", "distance")["mean"] == ours


def written(folder: Path, name: str, values: np.ndarray) -> Path:
    folder.mkdir()
    WRITERS[name.rsplit(".", 1)[-1]](folder / name, values)
    return folder


def test_what_is_no_depth_is_refused_and_named(data, tmp_path, capsys):
    d = truth(FRAMES[0]).distance

    def refusal(folder: Path, *options: str) -> str:
        code = main(["evaluate", str(folder), "--truth", str(data), "-o", str(tmp_path / "out"), *options])
        assert code == 3
        return capsys.readouterr().err

    eight = tmp_path / "eight"
    eight.mkdir()
    cv2.imwrite(str(eight / "0.png"), d.astype(np.uint8))
    assert "8 bits a pixel" in refusal(eight, "--depth-kind", "depth")
    colour = written(tmp_path / "colour", "0.npy", np.zeros((*d.shape, 3), np.float32))
    assert "expected one number a pixel" in refusal(colour, "--depth-kind", "depth")
    assert "--depth-kind" in refusal(colour)
    assert "--depth-kind distance" in refusal(written(tmp_path / "unsaid", "0.npz", d))
    two = tmp_path / "two"
    two.mkdir()
    np.savez(two / "0.npz", a=d, b=d)
    assert "none is known as depth" in refusal(two, "--depth-kind", "depth")
    cropped = written(tmp_path / "cropped", "0.npy", d[:, :-20])
    assert "same aspect" in refusal(cropped, "--depth-kind", "depth")
    empty = written(tmp_path / "zeros", "0.npy", np.zeros_like(d))
    assert "no finite number above 0" in refusal(empty, "--depth-kind", "depth")
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "0.npy").write_bytes(b"no array")
    assert "not an array" in refusal(broken, "--depth-kind", "depth")
    (broken / "0.npz").write_bytes(b"no arrays")
    assert "not arrays" in refusal(broken, "--depth-kind", "depth")
    nothing = tmp_path / "nothing"
    nothing.mkdir()
    assert "no depth files" in refusal(nothing, "--depth-kind", "depth")
    assert "given without --depth-kind" in refusal(eight, "--depth-scale", "2")
    assert "a number above 0" in refusal(eight, "--depth-kind", "depth", "--depth-scale", "0")


def test_our_own_folders_say_what_they_hold_and_are_judged_as_nothing_else(data, tmp_path, capsys):
    predicted, depth = tmp_path / "predicted", tmp_path / "depth"
    assert main(["predict", str(data), "-o", str(predicted), "--checkpoint", "decline", "--previews", "false"]) == 0
    right = judged(predicted, data)["mean"]
    argv = ["--truth", str(data), "-o", str(tmp_path / "out"), "--depth-kind"]
    assert main(["evaluate", str(predicted), *argv, "depth"]) == 3
    assert f"depth, but {predicted} holds distance along the ray" in capsys.readouterr().err
    for to in ("exr", "png"):
        assert main(["export", str(predicted), "-o", str(depth / to), "--to", to]) == 0
        found = judged(depth / to, data, "--depth-kind", "depth")["mean"]  # PNGs by their step
        assert found == pytest.approx(right, rel=1e-3, abs=1e-4)
        assert main(["evaluate", str(depth / to), *argv, "distance"]) == 3
        assert "holds depth along the axis" in capsys.readouterr().err
    (predicted / "run.json").unlink()  # its files say so, too
    assert main(["evaluate", str(predicted), *argv, "disparity"]) == 3
    assert "distance along the ray, as `lightdepth predict` writes it" in capsys.readouterr().err


def test_metrics_of_another_program_s_folder_are_never_written_into_it(data, tmp_path, capsys):
    folder = written(tmp_path / "theirs", f"{FRAMES[0].name}.npy", truth(FRAMES[0]).distance)
    assert main(["evaluate", str(folder), "--truth", str(data), "--depth-kind", "distance"]) == 3
    assert "add -o FOLDER" in capsys.readouterr().err
    assert main(["evaluate", str(folder), "--depth-kind", "distance", "-o", str(tmp_path / "out")]) == 3
    assert "give --truth DATA" in capsys.readouterr().err


def test_depth_files_that_would_hang_or_take_all_memory_are_refused_at_once(data, tmp_path, capsys):
    def refusal(folder: Path) -> str:
        argv = ["evaluate", str(folder), "--truth", str(data), "-o", str(tmp_path / "out"), "--depth-kind", "depth"]
        assert main(argv) == 3 and not (tmp_path / "out").exists()
        return capsys.readouterr().err

    pipes, huge = tmp_path / "pipes", tmp_path / "huge"
    for folder in (pipes, huge):
        folder.mkdir()
    os.mkfifo(pipes / "0.exr")
    assert "a named pipe" in refusal(pipes)
    with (huge / "0.npy").open("wb") as stream:
        shape = {"descr": "<f4", "fortran_order": False, "shape": (10**7, 10**7)}
        np.lib.format.write_array_header_1_0(stream, shape)
    assert "an array of 10000000x10000000" in refusal(huge)


def test_a_scale_beyond_what_32_bits_hold_is_refused_without_a_warning_of_numpy(data, distances, tmp_path, capsys):
    folder = written(tmp_path / "theirs", f"{FRAMES[0].name}.npy", distances[0])
    argv = ["--truth", str(data), "-o", str(tmp_path / "out"), "--depth-kind", "distance", "--depth-scale", "1e300"]
    assert main(["evaluate", str(folder), *argv]) == 3
    said = capsys.readouterr().err
    assert "--depth-scale: 1e+300" in said and "RuntimeWarning" not in said
