"""What the light from wall to wall costs, beside everything else of a training step, on the CPU and on a GPU if there
is one.

Images of a synthetic colon, pool 8, three bounces. `loss` is the whole self-supervised loss without it, forward and
backward; `network` a forward and backward pass of the tiny network at the same size.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
import torch

from lightdepth.frame import FrameBatch, to_batch
from lightdepth.losses import LossConfig, indirect_light, self_supervised_loss
from lightdepth.network import NetworkConfig, build_network
from lightdepth.photometry import LightTerms
from lightdepth.tube import lens, tube_frames


def seconds(work: Callable[[], object], device: torch.device, rounds: int = 7) -> float:
    """The median of some rounds, after one to warm up."""
    found = []
    for _ in range(rounds + 1):
        start = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize()
        found.append(time.perf_counter() - start)
    return sorted(found[1:])[rounds // 2]


def batch_of(frame, size: tuple[int, int], count: int, device: torch.device) -> FrameBatch:
    one = to_batch(frame, size)

    def many(value):
        if isinstance(value, tuple):
            return LightTerms(*map(many, value))
        return value.expand(count, *value.shape[1:]).to(device)

    return FrameBatch(*map(many, one))


@pytest.mark.parametrize("size", [(160, 128), (320, 256)])
@pytest.mark.parametrize("name", ["cpu", *(["cuda"] if torch.cuda.is_available() else [])])
def test_what_the_indirect_light_costs(name, size):
    device = torch.device(name)
    frame = tube_frames(470, 1, lens("c3vd", 320, 256))[0]
    network = build_network(NetworkConfig(kind="tiny")).to(device)
    with_light, without = LossConfig(reflectance=0.6), LossConfig(reflectance=0.0)
    for count in (1, 4):
        batch = batch_of(frame, size, count, device)
        distance = batch.true_distance.clamp(min=1.0)
        albedo = torch.full((count, 2, *distance.shape[-2:]), 0.5, device=device)

        def loss(batch=batch, distance=distance, albedo=albedo) -> None:
            moved = distance.clone().requires_grad_()
            self_supervised_loss(moved, albedo, batch, without)[0].backward()

        def trained(batch=batch) -> None:
            network(batch.image, batch.mask, batch.rays, batch.light)[0].log().mean().backward()

        lit = seconds(lambda b=batch, d=distance: indirect_light(d, b.rays, b.mask, b.light, with_light), device)
        rest, passed = seconds(loss, device), seconds(trained, device)
        print(
            f"\n{name} {size[0]}x{size[1]}, batch {count}: {1000 * lit / count:.1f} ms an image, {lit / rest:.2f} of "
            f"the rest of the loss, {lit / (rest + passed):.2f} of loss and network"
        )
        assert torch.isfinite(indirect_light(distance, batch.rays, batch.mask, batch.light, with_light)).all()
