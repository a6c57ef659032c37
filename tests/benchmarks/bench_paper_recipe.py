"""The paper's recipe as one would write it first, against `live` and `densify`: time in the same run, and the surface.

Written plainly: a distance for each keyframe, LMedS as a loop over all proposals with np.median, Open3D's
VoxelBlockGrid as in its examples (16³ voxels a block, a view integrated where its depth reaches), one mesh after every
keyframe as a viewer needs it, or one at the end. Both have the same keyframes, predictions, voxels, truncation and far
end, and as many threads. Processor time stands beside the clock's, as a busy machine spoils the latter.

Run by `make bench`, or alone: pytest tests/benchmarks/bench_paper_recipe.py -o python_files='bench_*.py' -o addopts= -s
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from bench_live import Pipe

from densify.agreement import AgreementConfig
from densify.config import LIVE_FUSION, DensifyConfig, LiveConfig
from densify.fusion.volume import FusionConfig
from densify.judging.ahead import AheadConfig
from densify.judging.config import JudgeConfig
from densify.live.densifier import Densifier, StepTime
from densify.live.play import play
from densify.pipeline import densify_submap
from lightdepth import native
from lightdepth.camera import Pinhole
from lightdepth.checkpoint import DEFAULT_CHECKPOINT, load_model
from lightdepth.datasets import FrameSequence
from lightdepth.frame import Frame
from lightdepth.observations import observed_distances
from lightdepth.prediction import DepthPrediction
from lightdepth.sparse_map import Keyframe, Submap
from lightdepth.tube import lens, render_sequence
from lightdepth.tube.slam import SlamConfig, simulate_slam

SEED, KEYFRAMES, NEW_POINTS = 402, 30, 60
"""A colon of 30 keyframes, each of which observes some 1000 points."""
RIGID = AgreementConfig(on=False)
HALF_A_VOXEL = 0.5
"""Farthest, in the median, that a surface with one scale for each keyframe may be from the plain one."""


@dataclass
class Times(dict[str, StepTime]):
    """Time by step."""

    @contextmanager
    def __call__(self, step: str) -> Iterator[None]:
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        taken = StepTime(time.perf_counter() - wall, time.process_time() - cpu)
        self[step] = self.get(step, StepTime()) + taken

    def of(self, *steps: str) -> StepTime:
        return sum((self[s] for s in steps if s in self), StepTime())


@dataclass
class Plain:
    """The recipe, written plainly. `far` and `refined` are as in densify: beyond, nothing is fused; the scale is the
    least squares of the inliers of LMedS."""

    voxel: float
    truncation: float
    far: float
    times: Times = field(default_factory=Times)

    def __post_init__(self) -> None:
        self.o3d = native.open3d()
        float32, device = self.o3d.core.float32, self.o3d.core.Device("CPU:0")
        kinds = (("tsdf", "weight", "color"), (float32,) * 3, ((1), (1), (3)))
        self.grid = self.o3d.t.geometry.VoxelBlockGrid(*kinds, self.voxel, 16, 2000, device)

    def add(self, keyframe: Keyframe, submap: Submap, frame: Frame, predicted: DepthPrediction) -> None:
        camera = keyframe.camera
        assert isinstance(camera, Pinhole)
        with self.times("align"):
            observed = observed_distances(keyframe, submap, predicted)
            scale, inliers = scale_by_loop(observed.mapped, observed.predicted)
        with self.times("integrate"):
            rays = camera.rays()[0]
            distance = np.where(predicted.valid, scale * predicted.distance, 0)
            distance[distance > self.far * np.quantile(observed.mapped[inliers], 0.9)] = 0
            image, tensor = self.o3d.t.geometry.Image, self.o3d.core.Tensor
            depth = image(np.ascontiguousarray(distance * rays[..., 2], np.float32))
            color = image(np.ascontiguousarray(frame.image, np.float32))
            pose = tensor(np.ascontiguousarray(keyframe.cam_from_map, np.float64))
            given = (tensor(camera.matrix), pose, 1.0, float(distance.max()) * 1.001, self.truncation)
            blocks = self.grid.compute_unique_block_coordinates(depth, *given)
            self.grid.integrate(blocks, depth, color, *given)

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        with self.times("extract"):
            made = self.grid.extract_triangle_mesh(weight_threshold=0.0)
            return made.vertex.positions.numpy(), made.triangle.indices.numpy()


def scale_by_loop(mapped: np.ndarray, predicted: np.ndarray) -> tuple[float, np.ndarray]:
    """LMedS over all proposals, the inliers (n,) by 2.5 sigma, and least squares over these."""
    best, scale = np.inf, 1.0
    for proposal in mapped / predicted:
        median = np.median(np.abs(mapped - proposal * predicted))
        if median < best:
            best, scale = median, proposal
    inliers = np.abs(mapped - scale * predicted) <= 2.5 * 1.4826 * (1 + 5 / (len(mapped) - 1)) * best
    m, p = mapped[inliers], predicted[inliers]
    return float(m @ p / (p @ p)), inliers


def off(vertices: np.ndarray, mesh: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Distance of each vertex from the nearest place of a mesh."""
    o3d = native.open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(*(o3d.core.Tensor(np.ascontiguousarray(a, t)) for a, t in zip(mesh, ("f4", "u4"), strict=True)))
    found: np.ndarray = scene.compute_distance(o3d.core.Tensor(vertices.astype("f4"))).numpy()
    return found


def same(vertices: np.ndarray, mesh: tuple[np.ndarray, np.ndarray], voxel: float) -> float:
    """Prints how far a surface is from the plain one, and returns the median in voxels."""
    away = off(vertices, mesh) / voxel
    median, most = np.quantile(away, [0.5, 0.95])
    print(f"    its surface off the plain one: {median:.2f} voxels (median), {most:.2f} (95 %)")
    return float(median)


@pytest.fixture(scope="module")
def colon():
    sequence = render_sequence(SEED, KEYFRAMES, lens("pinhole", 320, 256), 30.0)
    config = SlamConfig("independent", keyframe_every=1, maps=1, points_per_keyframe=NEW_POINTS)
    found = simulate_slam(sequence.frames, config, SEED).map
    frames = FrameSequence([f.name for f in sequence.frames], sequence.frames.__getitem__, "rendered")
    model = load_model(DEFAULT_CHECKPOINT, details=False)
    kept = {f.name: model(f) for f in sequence.frames}
    first = kept[sequence.frames[0].name]  # for the keyframe that `live` warms up with
    return frames, found, lambda frame: kept.get(Path(frame.name).stem, first)


def plainly(colon: tuple, fusion: FusionConfig, every: bool) -> tuple[Plain, tuple[np.ndarray, np.ndarray]]:
    frames, found, predict = colon
    (submap,) = found.submaps
    plain = Plain(fusion.voxel_for(submap), fusion.truncation, fusion.far)
    mesh = None
    for keyframe in submap.keyframes:
        frame = frames.of_keyframe(keyframe)
        plain.add(keyframe, submap, frame, predict(frame))
        if every:
            mesh = plain.mesh()
    return plain, mesh or plain.mesh()


def told(name: str, times: dict[str, StepTime], count: int) -> StepTime:
    total = sum(times.values(), StepTime())
    steps = ", ".join(f"{s} {1000 * t.cpu / count:.1f}" for s, t in times.items())
    print(f"  {name:<44} {1000 * total.wall / count:7.1f} {1000 * total.cpu / count:7.1f}   ({steps})")
    return total


def ratio(theirs: StepTime, ours: StepTime) -> str:
    return f"{theirs.wall / ours.wall:.1f} by the clock, {theirs.cpu / ours.cpu:.1f} by the processor"


def test_a_mesh_after_every_keyframe(colon):
    """Bar: at least 8 times as fast as the plain way without the network, the same surface to half a voxel."""
    frames, found, predict = colon
    (submap,) = found.submaps
    observed = np.median([len(k.point_ids) for k in submap.keyframes])
    print(
        f"\n{len(submap.keyframes)} keyframes of {observed:.0f} points; "
        "ms a keyframe without the network: clock, processor"
    )
    plain, mesh = plainly(colon, LIVE_FUSION, every=True)
    reference = told("plain", plain.times, len(submap.keyframes))
    play(frames, found, predict, LiveConfig(agreement=RIGID, judge=AheadConfig(on=False)), lambda surface: None)  # warm
    for name, config in (
        ("live, one scale each", LiveConfig(agreement=RIGID, judge=AheadConfig(on=False))),
        ("live, bent, not judged", LiveConfig(judge=AheadConfig(on=False))),
        ("live", LiveConfig()),
    ):
        surfaces = []
        played = play(frames, found, predict, config, surfaces.append)
        steps = {s for p in played for s in p.times} - {"predict", "read"}
        times = {s: sum((p.times[s] for p in played if s in p.times), StepTime()) for s in sorted(steps)}
        ours = told(name, times, len(played))
        print(f"    plain over it: {ratio(reference, ours)}")
        vertices = surfaces[0].dense.vertices
        median = same(vertices, mesh, plain.voxel)
        assert config.agreement.on or median <= HALF_A_VOXEL, name  # what is bent is another surface


def test_one_mesh_at_the_end(colon):
    frames, found, predict = colon
    (submap,) = found.submaps
    count = len(submap.keyframes)
    print(f"\n{count} keyframes; ms a keyframe without the network: clock, processor")
    plain, mesh = plainly(colon, FusionConfig(), every=False)
    reference = told("plain", plain.times, count)
    quiet = JudgeConfig(on=False)
    for name, config in (
        ("densify, recipe paper", DensifyConfig(judge=quiet).under("paper")),
        ("densify, one scale each, not judged", DensifyConfig(judge=quiet).rigid()),
        ("densify, not judged", DensifyConfig(judge=quiet)),
        ("densify", DensifyConfig()),
    ):
        start, used = time.perf_counter(), time.process_time()
        made = densify_submap(submap, frames, predict, config)
        ours = StepTime(time.perf_counter() - start, time.process_time() - used)
        steps = ", ".join(f"{s} {1000 * t / count:.1f}" for s, t in made.seconds.items())
        print(f"  {name:<44} {1000 * ours.wall / count:7.1f} {1000 * ours.cpu / count:7.1f}   ({steps}, by the clock)")
        print(f"    plain over it: {ratio(reference, ours)}")
        median = same(made.dense.vertices, mesh, plain.voxel)
        assert (config.agreement.on and config.recipe == "full") or median <= HALF_A_VOXEL, name


def test_a_map_that_grows(growing: int = 300):
    """The plain way makes all of the mesh anew after every keyframe, so how far behind it falls is told by the map's
    length: a straight tube, predicted for free."""
    pipe, rng = Pipe(lens("pinhole", 320, 256)), np.random.default_rng(0)
    live = Densifier(pipe.predict, LiveConfig(judge=AheadConfig(on=False)))
    live.warm_up(pipe.camera)
    plain, cpu = None, np.zeros((growing, 2))
    for i in range(growing):
        keyframe, points = pipe.keyframe(i, 1000, pipe.pose(i), rng)
        frame = replace(pipe.frame, name=f"{i:06d}")
        submap = Submap(0, (keyframe,), keyframe.point_ids, points)
        plain = plain or Plain(LIVE_FUSION.voxel_for(submap), LIVE_FUSION.truncation, LIVE_FUSION.far)
        predicted, before = pipe.predict(frame), sum(plain.times.values(), StepTime()).cpu
        plain.add(keyframe, submap, frame, predicted)
        plain.mesh()
        live.times = {}
        live.add_keyframe(frame, keyframe, points)
        live.mesh()
        ours = sum((t for step, t in live.times.items() if step != "predict"), StepTime()).cpu
        cpu[i] = sum(plain.times.values(), StepTime()).cpu - before, ours
    print("\na map that grows; processor ms a keyframe, plain and live, and the ratio")
    for last in (30, 100, 200, growing):
        theirs, ours = np.median(1000 * cpu[last - 20 : last], axis=0)
        print(f"  at keyframe {last:<4} {theirs:7.1f} {ours:7.1f}   {theirs / ours:.1f}")
