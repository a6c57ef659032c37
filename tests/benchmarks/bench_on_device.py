"""How long Warp's CPU device takes for what the compiled loops do, the same views by turns in one process.

NUMBA_NUM_THREADS=1 python -m pytest tests/benchmarks/bench_on_device.py -o python_files="bench_*.py" -s
"""

from __future__ import annotations

import time

import numpy as np
import pytest
from scenes import cylinder

from densify.fusion.on_device.volume import DeviceVolume
from densify.fusion.rectify import RectifyConfig, surface_view
from densify.fusion.volume import TsdfVolume
from lightdepth.tube import lens

ROUNDS, VIEWS = 7, 4


@pytest.mark.parametrize("size", [(160, 128), (320, 256)])
def test_the_same_views_by_turns(size):
    scene = cylinder(lens("fisheye", *size))
    view = surface_view(scene.prediction(), scene.frame().image, RectifyConfig(), 30.0)
    poses = [np.eye(4) for _ in range(VIEWS)]
    for i, pose in enumerate(poses):
        pose[2, 3] = 0.7 * i
    kinds = {"loops": TsdfVolume, "warp": lambda voxel: DeviceVolume(voxel, device="cpu")}
    taken: dict[tuple[str, str], list[float]] = {}
    for _ in range(ROUNDS):
        for name, kind in kinds.items():
            volume = kind(0.25)
            start = time.process_time()
            for pose in poses:
                volume.integrate(view, pose)
            middle = time.process_time()
            volume.extract_mesh()
            taken.setdefault((name, "integrate"), []).append(middle - start)
            taken.setdefault((name, "extract"), []).append(time.process_time() - middle)
    for step in ("integrate", "extract"):
        loops, warp = (1000 * min(taken[name, step]) for name in kinds)
        print(f"\n{size} {step}: loops {loops:.1f}, warp {warp:.1f} ms of a processor: {warp / loops:.2f} times")
