"""How fast synthetic colons are rendered: views one by one and in batches, on the CPU and on a GPU if there is one.

Realistic colons with every effect, C3VD's lens, eight views each; `set-up` is the colon itself (shape, paint, form
factors), made on the CPU in any case but for the form factors. The reference of every ratio is one view at a time on
the CPU, timed in turn with the others. All must show the same images.
"""

from __future__ import annotations

import time

import numpy as np
import pytest
import torch

from lightdepth import native
from lightdepth.tube import Tube, camera_path, lens, octagon, realistic

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() and native.has_warp() else [])]
VIEWS, ROUNDS = 8, 5


def rendered(seed: int, size: tuple[int, int], device: str, at_once: int) -> tuple[float, float, list]:
    """Seconds of the set-up and of a view, and the views."""
    camera, rng = lens("c3vd", *size), np.random.default_rng(seed)
    start = time.perf_counter()
    tube = Tube(realistic(), rng, device=device)
    poses, mask, made = camera_path(tube.shape, VIEWS, 40.0, rng), octagon(camera), time.perf_counter()
    views = [v for i in range(0, VIEWS, at_once) for v in tube.views(poses[i : i + at_once], camera, mask, rng)]
    return made - start, (time.perf_counter() - made) / VIEWS, views


@pytest.mark.parametrize("size", [(160, 128), (320, 256)])
def test_views_per_second(size):
    ways = {(device, at_once): [] for device in DEVICES for at_once in (1, VIEWS)}
    for seed in range(8600, 8600 + ROUNDS + 1):  # the first is to warm up
        shown = {}
        for way, seconds in ways.items():
            *taken, shown[way] = rendered(seed, size, *way)
            seconds.append(taken)
        reference = shown["cpu", 1]
        for views in shown.values():
            for one, other in zip(views, reference, strict=True):
                np.testing.assert_allclose(one.distance, other.distance, rtol=1e-4, atol=1e-3)
                assert np.abs(one.image - other.image).mean() < 2e-4
    print(f"\n{size[0]}x{size[1]}, {torch.get_num_threads()} threads: ms of the set-up, ms a view, times the reference")
    slowest = np.median([view for _, view in ways["cpu", 1][1:]])
    for (device, at_once), seconds in ways.items():
        setup, view = np.median(seconds[1:], axis=0)
        print(f"{device:>5}, {at_once} at once: {1e3 * setup:7.0f} {1e3 * view:7.1f} {slowest / view:6.2f}")
