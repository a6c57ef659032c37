"""A colon as a C3VD tree with everything that C3VD has, decoded by hand from its bytes."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from colons import colon, slam
from raising import refused
from verbs import by_options

from densify.evaluation.truth import read_truth
from lightdepth.cli import main
from lightdepth.commands.synth import ColonConfig
from lightdepth.commands.synth import synth as synth_verb
from lightdepth.datasets import open_sequence
from lightdepth.datasets.c3vd import C3VD
from lightdepth.files.meshes import read_mesh
from lightdepth.tube.breathing import BreathingConfig
from lightdepth.tube.casting import EmbreeCaster
from lightdepth.tube.export import write_synthetic
from lightdepth.tube.scene import TubeConfig
from lightdepth.tube.shape import ShapeConfig
from lightdepth.tube.slam import SlamConfig

CAMERA = C3VD.resized(100, 80)


@pytest.fixture(scope="module")
def tree(tmp_path_factory) -> Path:
    found = colon(2, 3, 4.0, CAMERA)
    folder = tmp_path_factory.mktemp("c3vd")
    write_synthetic(found.frames, slam(found.frames), folder, "c3vd", wall=found.tube.shape)
    return folder / "sequence"


def raw(tree: Path, name: str) -> np.ndarray:
    pixels = cv2.imread(str(tree / name), cv2.IMREAD_UNCHANGED)
    return pixels[..., ::-1] if pixels.ndim == 3 else pixels


def of(tree: Path, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth [mm] (0 where unknown), normals, and flow [px] (NaN where unknown) of a frame."""
    depth, normals = raw(tree, f"{k:04d}_depth.tiff"), raw(tree, f"{k:04d}_normals.tiff")
    assert depth.dtype == normals.dtype == np.uint16 and depth.ndim == 2 and normals.shape == (*depth.shape, 3)
    flow = raw(tree, f"{k:04d}_flow.tiff").astype(float)
    unknown = (flow[..., :2] == 0).all(-1)
    assert not flow[..., 2].any()
    moved = np.where(unknown[..., None], np.nan, flow[..., :2] / 65535 * 40 - 20)
    mm = np.where(depth < 65535, depth / 65535 * 100, 0)
    return mm, np.where((normals == 0).all(-1, keepdims=True), np.nan, normals / 65535 * 2 - 1), moved


def checked_frame(tree: Path, k: int, camera, spacing: int = 1) -> None:
    """Everything that a frame of a tree says of the wall agrees with its depth and pose and with those before."""
    depth, normals, flow = of(tree, k)
    rays = camera.rays()[0]
    poses = np.loadtxt(tree / "pose.txt", delimiter=",").reshape(-1, 4, 4).transpose(0, 2, 1)
    known = depth > 0
    length = np.linalg.norm(normals, axis=-1)[known]
    assert np.abs(length - 1).max() < 1e-3 and ((normals * rays).sum(-1)[known] < 0).all()
    points = rays / rays[..., 2:] * depth[..., None]
    across, down = (np.roll(points, -spacing, a) - np.roll(points, spacing, a) for a in (1, 0))
    flat = np.cross(across, down)
    flat /= np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-12)
    cosine = np.abs((flat * normals).sum(-1))[4:-4, 4:-4][known[4:-4, 4:-4]]
    assert np.nanmedian(cosine) > np.cos(np.radians(8))

    rows, columns = np.nonzero(known & np.isfinite(flow).all(-1))
    here, moved = np.stack([columns, rows], 1), flow[rows, columns]
    there = here + moved
    before = raw(tree, f"{k - 1:04d}_depth.tiff") / 65535 * 100
    x, y = np.clip(np.rint(there), 0, (depth.shape[1] - 1, depth.shape[0] - 1)).astype(int).T
    world = points[rows, columns] @ poses[k][:3, :3].T + poses[k][:3, 3]
    then = (world - poses[k - 1][:3, 3]) @ poses[k - 1][:3, :3]
    pixels = camera.project(then)[0] - 0.5  # files count from the first pixel's centre
    assert np.abs(np.clip(pixels - here, -20, 20) - moved).max() < 0.02  # beyond that they are clipped
    seen = (before[y, x] > 0) & (before[y, x] < 99.9) & (np.abs(moved) < 19.9).all(1)
    assert np.median(np.abs(before[y, x] - then[:, 2])[seen]) < 0.5
    assert len(rows) > 0.5 * known.sum()


def checked_mesh(tree: Path, frames) -> None:
    """The wall of a tree holds what its frames see, and marks faces that none of them does."""
    text = (tree / "coverage_mesh.obj").read_text()
    lines = text.splitlines()
    marks = np.array([re.fullmatch(r"f \d+/(\d) \d+/\1 \d+/\1", line)[1] for line in lines if line[0] == "f"], int)
    assert [line for line in lines if line.startswith("vt")] == ["vt 0 0", "vt 1 1"]
    vertices, faces = read_mesh(tree / "coverage_mesh.obj")
    assert len(faces) == len(marks) and set(marks) == {1, 2}
    seen = EmbreeCaster(vertices, faces[marks == 1])
    frame = frames[0]
    points = (frame.camera.rays()[0] * frame.true_distance[..., None])[frame.true_distance > 0]
    pose = frame.true_world_from_cam
    assert seen.distance(points[::7] @ pose[:3, :3].T + pose[:3, 3]).max() < 0.05
    truth = read_truth(frames)
    assert truth.surface.mesh_source.startswith("coverage_mesh.obj")


def test_a_tree_has_every_file_of_c3vd_and_they_agree_with_each_other(tree):
    names = {p.name for p in tree.iterdir()}
    kinds = ("color.png", "depth.tiff", "normals.tiff", "occlusion.png")
    each = {f"{k:04d}_{kind}" for k in range(3) for kind in kinds}
    assert names == each | {"0001_flow.tiff", "0002_flow.tiff", "pose.txt", "coverage_mesh.obj"}
    frames = open_sequence(tree)
    for k in (1, 2):
        checked_frame(tree, k, frames[0].camera)
    checked_mesh(tree, frames)


def test_a_pixel_that_hides_wall_is_on_the_near_side_of_a_jump_in_depth(tree):
    depth = of(tree, 1)[0]
    hides = raw(tree, "0001_occlusion.png")
    assert hides.dtype == np.uint8 and set(np.unique(hides)) == {0, 255}
    jump = (depth[:, 1:] > 0) & (depth[:, :-1] > 0) & (np.abs(np.diff(depth)) > 12)
    near = np.where(np.diff(depth) > 0, hides[:, :-1], hides[:, 1:])[jump]
    assert jump.sum() > 10 and (near == 255).mean() > 0.9
    assert not hides[depth == 0].any()


def test_a_wall_that_moves_has_neither_flow_nor_mesh_and_a_tree_holds_c3vd_s_lens_and_sides_alone(tmp_path):
    with refused(where="--layout c3vd", cure="--lens"):
        ColonConfig(lens="fisheye").in_layout("c3vd")
    with refused(where="--layout c3vd", cure="--size"):
        ColonConfig(size=(100, 100)).in_layout("c3vd")
    assert ColonConfig().in_layout("c3vd").size == (1350, 1080) and ColonConfig().in_layout("frames").size == (320, 256)
    shape = ShapeConfig(length=40.0, step=2.0)
    synth = by_options(synth_verb)
    synth(
        tmp_path / "moving",
        layout="c3vd",
        frames=3,
        size=(50, 40),
        travel_mm=2.0,
        scene=TubeConfig(shape=shape),
        breathing=BreathingConfig(amplitude=0.1),
        slam=SlamConfig(maps=1, keyframe_every=1),
    )
    left = {p.name for p in (tmp_path / "moving" / "sequence").iterdir()}
    assert left == {f"{k:04d}_{what}" for k in range(3) for what in ("color.png", "depth.tiff")} | {"pose.txt"}


@pytest.mark.slow
def test_at_full_size_a_tree_is_as_c3vd_s_bytes_are_and_is_judged_by_its_mesh(tmp_path):
    """Three frames of 1350x1080, as the verb makes them where no size is given; predicted and judged."""
    argv = ["--layout", "c3vd", "--frames", "3", "--travel-mm", "1.5", "--seed", "2", "--slam.keyframe-every", "1"]
    assert main(["synth", "-o", str(tmp_path / "made"), *argv, "--slam.maps", "1"]) == 0
    tree = tmp_path / "made" / "sequence"
    for name in ("0001_color.png", "0001_depth.tiff", "0001_normals.tiff", "0001_flow.tiff", "0001_occlusion.png"):
        assert raw(tree, name).shape[:2] == (1080, 1350)
    frames = open_sequence(tree)
    checked_frame(tree, 1, C3VD, spacing=8)
    checked_mesh(tree, frames)
    corner = np.s_[:20, :20]
    assert not raw(tree, "0001_normals.tiff")[corner].any() and not raw(tree, "0001_flow.tiff")[corner].any()
    argv = ["--truth", str(tree), "--checkpoint", "decline", "--recipe", "paper", "--judge.on", "false", "-o"]
    assert main(["evaluate", str(tmp_path / "made" / "slam"), *argv, str(tmp_path / "judged")]) == 0
    found = json.loads((tmp_path / "judged" / "metrics.json").read_text())
    assert found["all"]["dense"]["to_mesh"]["median_mm"] < 20 and "coverage_mesh.obj" in found["truth"]["mesh"]
