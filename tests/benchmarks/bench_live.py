"""Live surfaces: time per keyframe, flat marching cubes, a screening's worth of submaps, and a loop closure.

Wall time says something only on a quiet machine, so processor time (of all threads together) stands beside it. Run by
`make bench`, or alone: pytest tests/benchmarks/bench_live.py -o python_files='bench_*.py' -o addopts= -s
"""

from __future__ import annotations

import os
import resource
import time
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pytest
import torch
from scenes import cylinder
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from densify.config import LIVE_FUSION, DensifyConfig
from densify.fusion.volume import FusionConfig
from densify.judging.config import JudgeConfig
from densify.live.densifier import STEPS, Densifier
from densify.live.play import play, time_spent
from lightdepth.camera import CameraModel
from lightdepth.checkpoint import DEFAULT_CHECKPOINT, load_model
from lightdepth.datasets import FrameSequence
from lightdepth.frame import Frame
from lightdepth.prediction import DepthPrediction
from lightdepth.sparse_map import Keyframe, SparseMap, Submap
from lightdepth.tube import lens, render_sequence
from lightdepth.tube.slam import SlamConfig, simulate_slam

LIVE = DensifyConfig(fusion=LIVE_FUSION, judge=JudgeConfig(on=False))
COARSE = replace(LIVE, fusion=FusionConfig(voxels_per_distance=26.0))
"""For the long ones, which compare times and do not state them: a quarter of the work."""


@dataclass(frozen=True)
class Pipe:
    """A straight tube of radius 8 seen from its axis, everywhere the same: one image and one distance serve for every
    keyframe, exactly. `step` along the axis between keyframes."""

    camera: CameraModel
    step: float = 1.0

    @cached_property
    def scene(self):
        return cylinder(self.camera)

    @cached_property
    def frame(self) -> Frame:
        return replace(self.scene.frame(), true_distance=None)

    def pose(self, i: int) -> np.ndarray:
        pose = np.eye(4)
        pose[2, 3] = -self.step * i
        return pose

    def keyframe(self, i: int, count: int, pose: np.ndarray, rng: np.random.Generator) -> tuple[Keyframe, np.ndarray]:
        """A keyframe of frame number i and the positions of the `count` points that it observed, 30 % of them wrong."""
        rows, columns = (self.scene.valid[0, 0].numpy() & (self.scene.distance[0, 0].numpy() < 40)).nonzero()
        chosen = rng.choice(len(rows), count, replace=False)
        row, column = rows[chosen], columns[chosen]
        distance = self.scene.distance[0, 0].numpy()[row, column] * (1 + 0.01 * rng.standard_normal(count))
        distance[rng.random(count) < 0.3] *= 1.3 + rng.exponential(4)
        rays = self.camera.rays()[0][row, column]
        points = (rays * distance[:, None] - pose[:3, 3]) @ pose[:3, :3]
        pixels = np.stack([column, row], -1) + 0.5
        return Keyframe(f"{i:06d}.png", self.camera, pose, pixels, np.arange(count) + i * count), points

    def predict(self, frame: Frame) -> DepthPrediction:
        """The true distance by a scale of its own and a smooth error of 5 %: what a network says, for free."""
        rng = np.random.default_rng(frame.number)
        u, v = np.linspace(-1, 1, self.camera.width), np.linspace(-1, 1, self.camera.height)[:, None]
        error = np.exp(0.05 * np.sin(rng.uniform(1, 3) * u + rng.uniform(0, 6)) * np.sin(rng.uniform(1, 3) * v))
        true = self.scene.prediction(rng.uniform(0.2, 5), frame.name)
        return replace(true, distance=(true.distance * error).astype(np.float32))


def ms(values) -> str:
    return f"{1000 * np.median(values):6.1f}"


@pytest.mark.parametrize("seed", [400])
def test_a_keyframe_is_on_the_surface_in_200_ms(seed):
    """Row 6: 320x256, the bundled checkpoint, 500 points per keyframe, 30 % of them wrong; a rendered colon."""
    torch.set_num_threads(1)  # two that wait for each other on a busy machine take thirty times as long
    sequence = render_sequence(seed, 24, lens("c3vd", 320, 256), 24.0)
    config = SlamConfig("independent", keyframe_every=1, maps=1, points_per_keyframe=30)
    found = simulate_slam(sequence.frames, config, seed)
    frames = FrameSequence([f.name for f in sequence.frames], sequence.frames.__getitem__, "rendered")
    played = play(frames, found.map, load_model(DEFAULT_CHECKPOINT, details=False), LIVE, lambda _: None)
    figures = time_spent(played, 0.2).record()
    observed = np.median([len(k.point_ids) for k in found.map.submaps[0].keyframes])
    print(
        f"\nseed {seed}: {len(played)} keyframes, {observed:.0f} points each, load {os.getloadavg()[0]:.1f}, "
        f"{figures['share_in_budget']:.0%} within 200 ms; processor time within 200 ms: "
        f"{np.mean([p.total.cpu <= 0.2 for p in played]):.0%}"
    )
    print("  step             median  95th   processor [ms]")
    for name, row in {
        **figures["steps"],
        "without network": figures["without_network"],
        "all": figures["total"],
    }.items():
        print(f"  {name:<16} {row['median_ms']:6.1f} {row['p95_ms']:6.1f} {row['cpu_ms']:6.1f}")
    print(f"  kept per keyframe {figures['kept_bytes'] / len(played) / 1000:.0f} kB")
    assert all(not p.reason for p in played)


def test_marching_cubes_costs_the_same_at_keyframe_500_as_at_20():
    """Row 6: one map that grows to 500 keyframes. (Voxels twice as large, to be affordable.)"""
    pipe = Pipe(lens("c3vd", 160, 128))
    rng, live = np.random.default_rng(0), Densifier(pipe.predict, COARSE)
    live.warm_up(pipe.camera)
    seconds, patches = [], []
    for i in range(500):
        keyframe, points = pipe.keyframe(i, 500, pipe.pose(i), rng)
        live.times = {}
        live.add_keyframe(replace(pipe.frame, name=f"{i:06d}"), keyframe, points)
        patches.append(len(live.mesh().patches))
        seconds.append([live.times[step].cpu for step in STEPS])
    seconds = np.array(seconds)
    early, late = seconds[10:40], seconds[470:]
    print(
        f"\nblocks with surface {patches[20]} at keyframe 20, {patches[-1]} at 500; processor ms (20 / 500):",
        ", ".join(f"{s} {ms(early[:, i])} / {ms(late[:, i])}" for i, s in enumerate(STEPS)),
    )
    print(
        f"kept {live.kept_bytes / 500e3:.0f} kB a keyframe; peak memory "
        f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB"
    )
    extract = STEPS.index("extract")
    assert np.median(late[:, extract]) < 1.2 * np.median(early[:, extract])


def test_a_screening_of_5000_frames_and_19_submaps():
    """Row 7: 500 keyframes in 19 submaps with tracking losses between them; some frames are lost, some maps poor."""
    pipe = Pipe(lens("c3vd", 160, 128))
    rng = np.random.default_rng(1)
    names = [f"{n:06d}.png" for n in range(5000)]

    def load(n: int) -> Frame:
        return replace(pipe.frame, name=names[n])

    numbers = np.sort(rng.choice(4000, 500, replace=False))
    submaps = []
    for m, part in enumerate(np.array_split(numbers, 19)):
        pairs = [pipe.keyframe(int(n) + 50 * m, 200, pipe.pose(i), rng) for i, n in enumerate(part)]
        if m == 7:  # tracked on too few points throughout
            pairs = [(replace(k, pixels=k.pixels[:5], point_ids=k.point_ids[:5]), p[:5]) for k, p in pairs]
        points = np.concatenate([p for _, p in pairs])
        submaps.append(Submap(m, tuple(k for k, _ in pairs), np.concatenate([k.point_ids for k, _ in pairs]), points))
    surfaces = []
    start = time.perf_counter()
    played = play(
        FrameSequence(names, load, "screening"),
        SparseMap(tuple(submaps), "screening"),
        pipe.predict,
        COARSE,
        lambda done: surfaces.append((len(done.dense.vertices), len(done.dense.aligned))),
    )
    cpu = np.array([p.total.cpu for p in played if not p.reason])
    wall = np.array([p.total.wall for p in played if not p.reason])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    third = len(cpu) // 3
    print(
        f"\n{len(played)} keyframes of 5000 frames, {len(surfaces)} maps in {time.perf_counter() - start:.0f} s, "
        f"{sum(v > 0 for v, _ in surfaces)} with a surface; peak memory {peak:.2f} GB"
    )
    for name, values in (("processor", cpu), ("wall", wall)):
        print(
            f"  {name} ms per keyframe, first / middle / last third: "
            + " / ".join(ms(part) for part in (values[:third], values[third:-third], values[-third:]))
        )
    assert len(played) == 500 and len(surfaces) == 19 and peak < 4
    assert sum(v > 0 for v, _ in surfaces) == 18
    assert abs(np.median(cpu[-third:]) / np.median(cpu[:third]) - 1) < 0.2


def test_a_loop_closure_over_200_keyframes():
    """Row 8: all poses of 200 keyframes corrected at once."""
    pipe = Pipe(lens("c3vd", 160, 128))
    count, right = 200, [pipe.pose(i) for i in range(200)]
    drift = []
    for i, pose in enumerate(right):
        bend = np.eye(4)
        bend[:3, :3] = Rotation.from_euler("y", 0.002 * i).as_matrix()
        bend[:3, 3] = (2e-4 * i * i, 0, 0)
        drift.append(pose @ bend)

    def run(poses) -> tuple[Densifier, float, float]:
        rng = np.random.default_rng(2)
        live = Densifier(pipe.predict, COARSE)  # for free: a fresh run pays for a network besides
        live.warm_up(pipe.camera)
        cpu, wall = time.process_time(), time.perf_counter()
        for i, pose in enumerate(poses):
            keyframe, points = pipe.keyframe(i, 500, pose, rng)
            live.add_keyframe(replace(pipe.frame, name=f"{i:06d}"), keyframe, points)
            live.mesh()
        return live, time.process_time() - cpu, time.perf_counter() - wall

    live, _, _ = run(drift)
    fresh, fresh_cpu, fresh_wall = run(right)
    before, target = live.dense_map(), fresh.dense_map()
    cpu, wall = time.process_time(), time.perf_counter()
    moved = live.update_poses({f"{i:06d}.png": pose for i, pose in enumerate(right)})
    live.mesh()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    after = live.dense_map()
    tree = cKDTree(target.vertices)
    off = [tree.query(dense.vertices)[0] / target.voxel for dense in (before, after)]
    back = cKDTree(after.vertices).query(target.vertices)[0] / target.voxel
    print(
        f"\n{moved} of {count} keyframes moved: surface off by {np.median(off[0]):.1f} voxels (median) before, by "
        f"{max(off[1].max(), back.max()):.4f} (largest) after; "
        f"{len(target.vertices)} and {len(after.vertices)} vertices"
    )
    print(
        f"  correction {cpu:.1f} s of processor ({wall:.1f} s), fresh run {fresh_cpu:.1f} s ({fresh_wall:.1f} s): "
        f"{cpu / fresh_cpu:.0%}"
    )
    assert max(off[1].max(), back.max()) < 0.5 and cpu < fresh_cpu
