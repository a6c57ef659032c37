"""Our fusion against Open3D's VoxelBlockGrid fed through cube faces: field, accuracy, time as a ratio in the same run.

Run by `make bench`, or `pytest tests/benchmarks/bench_fusion.py -o python_files='bench_*.py' -o addopts= -s`. The
reference has no weights and takes pinhole depth: a lens is resampled into the faces of a cube that its field touches.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
import pytest
import torch
from colons import sequence, slam, truth
from scenes import cylinder, slanted_plane, sphere
from scipy.spatial import cKDTree

from densify import fusers
from densify.config import DensifyConfig
from densify.evaluation.errors import true_cloud
from densify.fusion.rectify import RectifyConfig, SurfaceView, surface_view
from densify.fusion.volume import FusionConfig, Mesh, TsdfVolume
from densify.pipeline import densify_submap
from densify.similarity import fit_similarity
from lightdepth import native
from lightdepth.camera import Pinhole
from lightdepth.checkpoint import load_model
from lightdepth.prediction import DepthPrediction
from lightdepth.tube import lens, render_sequence

VOXEL, FAR, ROUNDS = 0.25, 25.0, 5
SEEDS = (400, 401, 402)
SCENES = {"plane": slanted_plane, "sphere": sphere, "tube": cylinder}
FACES = np.array(  # rows: a view's x, y, z axes in camera axes
    [
        [(1, 0, 0), (0, 1, 0), (0, 0, 1)],
        [(0, 0, -1), (0, 1, 0), (1, 0, 0)],
        [(0, 0, 1), (0, 1, 0), (-1, 0, 0)],
        [(1, 0, 0), (0, 0, -1), (0, 1, 0)],
        [(1, 0, 0), (0, 0, 1), (0, -1, 0)],
    ],
    float,
)
Faces = list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]
_maps: dict = {}


def face_views(prediction: DepthPrediction, image: np.ndarray, config: object, far: float = np.inf) -> Faces:
    """Depth (h, w), colour, K and view_from_cam (4, 4) of the views; edges and grazing pixels are left out."""
    camera = prediction.camera
    if camera not in _maps:
        f = round(camera.focal_length)
        small = camera if isinstance(camera, Pinhole) else Pinhole(2 * f, 2 * f, f, f, f, f)
        rays = small.rays()[0]
        _maps[camera] = [
            (small.matrix, axes, rays, *camera.project(rays @ axes))
            for axes in (FACES[:1] if small is camera else FACES)
        ]
    valid = prediction.valid.astype(np.float32)
    found = []
    for matrix, axes, rays, pixels, inside in _maps[camera]:
        x, y = np.moveaxis(pixels.astype(np.float32) - np.float32(0.5), -1, 0)

        def sampled(values: np.ndarray, x: np.ndarray = x, y: np.ndarray = y) -> np.ndarray:
            return cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

        distance = sampled(np.where(prediction.valid, prediction.distance, 0).astype(np.float32))
        use = inside & (sampled(valid) > 0.999) & (distance > 0) & (distance <= far)
        log = np.log(np.where(use, distance, 1))
        points = distance[..., None] * rays
        normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
        length = np.linalg.norm(normals, axis=-1)
        use &= np.abs((normals * rays).sum(-1)) >= 0.05 * length
        for axis in (0, 1):
            jump = (np.abs(np.diff(log, axis=axis)) > 0.15).astype(np.uint8)
            both = [((0, 1), (0, 0)), ((1, 0), (0, 0))] if axis == 0 else [((0, 0), (0, 1)), ((0, 0), (1, 0))]
            use &= ~np.any([np.pad(jump, p) for p in both], axis=0)
        pose = np.eye(4)
        pose[:3, :3] = axes
        depth = np.where(use, distance * rays[..., 2], 0).astype(np.float32)
        if use.any():
            found.append((depth, np.ascontiguousarray(sampled(image.astype(np.float32))), matrix, pose))
    return found


class BlockGrid:
    """TsdfVolume's part of VoxelBlockGrid."""

    def __init__(self, voxel: float, config: FusionConfig):
        self.voxel = voxel
        self._o3d = native.open3d()
        core, self._truncation = self._o3d.core, config.truncation
        kinds = (core.float32, core.float32, core.float32)
        args = (("tsdf", "weight", "color"), kinds, ((1), (1), (3)), voxel, 8, 2000, core.Device("CPU:0"))
        self._grid = self._o3d.t.geometry.VoxelBlockGrid(*args)

    def integrate(self, views: Faces, cam_from_map: np.ndarray) -> None:
        image, tensor = self._o3d.t.geometry.Image, self._o3d.core.Tensor
        for depth, color, matrix, view_from_cam in views:
            pose = tensor(np.ascontiguousarray(view_from_cam @ cam_from_map))
            given = (tensor(matrix), pose, 1.0, float(depth.max()) * 1.001, self._truncation)
            blocks = self._grid.compute_unique_block_coordinates(image(depth), *given)
            self._grid.integrate(blocks, image(depth), image(color), *given)

    def extract_mesh(self) -> Mesh:
        mesh = self._grid.extract_triangle_mesh(weight_threshold=0.0)
        vertices = mesh.vertex.positions.numpy().astype(float)
        ones = np.ones(len(vertices))
        return Mesh(vertices, mesh.triangle.indices.numpy().astype(int), np.ones_like(vertices), ones, ones)


WAYS: dict[str, tuple[Callable, type]] = {"ours": (surface_view, TsdfVolume), "cube faces": (face_views, BlockGrid)}


def best(functions: dict[str, Callable]) -> dict[str, float]:
    """Least time of each [ms]; they take turns, so that a busy machine slows them alike."""
    taken: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(ROUNDS):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            taken[name].append(1000 * (time.perf_counter() - start))
    return {name: min(times) for name, times in taken.items()}


def errors(name: str, vertices: np.ndarray) -> np.ndarray:
    if name == "plane":
        return np.abs(vertices @ [0.3, -0.2, -1.0] / np.linalg.norm([0.3, -0.2, -1.0]) + 12) / VOXEL
    radius = np.linalg.norm(vertices if name == "sphere" else vertices[:, :2], axis=1)
    return np.abs(radius - (10 if name == "sphere" else 8)) / VOXEL


def step(view: Callable, volume: TsdfVolume, prediction: DepthPrediction, image: np.ndarray) -> None:
    volume.integrate(view(prediction, image, RectifyConfig(), FAR), np.eye(4))


def test_exact_depth_field_accuracy_and_time():
    torch.set_num_threads(1)
    print("\nexact depth, 320x256, one view         error [voxel]           largest    time of view + integration, of")
    print("lens     scene   way          pixels    median   95th   worst   angle      extraction; ours over faces")
    for lens_name in ("pinhole", "fisheye", "c3vd"):
        camera = lens(lens_name, 320, 256)
        for name, make in SCENES.items():
            scene = make(camera)
            prediction, image = scene.prediction(), scene.frame().image
            volumes, steps = {}, {}
            for way, (view, volume) in WAYS.items():
                volumes[way] = volume(VOXEL, FusionConfig())
                step(view, volumes[way], prediction, image)
                steps[way] = partial(step, view, volume(VOXEL, FusionConfig()), prediction, image)
            times, extract = best(steps), best({way: v.extract_mesh for way, v in volumes.items()})
            for way, volume in volumes.items():
                mesh = volume.extract_mesh()
                error = errors(name, mesh.vertices)
                angle = np.degrees(np.arccos((mesh.vertices[:, 2] / np.linalg.norm(mesh.vertices, axis=1)).min()))
                print(
                    f"{lens_name:8} {name:7} {way:11} {share(prediction, way):7.2%} {np.median(error):8.4f} "
                    f"{np.quantile(error, 0.95):7.4f} {error.max():6.2f} {angle:7.1f}"
                    + (
                        f"     {times['ours'] / times['cube faces']:.2f}  {extract['ours'] / extract['cube faces']:.2f}"
                        if way == "ours"
                        else ""
                    )
                )
                if way == "ours":
                    assert np.median(error) <= 0.06 and np.quantile(error, 0.95) <= 0.5
        cropped = surface_view(sphere(camera).prediction(), image, RectifyConfig(field="pinhole"))
        rays, kept = camera.rays()[0].reshape(-1, 3), cropped.weights[:-1] > 0
        widest = np.degrees(np.arccos(rays[kept][:, 2].min()))
        print(
            f"{lens_name:8} a pinhole of the same size would hold {kept.sum() / camera.rays()[1].sum():.1%}, "
            f"to {widest:.1f} degrees"
        )


def share(prediction: DepthPrediction, way: str) -> float:
    """Of the valid pixels, those that some direction of the fusion finds, before edges, slant and light."""
    flat = DepthPrediction("1", np.ones_like(prediction.distance), prediction.valid, prediction.camera, "unit sphere")
    if way == "ours":
        view = surface_view(flat, np.ones((*flat.valid.shape, 3), np.float32), RectifyConfig())
        entered = np.unique(view.table.cells)
    else:
        camera = prediction.camera
        places = []
        for depth, _, matrix, view_from_cam in face_views(flat, np.ones((*flat.valid.shape, 3), np.float32), None):
            rows, columns = np.nonzero(depth)
            rays = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], -1) @ np.linalg.inv(matrix).T
            pixels = camera.project(rays @ view_from_cam[:3, :3])[0]
            column, row = np.minimum(pixels, (camera.width - 1, camera.height - 1)).astype(int).T
            places.append(row * camera.width + column)
        entered = np.unique(np.concatenate(places))
    valid = np.flatnonzero(prediction.valid)
    return float(np.isin(valid, entered).mean())


@pytest.mark.parametrize("depth", ["truth", "decline", "lightdepth-self"])
def test_colons_that_nothing_was_tuned_on(depth, monkeypatch):
    """Seeds 400-402, fisheye 160x128, 16 frames, a map with 30 % wrong points; the same maps and predictions."""
    torch.set_num_threads(1)
    model = truth if depth == "truth" else load_model(depth, details=False)
    rows: dict[str, list[list[float]]] = {way: [] for way in WAYS}
    for seed in SEEDS:
        frames = render_sequence(seed, 16, lens("fisheye", 160, 128), 20.0).frames
        submap = slam(frames, seed, spurious=0.3).map.submaps[0]
        cloud = true_cloud(frames)
        tree, poses = cKDTree(cloud), {f.number: f.true_world_from_cam for f in frames}
        for way, (view, volume) in WAYS.items():
            monkeypatch.setattr(fusers, "surface_view", view)
            monkeypatch.setattr(fusers, "volume_on", lambda device, voxel, config, made=volume: made(voxel, config))
            if way != "ours":
                monkeypatch.setattr(fusers, "contribution", lambda *_: fusers.Contribution(1.0, 1.0))
            dense = densify_submap(submap, sequence(frames), model, DensifyConfig()).dense
            monkeypatch.undo()
            centers = np.stack([k.center for k in submap.keyframes])
            similarity = fit_similarity(centers, np.stack([poses[k.number][:3, 3] for k in submap.keyframes]))
            world = similarity.apply(dense.vertices)
            off, back = tree.query(world)[0], np.minimum(cKDTree(world).query(cloud[::7])[0], 10)
            rows[way].append([np.sqrt((off**2).mean()), float(np.median(off)), float(back.mean())])
    print(f"\ncolons {SEEDS}, {depth}: RMS, median accuracy, truth to surface [mm]")
    means = {way: np.mean(found, 0) for way, found in rows.items()}
    for way, mean in means.items():
        print(f"  {way:11} {' '.join(f'{v:.3f}' for v in mean)}   by seed {np.round(rows[way], 3).tolist()}")
    print(f"  ratio       {' '.join(f'{v:.3f}' for v in means['ours'] / means['cube faces'])}")


def test_a_view_stays_small():
    """What a session must keep to take a keyframe out again."""
    view: SurfaceView = surface_view(
        sphere(lens("fisheye", 320, 256)).prediction(), np.ones((256, 320, 3), np.float32), RectifyConfig()
    )
    size = sum(a.nbytes for a in (view.points, view.planes, view.weights, view.colors))
    print(f"\na view of 320x256 takes {size / 2**20:.1f} MiB; its prediction {320 * 256 * 5 / 2**20:.1f} MiB")
